"""Injected faults: a bad cable, faulty sensors, motors and wheels, a drop of the supply voltage.

    drop:0.01            each byte on the line is lost with this probability
    garble:0.01          each byte has one bit flipped with this probability
    late:0.1:60          a reply starts 60 ms late with this probability
    stuck:2              the sensor with this number or name (`Body.fault_sensors`) repeats its last reading
    dead:2               this sensor's receiver passes no current (assumed: proximity 0, ambient as if dark)
    dead:left            this motor gets no current: left or right
    weak:left:0.5        this motor gives this fraction of its torque
    slip:left:0.1        this wheel's tyre has this fraction of its friction on the floor
    blocked:left         this wheel cannot turn, while its motor gets current
    brown-out            the processor is reset once by low voltage and restarts

The suffix `@5` delays a fault to 5 simulated seconds after the start. With `@5-9` it ends 9 seconds after the
start, and its effect is reversed. Each fault has a separate random stream, so that it does not change other
random numbers of the run; every occurrence is logged.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.clock import NEVER_NS, to_ns
from khep_twin.errors import FaultError, choices
from khep_twin.randomness import StreamState, position, resume

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
        text: Fault as written, with its times.
        probability: Probability of each occurrence; 1 for a deterministic fault.
        delay_ns: Delay of a late reply [ns].
        device: SENSOR, MOTOR or WHEEL; empty for a fault of line or processor.
        which: 0 for the left and 1 for the right motor or wheel; index of the sensor, set by `locate`.
        sensor: Number or name of the sensor.
        part: Remaining fraction of a motor's torque or a tyre's friction.
        start_ns: Start of the fault [ns].
        end_ns: End of the fault [ns].
    """

    kind: str
    text: str
    probability: float = 1.0
    delay_ns: int = 0
    device: str = ""
    which: int = 0
    sensor: str = ""
    part: float = 0.0
    start_ns: int = 0
    end_ns: int = NEVER_NS

    @property
    def has_end(self) -> bool:
        """True if the fault has an end."""
        return self.end_ns < NEVER_NS


def _parse_number(text: str, low: float, high: float) -> float:
    number = float(text) if _NUMBER.fullmatch(text) else high + 1
    if not low <= number <= high:
        raise ValueError(text)
    return number


_MakeFault = Callable[..., Fault]  # with kind, text and times


def _parse_probability(make: _MakeFault, probability: str) -> Fault:
    return make(probability=_parse_number(probability, 0, 1))


def _parse_late(make: _MakeFault, probability: str, delay_ms: str) -> Fault:
    delay_ns = to_ns(_parse_number(delay_ms, 0, 10_000) / 1000)
    return make(probability=_parse_number(probability, 0, 1), delay_ns=delay_ns)


def _parse_sensor(make: _MakeFault, sensor: str) -> Fault:
    if not sensor:
        raise ValueError(sensor)
    return make(device=SENSOR, sensor=sensor)


def _parse_side(device: str, make: _MakeFault, side: str) -> Fault:
    return make(device=device, which=_SIDES.index(side))


def _parse_fraction(device: str, make: _MakeFault, side: str, part: str) -> Fault:
    return make(device=device, which=_SIDES.index(side), part=_parse_number(part, 0, 1))


def _parse_dead(make: _MakeFault, which: str) -> Fault:
    return _parse_side(MOTOR, make, which) if which in _SIDES else _parse_sensor(make, which)


def _parse_nothing(make: _MakeFault) -> Fault:
    return make()


_KINDS: Mapping[str, tuple[Callable[..., Fault], str]] = {
    "drop": (_parse_probability, "drop:PROBABILITY, such as drop:0.01"),
    "garble": (_parse_probability, "garble:PROBABILITY, such as garble:0.01"),
    "late": (_parse_late, "late:PROBABILITY:MILLISECONDS, such as late:0.1:60"),
    "stuck": (_parse_sensor, "stuck:SENSOR, its number or name"),
    "dead": (_parse_dead, "dead:SENSOR, its number or name, dead:left or dead:right"),
    "weak": (partial(_parse_fraction, MOTOR), "weak:SIDE:PART, such as weak:left:0.5"),
    "slip": (partial(_parse_fraction, WHEEL), "slip:SIDE:PART, such as slip:left:0.1"),
    "blocked": (partial(_parse_side, WHEEL), "blocked:left or blocked:right"),
    _BROWN_OUT: (_parse_nothing, "brown-out alone"),
}


