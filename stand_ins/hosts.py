"""Scripted hosts of `stand_ins.recordings`: each decides by the replies to N and its seed alone.

Most drive at 2 to 10 pulses per 10 ms and sometimes make manoeuvres that no reply causes. They give up
unsuccessful turns, so a robot with a faulty sensor also keeps moving. The vehicle is that of the ROM.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from khep_twin.board.kernel import DEMO_DIVISOR, DEMO_SPEED_PULSES, DEMO_WEIGHTS
from khep_twin.randomness import stream

Speeds = tuple[int, int]
Host = Callable[[Sequence[int]], Speeds]
"""Function that takes the counts of N (8,) and returns the speeds of the wheels [pulses/10 ms]."""

_NEAR = 350
"""Counts of an object to turn away from, about 25 mm ahead (assumed)."""
_LONGEST_TURN = 45
"""Decisions after which a turn is given up; half a turn at 3 pulses takes about 30."""
_MEMORY = 25
"""Decisions for which a host remembers the side of its last turn."""


def avoider(seed: int) -> Host:
    """Return a Braitenberg vehicle that turns away from near objects, and sometimes at random."""
    rng = stream(seed, "host", "avoider")
    speed = int(rng.integers(5, 9))
    turn = _Turn()

    def decide(counts: Sequence[int]) -> Speeds:
        if (turning := turn.continue_turn(counts)) is not None:
            return turning
        left, front, right = counts[0] + 2 * counts[1], max(counts[2:4]), counts[5] + 2 * counts[4]
        if front > _NEAR or max(counts[1], counts[4]) > 2 * _NEAR:
            return turn.begin(-1 if left > right else 1, 3, int(rng.integers(4, 16)))
        if rng.random() < 1 / 150:
            return turn.begin(int(rng.choice((-1, 1))), int(rng.integers(2, 5)), int(rng.integers(5, 25)))
        bend = round((left - right) * speed / 1500)
        return _clip(speed + bend), _clip(speed - bend)

    return decide


def wall_follower(seed: int) -> Host:
    """Return a host that keeps a wall at its side, and sometimes changes the side."""
    rng = stream(seed, "host", "wall follower")
    speed = int(rng.integers(4, 8))
    turn = _Turn()
    side, remaining = int(rng.choice((-1, 1))), int(rng.integers(300, 900))

    def decide(counts: Sequence[int]) -> Speeds:
        nonlocal side, remaining
        if (turning := turn.continue_turn(counts)) is not None:
            return turning
        remaining -= 1
        if remaining < 0:
            side, remaining = -side, int(rng.integers(300, 900))
            return turn.begin(side, 3, int(rng.integers(15, 35)))
        lateral, oblique = (counts[0], counts[1]) if side > 0 else (counts[5], counts[4])
        if max(counts[2:4]) > _NEAR or oblique > 2 * _NEAR:
            return turn.begin(-side, 3, int(rng.integers(3, 12)))
        # Positive: towards the wall.
        pull = 0.35 if lateral < 80 else (300 - lateral) / 1200 - oblique / 1500
        bend = round(side * min(max(pull, -0.6), 0.4) * speed)
        return _clip(speed - bend), _clip(speed + bend)

    return decide


def wanderer(seed: int) -> Host:
    """Return a host that drives straight, in curves and backwards, and turns in place, each for a while."""
    rng = stream(seed, "host", "wanderer")
    turn = _Turn()
    speeds, remaining = (0, 0), 0

    def decide(counts: Sequence[int]) -> Speeds:
        nonlocal speeds, remaining
        if (turning := turn.continue_turn(counts)) is not None:
            return turning
        remaining -= 1
        back = sum(speeds) < 0
        if max(counts[6:8] if back else counts[1:5]) > _NEAR:
            speeds, remaining = (5, 5), 20
            away = counts[0] + counts[1] > counts[4] + counts[5]
            return turn.begin(-1 if away else 1, int(rng.integers(2, 6)), int(rng.integers(6, 20)))
        if remaining <= 0:
            remaining = int(rng.integers(15, 90))
            speed, kind = int(rng.integers(4, 11)), rng.random()
            inner = int(rng.integers(2, speed + 1))
            if kind < 0.2:
                return turn.begin(int(rng.choice((-1, 1))), int(rng.integers(2, 6)), remaining // 3)
            if kind < 0.35 and max(counts[6:8]) < _NEAR // 2:
                speeds, remaining = (-inner, -inner), remaining // 3
            elif kind < 0.65:
                speeds = (speed, speed)
            else:
                speeds = (inner, speed) if rng.random() < 0.5 else (speed, inner)
        return speeds

    return decide


def vehicle(seed: int) -> Host:
    """Return the ROM's Braitenberg vehicle, driven through the line; it may get stuck in corners."""
    weights = np.array(DEMO_WEIGHTS)

    def decide(counts: Sequence[int]) -> Speeds:
        left, right = np.trunc(np.array(counts) @ weights / DEMO_DIVISOR).astype(int) + DEMO_SPEED_PULSES
        return int(left), int(right)

    return decide


def grinder(seed: int) -> Host:
    """Return an avoider that sometimes drives ahead for 10 to 40 s, also against obstacles."""

    def push(rng: np.random.Generator) -> tuple[Speeds, int]:
        speed = int(rng.integers(3, 9))
        return (speed, speed + int(rng.integers(-1, 2))), int(rng.integers(180, 700))

    return _interrupt_avoider(seed, "grinder", (250, 900), push)


