"""Hypotheses of faults of motors and wheels."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from khep_twin.shadow.hypotheses import Hypothesis, shrink_and_jitter
from khep_twin.shadow.particles import Particles

SIDES = ("left", "right")

MIN_STRENGTH, MAX_STRENGTH = 0.06, 0.3
"""Share of its torque that a weak motor has: below, the gear holds it; above, the controller compensates for
it, so that nothing shows at the speeds that hosts drive."""

MAX_HOLD = 0.1
"""Largest share of its friction that a slipping tyre has: with more, little shows at hosts' speeds."""


@dataclass(frozen=True)
class _WheelFault(Hypothesis):
    """A fault of a motor or a wheel; 0 is left, 1 right."""

    channel = "wheels"
    kind: ClassVar[str]
    side: int

    @property
    def name(self) -> str:
        """Name of the fault."""
        return f"{self.kind} {SIDES[self.side]}"

    @property
    def group(self) -> str:
        """Name of the wheel."""
        return f"{SIDES[self.side]} wheel"


class StandingWheel(_WheelFault):
    """A wheel that stands: without current, so that it yields to a push, or blocked."""

    kind = "dead motor or blocked wheel"
    log_odds_against = 9.5

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Cut the current of every other motor, block the others."""
        particles.twins.strength[:, self.side] = -1
        particles.twins.strength[::2, self.side] = 0

    def end(self, particles: Particles) -> None:
        """Restore the motor."""
        particles.twins.strength[:, self.side] = 1


class WeakMotor(_WheelFault):
    """A motor with a part of its torque."""

    kind = "weak motor"
    log_odds_against = 9.5

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Weaken the motor."""
        particles.twins.strength[:, self.side] = rng.uniform(MIN_STRENGTH, MAX_STRENGTH, len(particles))

    def end(self, particles: Particles) -> None:
        """Restore the motor."""
        particles.twins.strength[:, self.side] = 1

    def jitter(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add noise to the motor's share of torque."""
        strength = particles.twins.strength[:, self.side]
        strength[:] = np.clip(shrink_and_jitter(strength, 0.01, rng), MIN_STRENGTH, MAX_STRENGTH)


class SlippingWheel(_WheelFault):
    """A wheel whose tyre slips on the floor."""

    kind = "slipping wheel"
    log_odds_against = 10.0

    def begin(self, particles: Particles, rng: np.random.Generator) -> None:
        """Make the tyre slip."""
        grip = MAX_HOLD * rng.uniform(0, 1, len(particles)) ** 2
        particles.twins.robots[f"{SIDES[self.side]}_grip"] = grip

    def end(self, particles: Particles) -> None:
        """Restore the tyre's friction."""
        particles.twins.robots[f"{SIDES[self.side]}_grip"] = 1

    def jitter(self, particles: Particles, rng: np.random.Generator) -> None:
        """Add noise to the tyre's share of friction."""
        grip = particles.twins.robots[f"{SIDES[self.side]}_grip"]
        grip[:] = np.clip(shrink_and_jitter(grip, 0.005, rng), 0, MAX_HOLD)


def wheel_faults() -> Iterator[Hypothesis]:
    """Yield the faults of motors and wheels."""
    for side in range(len(SIDES)):
        yield StandingWheel(side)
        yield WeakMotor(side)
        yield SlippingWheel(side)
