"""Scripted hosts of `stand_ins.recordings`: each decides by the robot's replies to N alone, and by its seed.

Most drive at 2 to 10 pulses per 10 ms, now and then do something that no reply asks for, and give up what
leads nowhere, so that a robot with a faulty sensor moves on as well. The vehicle is that of the ROM.
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
"""Counts of a thing to turn away from, some 25 mm ahead (assumed)."""
_LONGEST_TURN = 45
"""Decisions after which a turn is given up; half a turn at 3 pulses takes about 30."""
_MEMORY = 25
"""Decisions for which a host remembers to which side it has turned last."""


def avoider(seed: int) -> Host:
    """Return a Braitenberg vehicle that turns away from what is near, and at times at random."""
    rng = stream(seed, "host", "avoider")
    speed = int(rng.integers(5, 9))
    turn = _Turn()

    def decide(counts: Sequence[int]) -> Speeds:
        if (turning := turn.go_on(counts)) is not None:
            return turning
        left, ahead, right = counts[0] + 2 * counts[1], max(counts[2:4]), counts[5] + 2 * counts[4]
        if ahead > _NEAR or max(counts[1], counts[4]) > 2 * _NEAR:
            return turn.begin(-1 if left > right else 1, 3, int(rng.integers(4, 16)))
        if rng.random() < 1 / 150:
            return turn.begin(int(rng.choice((-1, 1))), int(rng.integers(2, 5)), int(rng.integers(5, 25)))
        bend = round((left - right) * speed / 1500)
        return _within(speed + bend), _within(speed - bend)

    return decide


def wall_follower(seed: int) -> Host:
    """Return one that keeps a wall at its side, and changes the side at times."""
    rng = stream(seed, "host", "wall follower")
    speed = int(rng.integers(4, 8))
    turn = _Turn()
    side, left_to_go = int(rng.choice((-1, 1))), int(rng.integers(300, 900))

    def decide(counts: Sequence[int]) -> Speeds:
        nonlocal side, left_to_go
        if (turning := turn.go_on(counts)) is not None:
            return turning
        left_to_go -= 1
        if left_to_go < 0:
            side, left_to_go = -side, int(rng.integers(300, 900))
            return turn.begin(side, 3, int(rng.integers(15, 35)))
        beside, oblique = (counts[0], counts[1]) if side > 0 else (counts[5], counts[4])
        if max(counts[2:4]) > _NEAR or oblique > 2 * _NEAR:
            return turn.begin(-side, 3, int(rng.integers(3, 12)))
        # Positive: towards the wall.
        pull = 0.35 if beside < 80 else (300 - beside) / 1200 - oblique / 1500
        bend = round(side * min(max(pull, -0.6), 0.4) * speed)
        return _within(speed - bend), _within(speed + bend)

    return decide


def wanderer(seed: int) -> Host:
    """Return one that drives straight, in curves, backwards, and turns in place, each for a while."""
    rng = stream(seed, "host", "wanderer")
    turn = _Turn()
    speeds, left_to_go = (0, 0), 0

    def decide(counts: Sequence[int]) -> Speeds:
        nonlocal speeds, left_to_go
        if (turning := turn.go_on(counts)) is not None:
            return turning
        left_to_go -= 1
        back = sum(speeds) < 0
        if max(counts[6:8] if back else counts[1:5]) > _NEAR:
            speeds, left_to_go = (5, 5), 20
            away = counts[0] + counts[1] > counts[4] + counts[5]
            return turn.begin(-1 if away else 1, int(rng.integers(2, 6)), int(rng.integers(6, 20)))
        if left_to_go <= 0:
            left_to_go = int(rng.integers(15, 90))
            speed, kind = int(rng.integers(4, 11)), rng.random()
            inner = int(rng.integers(2, speed + 1))
            if kind < 0.2:
                return turn.begin(int(rng.choice((-1, 1))), int(rng.integers(2, 6)), left_to_go // 3)
            if kind < 0.35 and max(counts[6:8]) < _NEAR // 2:
                speeds, left_to_go = (-inner, -inner), left_to_go // 3
            elif kind < 0.65:
                speeds = (speed, speed)
            else:
                speeds = (inner, speed) if rng.random() < 0.5 else (speed, inner)
        return speeds

    return decide


def vehicle(seed: int) -> Host:
    """Return the ROM's Braitenberg vehicle, driven through the line; it may grind in corners."""
    weights = np.array(DEMO_WEIGHTS)

    def decide(counts: Sequence[int]) -> Speeds:
        left, right = np.trunc(np.array(counts) @ weights / DEMO_DIVISOR).astype(int) + DEMO_SPEED_PULSES
        return int(left), int(right)

    return decide


