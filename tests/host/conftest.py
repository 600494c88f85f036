"""Twins behind every kind of port."""

from collections.abc import Iterator

import pytest
from served_twin import served

from khep_twin.host import Khepera

KINDS = {"pty": (), "tcp": ("--tcp", ":0"), "rfc2217": ("--rfc2217", ":0")}
"""Options of `khep-twin serve`."""


@pytest.fixture(scope="module", params=["khep", *KINDS])
def robot(request: pytest.FixtureRequest) -> Iterator[Khepera]:
    """A robot behind one kind of port after the other, at 38400 baud."""
    if request.param == "khep":
        with Khepera("khep://default?noise=off&mode=3", baudrate=38400) as khepera:
            yield khepera
        return
    with (
        served("default", "--noise", "off", "--mode", "3", *KINDS[request.param]) as (_, url),
        Khepera(url, 2.0, baudrate=38400) as khepera,
    ):
        yield khepera