def parse_fault(text: str) -> Fault:
    """Parse a fault such as "drop:0.01@5".

    Raises:
        FaultError: The fault is unknown or malformed.
    """
    body, at_sign, times = text.partition("@")
    start, dash, end = times.partition("-")
    kind, *values = body.split(":")
    if kind not in _KINDS:
        raise FaultError(f"fault {text!r}: unknown; {choices(kind, _KINDS)}")
    parse, syntax = _KINDS[kind]
    try:
        start_ns = to_ns(_parse_number(start, 0, 1e6)) if at_sign else 0
        end_ns = to_ns(_parse_number(end, 0, 1e6)) if dash else NEVER_NS
        if end_ns <= start_ns or (dash and kind == _BROWN_OUT):
            raise ValueError(text)
        return parse(partial(Fault, kind, text, start_ns=start_ns, end_ns=end_ns), *values)
    except (TypeError, ValueError):
        times = "@SECONDS" if kind == _BROWN_OUT else "@SECONDS or @FROM-TO"
        raise FaultError(f"fault {text!r}: expected {syntax}, with {times} appended if wanted") from None


def locate(fault: Fault, sensors: Sequence[str] | None, robot: str) -> Fault:
    """Return a fault with the index of its sensor on a robot.

    Args:
        fault: Fault.
        sensors: Names of the robot's sensors; None if its model applies no faults of sensors and motors.
        robot: Robot, for messages.

    Raises:
        FaultError: The robot lacks the sensor, or its model does not apply the fault.
    """
    if fault.device not in (SENSOR, MOTOR):
        return fault
    if sensors is None:
        raise FaultError(f"fault {fault.text!r}: {robot}; expected a fault of its line or wheels")
    if fault.device == MOTOR:
        return fault
    names = [*map(str, range(len(sensors))), *sensors]
    if fault.sensor not in names:
        motors = "".join(f"{side}, " for side in _SIDES) if fault.kind == "dead" else ""
        expected = f"{motors}a number below {len(sensors)}, or a name; {choices(fault.sensor, sensors)}"
        raise FaultError(f"fault {fault.text!r}: {robot}; expected {expected}")
    return replace(fault, which=names.index(fault.sensor) % len(sensors))


class InjectorState(NamedTuple):
    """State of the faults of a robot.

    Attributes:
        streams: Position in the random stream of each fault, by its text.
        waiting: Texts of the deterministic faults that have not started.
        active: Texts of the deterministic faults that are active.
    """

    streams: dict[str, StreamState]
    waiting: tuple[str, ...]
    active: tuple[str, ...]


