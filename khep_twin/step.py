"""One step of the simulation: physics, sensors, control and supply, in this order.

    1. physics, with the motor voltages of the last control tick; one step of it may span several steps
    2. the sensors that are due; a Khepera's next one is converted at the pose before the physics step
    3. every 10 ms the control tick: encoders, speed, controllers, duty, voltage
    4. every 20 ms the supply is measured; below its minimum voltage a Khepera's processor stops

`advance` runs steps until code outside must act, for example for alternating lamps or turrets. It then
returns, and resumes from there when it is called again. It uses only numbers, arrays and named tuples, and
runs plain and compiled; `khep_twin.simulation` provides the data.
"""

from enum import IntEnum
from typing import Any

from khep_twin import units
from khep_twin.compilable import compilable, compilable_once, unroll
from khep_twin.robots.core import evaluate, measure_supply, sense, start, tick
from khep_twin.sensing.scene import has_warned, in_bounds, step
from khep_twin.sensing.simulated import N_CONVERSIONS, PHASE, STEPS, Simulated, StepInputs


class Reason(IntEnum):
    """Reason for which `advance` returns; those from WARNED on end a run."""

    DONE = 0  # all steps are done
    STEPPED = 1  # the physics of a step is done, with Stop.STEPPED
    TICKED = 2  # a control tick is done, with Stop.TICKED
    STOPPED = 3  # the processor of a robot has stopped
    WARNED = 4  # the physics engine has warned
    OUT_OF_BOUNDS = 5  # the physics has left its bounds
    NO_SPEED = 6  # a controller of `khep_twin.episodes.stepping` returned a speed that is not finite


class Stop(IntEnum):
    """Bits of `stops`: points at which `advance` returns to its caller."""

    STEPPED = 1  # after each step of the physics
    TICKED = 2  # after each control tick
    AWAITED = 4  # in `khep_twin.episodes.stepping`: when all robots await the caller's speeds


Phase = IntEnum("Phase", ["DONE", "STEPPED", "TICKED"], start=0)
"""Part of a step that is done: the whole step; its physics; also its sensor conversions and control tick."""

SWITCH_ON, EVALUATE = -1, -2
"""Values of `end_step` that let the core switch the robots on, or evaluate a recorded measurement: of robot n
in the order of the groups with EVALUATE - n, and its part in `stops`."""


@compilable
def advance(simulated: Simulated, inputs: StepInputs, end_step: int, stops: int) -> int:
    """Run steps until `end_step` of them are done; return DONE, or the reason for an earlier return.

    Args:
        simulated: Scene, robots and lamps.
        inputs: Lamps of all of these steps, and random draws.
        end_step: Number of steps since the start of the run.
        stops: Sum of `Stop` values at which to return earlier.
    """
    scene, timing, groups, counters = simulated.scene, simulated.timing, simulated.groups, simulated.counters
    while counters[PHASE] != Phase.DONE or counters[STEPS] < end_step:
        if counters[PHASE] == Phase.DONE:
            if counters[STEPS] % timing.steps_per_motion == 0:
                step(scene)
            counters[STEPS] += 1
            counters[PHASE] = Phase.STEPPED
            if stops & Stop.STEPPED:
                return Reason.STEPPED
        steps = counters[STEPS]
        if counters[PHASE] == Phase.STEPPED:
            _scan(groups, simulated, inputs, (steps - 1) * timing.conversions)
            counters[PHASE] = Phase.TICKED
            if steps % timing.steps_per_tick == 0:
                if not in_bounds(scene, timing.limit):
                    return Reason.OUT_OF_BOUNDS
                if _tick(groups, simulated, inputs, steps * timing.step_ns) or stops & Stop.TICKED:
                    return Reason.TICKED
        counters[PHASE] = Phase.DONE
        if steps % timing.steps_per_supply == 0:
            if has_warned(scene):
                return Reason.WARNED
            if _measure_supplies(groups, simulated, steps * timing.step_ns):
                return Reason.STOPPED
    return Reason.DONE


@compilable_once
def switch_on(simulated: Simulated, inputs: StepInputs) -> int:
    """Run the scan before time 0, which fills all registers; return a reason as `advance` does."""
    scene, timing, groups = simulated.scene, simulated.timing, simulated.groups
    # MuJoCo's rangefinders, which turrets may need, have values from the second step on.
    step(scene)
    for first in range(-units.SCAN_STEPS, 0, timing.conversions):
        step(scene)
        _scan(groups, simulated, inputs, first)
    stopped = _start(groups, simulated, inputs)
    if not in_bounds(scene, timing.limit):
        return Reason.OUT_OF_BOUNDS
    if has_warned(scene):
        return Reason.WARNED
    return Reason.STOPPED if stopped else Reason.DONE


@compilable_once
def _scan(groups: Any, simulated: Simulated, inputs: StepInputs, first: int) -> None:
    """Run the sensors of all robots in a step; `first` is the number of its first conversion."""
    for group in unroll(groups):
        for i in range(len(group)):
            sense(group[i], simulated, inputs, first)
    simulated.counters[N_CONVERSIONS] += simulated.timing.conversions


@compilable
def _tick(groups: Any, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run the control period of all robots; return True if code outside must act for one of them."""
    must_return = False
    for group in unroll(groups):
        for i in range(len(group)):
            must_return = tick(group[i], simulated, inputs, time_ns) or must_return
    return must_return


@compilable
def _measure_supplies(groups: Any, simulated: Simulated, time_ns: int) -> bool:
    """Measure the supplies of all robots; return True if a processor has stopped."""
    stopped = False
    for group in unroll(groups):
        for i in range(len(group)):
            stopped = measure_supply(group[i], simulated, time_ns) or stopped
    return stopped


@compilable
def _start(groups: Any, simulated: Simulated, inputs: StepInputs) -> bool:
    """Start the run of all robots; return True if a processor lacks voltage."""
    stopped = False
    for group in unroll(groups):
        for i in range(len(group)):
            stopped = start(group[i], simulated, inputs) or stopped
    return stopped


@compilable_once
def evaluate_recorded(groups: Any, simulated: Simulated, inputs: StepInputs, robot: int, part: int) -> None:
    """Evaluate a recorded measurement of a robot, by its number in the order of the groups."""
    first = 0
    for group in unroll(groups):
        if first <= robot < first + len(group):
            evaluate(group[robot - first], simulated, inputs, part)
        first += len(group)
