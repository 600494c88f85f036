"""Faults of motors and wheels, as hypotheses."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from khep_twin.shadow.hypotheses import Hypothesis, refined
from khep_twin.shadow.particles import Particles

SIDES = ("left", "right")

WEAKEST, STRONGEST = 0.06, 0.3
"""Parts of its torque that a weak motor gives: below, the gear holds it; above, the controller makes up for
it, so that nothing shows at the speeds that hosts drive."""

MOST_HOLD = 0.1
"""Part of its friction that a slipping tyre has at the most: with more, hosts' speeds show little."""


@dataclass(frozen=True)
class _OfWheel(Hypothesis):
    """A fault of a motor or a wheel; 0 is left, 1 right."""

    channel = "wheels"
    kind: ClassVar[str]
    side: int

    @property
    def name(self) -> str:
        """Name of the fault."""
        return f"{self.kind} {SIDES[self.side]}"

    @property
    def alike(self) -> str:
        """Name of the wheel."""
        return f"{SIDES[self.side]} wheel"


class StandingWheel(_OfWheel):
    """A wheel that stands: one without current, which yields to a push, or one that is blocked."""

    kind, rare = "dead motor or blocked wheel", 9.5

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Take the current from every other motor, block the others."""
        particles.planes.strength[:, self.side] = -1
        particles.planes.strength[::2, self.side] = 0

    def end(self, particles: Particles) -> None:
        """Give it back."""
        particles.planes.strength[:, self.side] = 1


class WeakMotor(_OfWheel):
    """A motor that gives a part of its torque."""

    kind, rare = "weak motor", 9.5

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Weaken the motor."""
        particles.planes.strength[:, self.side] = rng.uniform(WEAKEST, STRONGEST, len(particles))

    def end(self, particles: Particles) -> None:
        """Strengthen it."""
        particles.planes.strength[:, self.side] = 1

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its strength anew."""
        strength = particles.planes.strength
        strength[:, self.side] = np.clip(refined(strength[:, self.side], 0.01, rng), WEAKEST, STRONGEST)


class SlippingWheel(_OfWheel):
    """A wheel whose tyre slips on the floor."""

    kind, rare = "slipping wheel", 10.0

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Make the tyre slip."""
        hold = MOST_HOLD * rng.uniform(0, 1, len(particles)) ** 2
        particles.planes.robots[f"{SIDES[self.side]}_hold"] = hold

    def end(self, particles: Particles) -> None:
        """Make it grip."""
        particles.planes.robots[f"{SIDES[self.side]}_hold"] = 1

    def refine(self, particles: Particles, rng: np.random.Generator) -> None:
        """Draw its hold anew."""
        hold = particles.planes.robots[f"{SIDES[self.side]}_hold"]
        hold[:] = np.clip(refined(hold, 0.005, rng), 0, MOST_HOLD)


def of_wheels() -> Iterator[Hypothesis]:
    """Yield the faults of motors and wheels."""
    for side in range(len(SIDES)):
        yield StandingWheel(side)
        yield WeakMotor(side)
        yield SlippingWheel(side)
