"""Shares: of many like cases the suite runs a fixed part, the long checks run them all."""

from collections.abc import Iterable
from typing import Any

import pytest


def share(cases: Iterable[Any], every: int) -> list[Any]:
    """Return cases for `parametrize`, of which all but every n-th are marked long.

    Args:
        cases: Cases, each one parameter, or a tuple of several.
        every: Number of cases of which the suite runs one, the first.
    """
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=pytest.mark.long if number % every else (),
        )
        for number, case in enumerate(cases)
    ]
