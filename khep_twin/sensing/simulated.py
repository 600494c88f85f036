"""Scene, robots and lamps of a simulation, as the stepping core and the functions of models receive them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.light import Light
from khep_twin.sensing.noise import Tables

STEPS, PHASE, FIRST_POWERS_STEP, N_CONVERSIONS = 0, 1, 2, 3
"""Indices in `Simulated.counters`: steps done, `Phase` of the step, step of the first row of
`StepInputs.powers`, and number of sensor conversions of each robot so far, which indexes its noise."""
N_COUNTERS = 4


class Timing(NamedTuple):
    """Durations in steps, and bounds.

    Attributes:
        step_ns: Step [ns].
        steps_per_motion: Steps per physics step, which runs before the first of them.
        conversions: Sensor conversions in each step.
        steps_per_tick: Steps per tick of the control loops.
        steps_per_supply: Steps per measurement of the supply.
        limit: Largest coordinate [m].
    """

    step_ns: int
    steps_per_motion: int
    conversions: int
    steps_per_tick: int
    steps_per_supply: int
    limit: float


class Simulated(NamedTuple):
    """Scene, robots and lamps of a simulation.

    Attributes:
        scene: Scene.
        timing: Divisions of time.
        light: Lamps of the scene.
        groups: States of the scene's robots, one sequence for each class of state.
        counters: Counters of the simulation (N_COUNTERS,).
    """

    scene: Any
    timing: Timing
    light: Light
    groups: tuple[Sequence[Any], ...]
    counters: Vector[int]


class StepInputs(NamedTuple):
    """Powers of the lamps for a range of steps, and the distributions of random draws.

    Attributes:
        powers: Powers of the lamps (n_steps or 1, n_lamps) [W].
        tables: Quantiles of the random draws, see `sensing.noise`.
    """

    powers: Sequence[Sequence[float]]
    tables: Tables


@compilable
def powers_row(simulated: Simulated, inputs: StepInputs) -> int:
    """Return the row of the lamps' powers in the present step."""
    counters = simulated.counters
    return 0 if len(inputs.powers) == 1 else counters[STEPS] - 1 - counters[FIRST_POWERS_STEP]