def stopper(seed: int) -> Host:
    """Return an avoider that stops, turns in place and drives without its sensors, for seconds each."""

    def ignore(rng: np.random.Generator) -> tuple[Speeds, int]:
        speed, kind = int(rng.integers(2, 9)), rng.random()
        if kind < 0.3:
            return (0, 0), int(rng.integers(10, 90))
        if kind < 0.6:
            side = int(rng.choice((-1, 1)))
            return (-side * speed, side * speed), int(rng.integers(10, 50))
        return (speed, int(rng.integers(2, 9))), int(rng.integers(15, 80))

    return _interrupt_avoider(seed, "stopper", (20, 150), ignore)


def _interrupt_avoider(
    seed: int,
    name: str,
    between: tuple[int, int],
    draw: Callable[[np.random.Generator], tuple[Speeds, int]],
) -> Host:
    """Return an avoider that holds drawn speeds for a drawn number of decisions, at drawn times."""
    rng, avoid = stream(seed, "host", name), avoider(seed)
    held_speeds: Speeds | None = None
    remaining = int(rng.integers(*between))

    def decide(counts: Sequence[int]) -> Speeds:
        nonlocal held_speeds, remaining
        remaining -= 1
        if remaining < 0 and held_speeds is None:
            held_speeds, remaining = draw(rng)
        elif remaining < 0:
            held_speeds, remaining = None, int(rng.integers(*between))
        return avoid(counts) if held_speeds is None else held_speeds

    return decide


class HostBody(NamedTuple):
    """A model of robot as hosts see it, which know a Khepera.

    Attributes:
        sensors: Its sensors in the order of a Khepera's (8,).
        idle: Counts of nothing in reach.
        speed: Speed of one pulse per 10 ms of a Khepera [register].
        cycle_ns: Least time from one decision to the next [ns].
    """

    sensors: Sequence[int]
    idle: int
    speed: int
    cycle_ns: int

    def decide(self, host: Host, counts: Sequence[int]) -> Speeds:
        """Return a host's speeds [register] for counts of proximity."""
        left, right = host([max(counts[sensor] - self.idle, 0) for sensor in self.sensors])
        return self.speed * left, self.speed * right


BODIES = {
    "khepera": HostBody(range(8), 0, 1, 0),
    "khepera4": HostBody((1, 2, 3, 3, 4, 5, 6, 0), 96, 25, 100_000_000),
}
"""Bodies by the family of the model; a Khepera IV drives at 85 to 150 mm/s, and its line is fast."""


class HostKind(NamedTuple):
    """Kind of host.

    Attributes:
        make: Function that creates a host from a seed.
        cycle_ns: Least time from one decision to the next [ns].
    """

    make: Callable[[int], Host]
    cycle_ns: int = 0


HOSTS: Mapping[str, HostKind] = {
    "avoider": HostKind(avoider),
    "wall follower": HostKind(wall_follower),
    "wanderer": HostKind(wanderer),
    "vehicle": HostKind(vehicle),
    "grinder": HostKind(grinder),
    "stopper": HostKind(stopper),
    "slow": HostKind(avoider, 400_000_000),
}
"""Kinds of hosts by name."""

TEST_HOSTS = "stopper", "slow"
"""Hosts that no shadow is tuned on, reserved for the final test."""

TUNING_HOSTS = tuple(name for name in HOSTS if name not in TEST_HOSTS)
"""Hosts for tuning."""

FIRST_TEST_SEED = 5000
"""First seed that is reserved for the final test."""


def hosts_of(seed: int) -> tuple[str, ...]:
    """Return the names of the hosts that a seed may have: all for seeds of the final test."""
    return TUNING_HOSTS if seed < FIRST_TEST_SEED else (*TUNING_HOSTS, *TEST_HOSTS)


class _Turn:
    """A turn in place, which lasts for a while and until nothing is near ahead."""

    def __init__(self) -> None:
        self._speeds = (0, 0)
        self._min_decisions = 0
        self._max_decisions = 0
        self._free_decisions = 0
        self._side = 1
        self._decisions_since = 0

    def begin(self, side: int, speed: int, decisions: int) -> Speeds:
        """Start a turn to the left (1) or right (-1); return the speeds."""
        if self._free_decisions > 0:  # The last turn was given up: a sensor may be faulty.
            return 4, 4
        # Soon after another turn the side stays the same: in corners, sides alternate.
        side = self._side = self._side if self._decisions_since < _MEMORY else side
        self._speeds = (-side * speed, side * speed)
        self._min_decisions = decisions
        self._max_decisions = _LONGEST_TURN
        return self._speeds

    def continue_turn(self, counts: Sequence[int]) -> Speeds | None:
        """Return the speeds during the turn, None after it."""
        self._min_decisions -= 1
        self._max_decisions -= 1
        self._free_decisions -= 1
        self._decisions_since += 1
        if self._min_decisions > 0 or self._max_decisions > 0:
            self._decisions_since = 0
        if self._min_decisions > 0:
            return self._speeds
        if self._max_decisions > 0:
            if max(counts[1:5]) > _NEAR // 2:
                return self._speeds
            self._max_decisions = 0
        elif self._max_decisions == 0:
            self._free_decisions = 10
        return None


def _clip(speed: int) -> int:
    return min(max(speed, -10), 10)