def grinder(seed: int) -> Host:
    """Return an avoider that drives ahead for 10 to 40 s now and then, whatever it meets."""

    def push(rng: np.random.Generator) -> tuple[Speeds, int]:
        speed = int(rng.integers(3, 9))
        return (speed, speed + int(rng.integers(-1, 2))), int(rng.integers(180, 700))

    return _at_times(seed, "grinder", (250, 900), push)


def stopper(seed: int) -> Host:
    """Return an avoider that stops, turns on the spot and drives blindly, for seconds each."""

    def ignore(rng: np.random.Generator) -> tuple[Speeds, int]:
        speed, kind = int(rng.integers(2, 9)), rng.random()
        if kind < 0.3:
            return (0, 0), int(rng.integers(10, 90))
        if kind < 0.6:
            side = int(rng.choice((-1, 1)))
            return (-side * speed, side * speed), int(rng.integers(10, 50))
        return (speed, int(rng.integers(2, 9))), int(rng.integers(15, 80))

    return _at_times(seed, "stopper", (20, 150), ignore)


def _at_times(
    seed: int,
    name: str,
    between: tuple[int, int],
    draw: Callable[[np.random.Generator], tuple[Speeds, int]],
) -> Host:
    """Return an avoider that holds drawn speeds for a drawn number of decisions, at drawn times."""
    rng, avoid = stream(seed, "host", name), avoider(seed)
    held: Speeds | None = None
    left_to_go = int(rng.integers(*between))

    def decide(counts: Sequence[int]) -> Speeds:
        nonlocal held, left_to_go
        left_to_go -= 1
        if left_to_go < 0 and held is None:
            held, left_to_go = draw(rng)
        elif left_to_go < 0:
            held, left_to_go = None, int(rng.integers(*between))
        return avoid(counts) if held is None else held

    return decide


class HostKind(NamedTuple):
    """Kind of host.

    Attributes:
        make: Function that makes one by a seed.
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

KEPT = "stopper", "slow"
"""Hosts that no shadow is tuned on, kept for the last look."""

TUNED = tuple(name for name in HOSTS if name not in KEPT)
"""Hosts for tuning."""

FIRST_KEPT_SEED = 5000
"""Seeds from this on are kept for the last look, too."""


def hosts_of(seed: int) -> tuple[str, ...]:
    """Return the names of the hosts that a seed may have: all of them where it is kept."""
    return TUNED if seed < FIRST_KEPT_SEED else (*TUNED, *KEPT)


class _Turn:
    """A turn in place, which lasts for a while, and until nothing is near ahead."""

    def __init__(self) -> None:
        self._speeds, self._least, self._most, self._free = (0, 0), 0, 0, 0
        self._side, self._ago = 1, 0

    def begin(self, side: int, speed: int, decisions: int) -> Speeds:
        """Begin a turn to the left (1) or right (-1); return the speeds."""
        if self._free > 0:  # The last one was given up: what the sensors see may not be there.
            return 4, 4
        # Soon after another turn it goes the same way: in corners, sides alternate.
        side = self._side = self._side if self._ago < _MEMORY else side
        self._speeds, self._least, self._most = (-side * speed, side * speed), decisions, _LONGEST_TURN
        return self._speeds

    def go_on(self, counts: Sequence[int]) -> Speeds | None:
        """Return the speeds while it lasts, None then."""
        self._least, self._most, self._free = self._least - 1, self._most - 1, self._free - 1
        self._ago += 1
        if self._least > 0 or self._most > 0:
            self._ago = 0
        if self._least > 0:
            return self._speeds
        if self._most > 0:
            if max(counts[1:5]) > _NEAR // 2:
                return self._speeds
            self._most = 0
        elif self._most == 0:
            self._free = 10
        return None


def _within(speed: int) -> int:
    return min(max(speed, -10), 10)
