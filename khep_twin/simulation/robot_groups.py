"""Robots of a simulation in groups by family: states whose memory plain and compiled code share."""

from collections.abc import Collection, Sequence
from itertools import chain
from typing import Any

from khep_twin.robots.core import CORES, marker_of
from khep_twin.sensing.buffers import as_plain, as_records, fill_record


class RobotGroups:
    """Robots in groups by the families of their models, which are in alphabetical order.

    Args:
        states: State of each robot before a start, in the playpen's order.

    Attributes:
        records: Groups as records of the robots' states: their current state.
        plain: Groups for plain code: memoryviews of the records, with the robots' constants.
    """

    def __init__(self, states: Sequence[Any]) -> None:
        names = [CORES[type(state)].name for state in states]
        self._numbers = [
            [number for number, name in enumerate(names) if name == model] for model in sorted({*names})
        ]
        self._places = {
            number: (group, index)
            for group, numbers in enumerate(self._numbers)
            for index, number in enumerate(numbers)
        }
        groups = self._group(states)
        self.records: tuple[Any, ...] = tuple(
            as_records(group, group[0], marker_of(CORES[type(group[0])])) for group in groups
        )
        self._initial_records = [records.copy() for records in self.records]
        self._set_plain(groups)

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the robots' cores, in the order of the groups."""
        return tuple(CORES[type(group[0])].name for group in self.plain)

    @property
    def n_robots(self) -> int:
        """Number of robots."""
        return len(self._places)

    def state_of(self, robot: int) -> Any:
        """Return the state of a robot for plain code, by its number in the playpen."""
        group, index = self._places[robot]
        return self.plain[group][index]

    def record_of(self, robot: int) -> Any:
        """Return the record of a robot's state, by its number in the playpen."""
        group, index = self._places[robot]
        return self.records[group][index]

    def position_of(self, robot: int) -> int:
        """Return the position of a robot in the chain of all groups, by its number in the playpen."""
        return [*chain(*self._numbers)].index(robot)

    def replace(self, states: Sequence[Any]) -> None:
        """Replace the robots by others of the same models, in their states before a start."""
        groups = self._group(states)
        for records, initial, group in zip(self.records, self._initial_records, groups, strict=True):
            for record, state in zip(initial, group, strict=True):
                fill_record(record, state)
            records[:] = initial
        self._set_plain(groups)

    def reset(self, terms: Collection[str]) -> None:
        """Return to the states before a start; the robots measure the terms of these names."""
        for records, initial, group in zip(self.records, self._initial_records, self.plain, strict=True):
            core = CORES[type(group[0])]
            for name in core.changing:
                records[name] = initial[name]
            for record in records:
                core.request_terms(record, terms)

    def _group(self, states: Sequence[Any]) -> list[list[Any]]:
        """Return states of the robots by groups."""
        return [[states[number] for number in numbers] for numbers in self._numbers]

    def _set_plain(self, groups: Sequence[Sequence[Any]]) -> None:
        """Set the groups for plain code, with the constants of states."""
        self.plain = tuple(
            [as_plain(state, record) for state, record in zip(group, records, strict=True)]
            for group, records in zip(groups, self.records, strict=True)
        )
