"""Injected faults: a bad cable, faulty sensors, motors and wheels, a supply that drops out.

    drop:0.01            each byte on the line is lost with this probability
    garble:0.01          each byte has one bit flipped with this probability
    late:0.1:60          a reply begins 60 ms late with this probability
    stuck:2              the sensor with this number (order of N) repeats its last reading
    dead:2               this sensor's receiver passes no current (assumed: proximity 0, ambient highest)
    dead:left            this motor gets no current: left or right
    weak:left:0.5        this motor gives this part of its torque
    slip:left:0.1        this wheel's tyre has this part of its friction on the floor
    blocked:left         this wheel cannot turn, while its motor gets current
    brown-out            the processor is reset once by low voltage and restarts

A suffix `@5` delays any of them to 5 simulated seconds after the start; with `@5-9` it ends 9 seconds after
the start, and what it changed is as before. Each fault has its own random stream, so that it changes nothing
else in a run; every occurrence is logged.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NEVER_NS, to_ns
from khep_twin.errors import FaultError, choices
from khep_twin.randomness import StreamState, position, resume
from khep_twin.units import N_SENSORS

SENSOR, MOTOR, WHEEL = "sensor", "motor", "wheel"
"""Devices that can be faulty."""

_BROWN_OUT = "brown-out"
_SIDES = ("left", "right")
_NUMBER = re.compile(r"[0-9]{1,6}(\.[0-9]{1,9})?")


@dataclass(frozen=True, slots=True)
class Fault:
    """One requested fault.

    Attributes:
        kind: Name of the fault.
        text: The whole fault as written.
        probability: Probability of each occurrence; 1 for a deterministic fault.
        delay_ns: Delay of a late reply [ns].
        device: SENSOR, MOTOR or WHEEL; empty for a fault of line or processor.
        which: Number of the sensor, or 0 for the left and 1 for the right motor or wheel.
        part: Part of a motor's torque or a tyre's friction that is left.
        start_ns: Start of the fault [ns].
        end_ns: End of the fault [ns].
    """

    kind: str
    text: str
    probability: float = 1.0
    delay_ns: int = 0
    device: str = ""
    which: int = 0
    part: float = 0.0
    start_ns: int = 0
    end_ns: int = NEVER_NS

    @property
    def ends(self) -> bool:
        """True if it ends by itself."""
        return self.end_ns < NEVER_NS


def parse_fault(text: str) -> Fault:
    """Parse a fault such as "drop:0.01@5".

    Raises:
        FaultError: The fault is unknown or malformed.
    """
    what, at, times = text.partition("@")
    start, until, end = times.partition("-")
    kind, *values = what.split(":")
    if kind not in _KINDS:
        raise FaultError(f"fault {text!r}: unknown; {choices(kind, _KINDS)}")
    read, wanted = _KINDS[kind]
    try:
        start_ns = to_ns(_number(start, 0, 1e6)) if at else 0
        end_ns = to_ns(_number(end, 0, 1e6)) if until else NEVER_NS
        if end_ns <= start_ns or (until and kind == _BROWN_OUT):
            raise ValueError(text)
        return Fault(kind, text, start_ns=start_ns, end_ns=end_ns, **read(*values))
    except (TypeError, ValueError):
        times = "@SECONDS" if kind == _BROWN_OUT else "@SECONDS or @FROM-TO"
        raise FaultError(f"fault {text!r}: expected {wanted}, with {times} appended if wanted") from None


class InjectorState(NamedTuple):
    """State of the faults of a robot.

    Attributes:
        streams: Position in the random stream of each fault, by its text.
        waiting: Texts of the deterministic faults that have not begun.
        active: Texts of those that have begun and last.
    """

    streams: dict[str, StreamState]
    waiting: tuple[str, ...]
    active: tuple[str, ...]


class Injector:
    """Injector of faults into one robot.

    Args:
        faults: Faults to inject.
        rng: Factory of each fault's own random stream, by its text.
        log_event: Callback that logs a message.

    Attributes:
        active: Faults of devices that have begun and not ended, and those of the line that will end.
    """

    def __init__(
        self,
        faults: Iterable[Fault],
        rng: Callable[[str], np.random.Generator],
        log_event: Callable[[str], None],
    ) -> None:
        self._faults = tuple(faults)
        self._rng = {fault.text: rng(fault.text) for fault in self._faults}
        self._log_event = log_event
        timed = (each for each in self._faults if each.device or each.kind == _BROWN_OUT or each.ends)
        self._timed = tuple(dict.fromkeys(timed))
        self._waiting = list(self._timed)
        self.active: list[Fault] = []

    @property
    def next_changes_ns(self) -> list[int]:
        """Times at which faults begin or end by themselves [ns]."""
        ends_ns = [fault.end_ns for fault in self.active if fault.ends]
        return [fault.start_ns for fault in self._waiting] + ends_ns

    def state(self) -> InjectorState:
        """Return the state."""
        streams = {text: position(rng) for text, rng in self._rng.items()}
        waiting, active = (tuple(fault.text for fault in each) for each in (self._waiting, self.active))
        return InjectorState(streams, waiting, active)

    def set_state(self, state: InjectorState) -> None:
        """Take over a state; faults that it does not have stay as they are.

        Raises:
            ValueError: It has a fault that is not injected here.
        """
        if unknown := [text for text in state.streams if text not in self._rng]:
            raise ValueError(f"fault {unknown[0]!r}; {choices(unknown[0], self._rng)}")
        for text, at in state.streams.items():
            resume(self._rng[text], at)
        known, waiting = state.streams.keys(), set(state.waiting)
        waiting |= {each.text for each in self._waiting if each.text not in known}
        self._waiting = [each for each in self._timed if each.text in waiting]
        active = {each.text for each in self.active if each.text not in known} | set(state.active)
        self.active = [each for each in self._timed if each.text in active]

    def reseed(self, rng: Callable[[str], np.random.Generator]) -> None:
        """Draw from other random streams from now on."""
        self._rng = {text: rng(text) for text in self._rng}

    def over_the_line(self, data: bytes, time_ns: int) -> bytes:
        """Return the bytes as a bad cable delivers them."""
        if not self._faults:
            return data
        for fault in self._present("drop", time_ns):
            hit = self._draw(fault, len(data))
            if hit.any():
                self._log_event(f"fault {fault.text}: {int(hit.sum())} of {data!r} dropped")
                data = bytes(byte for byte, lost in zip(data, hit, strict=True) if not lost)
        for fault in self._present("garble", time_ns):
            hit = self._draw(fault, len(data))
            if hit.any():
                bits = self._rng[fault.text].integers(0, 8, len(data)).tolist()
                self._log_event(f"fault {fault.text}: {int(hit.sum())} of {data!r} garbled")
                data = bytes(
                    byte ^ (1 << bit if wrong else 0)
                    for byte, bit, wrong in zip(data, bits, hit, strict=True)
                )
        return data

    def delay_ns(self, time_ns: int) -> int:
        """Return the delay of a reply [ns]."""
        delay_ns = 0
        for fault in self._present("late", time_ns):
            if self._draw(fault, 1).any():
                self._log_event(f"fault {fault.text}: a reply is late")
                delay_ns += fault.delay_ns
        return delay_ns

    def update(self, devices: Collection[str], time_ns: int) -> list[Fault]:
        """Begin and end the faults of some devices that are due, and log it; return those that changed."""
        over = [each for each in self.active if each.device in devices and each.end_ns <= time_ns]
        begun = [each for each in self._waiting if each.device in devices and each.start_ns <= time_ns]
        for fault in over:
            self._log_event(f"fault {fault.text} ends")
        for fault in begun:
            self._waiting.remove(fault)
            self._log_event(f"fault {fault.text} begins")
        if over or begun:
            # In the order of the faults, not of their times, so that a state follows from what is present.
            active = {*self.active, *(each for each in begun if each.kind != _BROWN_OUT)}.difference(over)
            self.active = [each for each in self._timed if each in active]
        return over + begun

    def next_brown_out_ns(self) -> int | None:
        """Return the start of the next supply drop-out [ns], None if there is none."""
        starts = (fault.start_ns for fault in self._waiting if fault.kind == _BROWN_OUT)
        return min(starts, default=None)

    def _present(self, kind: str, time_ns: int) -> list[Fault]:
        return [each for each in self._faults if each.kind == kind and each.start_ns <= time_ns < each.end_ns]

    def _draw(self, fault: Fault, count: int) -> NDArray[np.bool_]:
        return self._rng[fault.text].random(count) < fault.probability


def _number(text: str, low: float, high: float) -> float:
    number = float(text) if _NUMBER.fullmatch(text) else high + 1
    if not low <= number <= high:
        raise ValueError(text)
    return number


class _Values(TypedDict, total=False):
    """Values of a fault, by the attributes of `Fault`."""

    probability: float
    delay_ns: int
    device: str
    which: int
    part: float


def _by_chance(probability: str) -> _Values:
    return {"probability": _number(probability, 0, 1)}


def _late(probability: str, delay_ms: str) -> _Values:
    return {**_by_chance(probability), "delay_ns": to_ns(_number(delay_ms, 0, 10_000) / 1000)}


def _stuck(sensor: str) -> _Values:
    return {"device": SENSOR, "which": [str(number) for number in range(N_SENSORS)].index(sensor)}


def _side(device: str, side: str) -> _Values:
    return {"device": device, "which": _SIDES.index(side)}


def _part(device: str, side: str, part: str) -> _Values:
    return {**_side(device, side), "part": _number(part, 0, 1)}


def _dead(which: str) -> _Values:
    return _side(MOTOR, which) if which in _SIDES else _stuck(which)


def _plain() -> _Values:
    return {}


_KINDS: Mapping[str, tuple[Callable[..., _Values], str]] = {
    "drop": (_by_chance, "drop:PROBABILITY, such as drop:0.01"),
    "garble": (_by_chance, "garble:PROBABILITY, such as garble:0.01"),
    "late": (_late, "late:PROBABILITY:MILLISECONDS, such as late:0.1:60"),
    "stuck": (_stuck, f"stuck:SENSOR, 0 to {N_SENSORS - 1}"),
    "dead": (_dead, f"dead:SENSOR, 0 to {N_SENSORS - 1}, dead:left or dead:right"),
    "weak": (partial(_part, MOTOR), "weak:SIDE:PART, such as weak:left:0.5"),
    "slip": (partial(_part, WHEEL), "slip:SIDE:PART, such as slip:left:0.1"),
    "blocked": (partial(_side, WHEEL), "blocked:left or blocked:right"),
    _BROWN_OUT: (_plain, "brown-out alone"),
}
