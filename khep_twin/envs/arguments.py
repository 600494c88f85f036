"""Checks of the environments' arguments, each with an error of one line."""

from collections.abc import Iterable, Mapping
from math import inf
from numbers import Real
from typing import Any, cast

import numpy as np

from khep_twin.clock import NS_PER_S, n_steps, to_ns
from khep_twin.episodes.episode_options import as_integer
from khep_twin.errors import KhepTwinError, choices, value_text
from khep_twin.units import TICK_NS

MAX_PERIOD_NS = 3600 * NS_PER_S
"""Longest control period [ns]."""

MAX_PERIODS = 10**9
"""Largest number of control periods of an episode."""


def check_switch(name: str, value: object) -> None:
    """Raise a `ValueError` unless a value is True or False."""
    if type(value) not in (bool, int, np.bool_) or value not in (True, False):
        raise ValueError(f"{name} = {value_text(value)}; expected True or False")


def check_choice(name: str, value: object, valid: Iterable[str]) -> None:
    """Raise a `KhepTwinError` unless a value is one of the choices."""
    names = tuple(valid)
    if not (isinstance(value, str) and value in names):
        raise KhepTwinError(f"{name} {value_text(value)}: unknown; {choices(value, names)}")


def check_mapping(name: str, value: object) -> Mapping[str, Any]:
    """Return a mapping, empty for None; raise a `KhepTwinError` for other types and keys."""
    if value is None:
        return {}
    names = list(cast(Iterable[object], value)) if isinstance(value, Mapping) else [None]
    if all(isinstance(key, str) for key in names):
        return cast(Mapping[str, Any], value)
    raise KhepTwinError(f"{name} = {value_text(cast(object, value))}; expected a mapping of names to values")


def is_number(value: object, low: float = 0.0, high: float = inf) -> bool:
    """Return whether a value is a finite number from `low` to `high`."""
    number: Any = value
    return isinstance(value, Real) and bool(low <= number <= high) and abs(number) < inf


def check_period(period_ns: object) -> int:
    """Return a control period [ns]; raise a `ValueError` unless it is in whole ticks."""
    integer_ns = as_integer(period_ns)
    if integer_ns is not None and 0 < integer_ns <= MAX_PERIOD_NS and integer_ns % TICK_NS == 0:
        return integer_ns
    text = f"{period_ns / 1e6:g} ms" if is_number(period_ns, -1e18, 1e18) else value_text(period_ns)  # pyright: ignore
    raise ValueError(f"control period of {text}; expected whole ticks of 10 ms, up to an hour")


def count_periods(seconds: object, period_ns: int) -> int:
    """Return the number of control periods of an episode.

    Raises:
        ValueError: The time [s] is not one or more whole periods.
    """
    longest_s = MAX_PERIODS * period_ns / 1e9
    if is_number(seconds, high=longest_s):
        duration_ns = to_ns(cast(float, seconds))
        if duration_ns > 0 and duration_ns % period_ns == 0:
            return n_steps(duration_ns, period_ns)
    raise ValueError(
        f"seconds = {value_text(seconds)}; expected one or more whole control periods of "
        f"{period_ns / 1e6:g} ms, up to {longest_s:g} s"
    )


def shape_of(values: object) -> tuple[int, ...]:
    """Return the shape of an array or of nested lists; empty for other values."""
    try:
        return np.shape(cast(Any, values))
    except (TypeError, ValueError):  # lists of unequal lengths
        return ()