class Injector:
    """Injector of faults into one robot.

    Args:
        faults: Faults to inject.
        make_rng: Function that returns the random stream of a fault by its text.
        log_event: Callback that logs a message.

    Attributes:
        active: Active faults of devices, and active faults of the line that have an end.
    """

    def __init__(
        self,
        faults: Iterable[Fault],
        make_rng: Callable[[str], np.random.Generator],
        log_event: Callable[[str], None],
    ) -> None:
        self._faults = tuple(faults)
        self._rngs = {fault.text: make_rng(fault.text) for fault in self._faults}
        self._log_event = log_event
        timed = (fault for fault in self._faults if fault.device or fault.kind == _BROWN_OUT or fault.has_end)
        self._timed = tuple(dict.fromkeys(timed))
        self._waiting = list(self._timed)
        self.active: list[Fault] = []

    @property
    def next_changes_ns(self) -> list[int]:
        """Times of the next starts and ends of faults [ns]."""
        ends_ns = [fault.end_ns for fault in self.active if fault.has_end]
        return [fault.start_ns for fault in self._waiting] + ends_ns

    def state(self) -> InjectorState:
        """Return the state."""
        streams = {text: position(rng) for text, rng in self._rngs.items()}
        waiting, active = (tuple(fault.text for fault in faults) for faults in (self._waiting, self.active))
        return InjectorState(streams, waiting, active)

    def set_state(self, state: InjectorState) -> None:
        """Restore a state; faults that it does not contain keep their present state.

        Raises:
            ValueError: The state contains a fault that is not injected here.
        """
        timed = {fault.text for fault in self._timed} & state.streams.keys()
        unknown = [text for text in state.streams if text not in self._rngs]
        unknown += [text for text in (*state.waiting, *state.active) if text not in timed]
        if unknown:
            raise ValueError(f"fault {unknown[0]!r}; {choices(unknown[0], self._rngs)}")
        for text, stream in state.streams.items():
            resume(self._rngs[text], stream)
        known_texts, waiting_texts = state.streams.keys(), set(state.waiting)
        waiting_texts |= {fault.text for fault in self._waiting if fault.text not in known_texts}
        self._waiting = [fault for fault in self._timed if fault.text in waiting_texts]
        active_texts = set(state.active)
        active_texts |= {fault.text for fault in self.active if fault.text not in known_texts}
        self.active = [fault for fault in self._timed if fault.text in active_texts]

    def reseed(self, make_rng: Callable[[str], np.random.Generator]) -> None:
        """Replace the random streams."""
        self._rngs = {text: make_rng(text) for text in self._rngs}

    def transmit(self, data: bytes, time_ns: int) -> bytes:
        """Return bytes that are sent at a time [ns] as they arrive: some of them dropped or garbled."""
        if not self._faults:
            return data
        for fault in self._active_faults("drop", time_ns):
            is_hit = self._draw(fault, len(data))
            if is_hit.any():
                self._log_event(f"fault {fault.text}: {int(is_hit.sum())} of {data!r} dropped")
                data = bytes(byte for byte, lost in zip(data, is_hit, strict=True) if not lost)
        for fault in self._active_faults("garble", time_ns):
            is_hit = self._draw(fault, len(data))
            if is_hit.any():
                bits = self._rngs[fault.text].integers(0, 8, len(data)).tolist()
                self._log_event(f"fault {fault.text}: {int(is_hit.sum())} of {data!r} garbled")
                data = bytes(
                    byte ^ (1 << bit if wrong else 0)
                    for byte, bit, wrong in zip(data, bits, is_hit, strict=True)
                )
        return data

    def delay_ns(self, time_ns: int) -> int:
        """Return the delay of a reply that starts at a time [ns], 0 without a fault [ns]."""
        delay_ns = 0
        for fault in self._active_faults("late", time_ns):
            if self._draw(fault, 1).any():
                self._log_event(f"fault {fault.text}: a reply is late")
                delay_ns += fault.delay_ns
        return delay_ns

    def update(self, devices: Collection[str], time_ns: int) -> list[Fault]:
        """Start and end the due faults of devices (SENSOR, MOTOR, WHEEL or ""), log and return them."""
        ended = [fault for fault in self.active if fault.device in devices and fault.end_ns <= time_ns]
        started = [fault for fault in self._waiting if fault.device in devices and fault.start_ns <= time_ns]
        for fault in ended:
            self._log_event(f"fault {fault.text} ends")
        for fault in started:
            self._waiting.remove(fault)
            self._log_event(f"fault {fault.text} begins")
        if ended or started:
            # Sorted as the faults, not by their times, so that the state depends only on the set of faults.
            lasting = {fault for fault in started if fault.kind != _BROWN_OUT}
            active = lasting.union(self.active).difference(ended)
            self.active = [fault for fault in self._timed if fault in active]
        return ended + started

    def next_brown_out_ns(self) -> int | None:
        """Return the time of the next brown-out [ns]; None if there is none."""
        starts = (fault.start_ns for fault in self._waiting if fault.kind == _BROWN_OUT)
        return min(starts, default=None)

    def _active_faults(self, kind: str, time_ns: int) -> list[Fault]:
        """Return the faults of a kind that are active at a time [ns]."""
        faults = (fault for fault in self._faults if fault.kind == kind)
        return [fault for fault in faults if fault.start_ns <= time_ns < fault.end_ns]

    def _draw(self, fault: Fault, count: int) -> NDArray[np.bool_]:
        """Draw for each of `count` bytes or replies whether the fault occurs."""
        return self._rngs[fault.text].random(count) < fault.probability
