"""Faults of a simulation, each from a separate random stream: to leave one out changes no other."""

import random
from collections import Counter
from collections.abc import Collection

CLOCK, HALF, BURST = "clock", "half-line", "burst"
"""Names of kinds of faults: the wall clock is set; a host leaves amid a line; a burst of requests."""

UNNOTICED = frozenset({CLOCK, HALF, BURST})
"""Kinds of faults that must disturb nobody."""

HARMLESS = UNNOTICED | {"exception", "interrupt", "terminate", "quick", "rogue", "vanish"}
"""Kinds of faults that must not disturb a host which has the line."""

_MASK = (1 << 64) - 1


def mixed(*words: int | str) -> int:
    """Return 64 bits that depend on all words, in any process the same."""
    state = 0
    for word in words:
        number = word if isinstance(word, int) else int.from_bytes(word.encode(), "little")
        while True:
            # splitmix64 (Steele, Lea and Flood 2014), over each 64 bits of the word.
            state = (state + (number & _MASK) + 0x9E3779B97F4A7C15) & _MASK
            state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
            state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
            state ^= state >> 31
            number >>= 64
            if number <= 0:
                break
    return state


class Faults:
    """Faults of one simulation, with rates that vary by seed: most seeds have few kinds, and many of those.

    Args:
        seed: Seed of the simulation.
        kept: Names of the faults that happen where they would; None for all.

    Attributes:
        happened: Names of those that have happened, in order.
    """

    def __init__(self, seed: int, allowed: Collection[str] | None = None) -> None:
        self.happened: list[str] = []
        self._seed = seed
        self._allowed = None if allowed is None else frozenset(allowed)
        self._rates: dict[str, float] = {}
        self._opportunities: Counter[tuple[str, str]] = Counter()
        self._keys: dict[tuple[str, str], int] = {}

    @property
    def kinds(self) -> set[str]:
        """Kinds of those that have happened and may disturb somebody."""
        return self._kinds(0) - UNNOTICED

    def disturbing(self, first: int) -> set[str]:
        """Return the kinds of those from the number `first` on that may disturb a host which has the line."""
        return self._kinds(first) - HARMLESS

    def _kinds(self, first: int) -> set[str]:
        return {name.partition("/")[0] for name in self.happened[first:]}

    def rate(self, kind: str, max_rate: float) -> float:
        """Return the rate of a kind of fault in this simulation: 0 for half of all seeds."""
        if kind not in self._rates:
            rng = random.Random(mixed(self._seed, "rate", kind))
            self._rates[kind] = 0.0 if rng.random() < 0.5 else max_rate * 10 ** rng.uniform(-2, 0)
        return self._rates[kind]

    def happens(self, kind: str, place: str, max_rate: float) -> bool:
        """Return whether a fault happens at this opportunity.

        Args:
            kind: Kind of the fault, for example "stall".
            place: Place of it, for example the name of a process.
            max_rate: Highest probability of this kind for any seed.
        """
        key = kind, place
        self._opportunities[key] = number = self._opportunities[key] + 1
        rate = self.rate(kind, max_rate)
        if not rate:
            return False
        if key not in self._keys:
            self._keys[key] = mixed(self._seed, kind, place)
        if mixed(self._keys[key], number) >= rate * 2**64:
            return False
        name = f"{kind}/{place}/{number}"
        if self._allowed is not None and name not in self._allowed:
            return False
        self.happened.append(name)
        return True

    def drawn(self, kind: str, place: str) -> random.Random:
        """Return the generator for the details of the fault that has just happened there."""
        return random.Random(mixed(self._seed, kind, place, self._opportunities[kind, place], "details"))
