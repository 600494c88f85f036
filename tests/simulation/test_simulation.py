"""Simulation: arguments of compiled code follow the scene."""

import numpy as np

from khep_twin.playpen import Lamp
from khep_twin.sensing.light import Bulb
from khep_twin.world import World

LAMPS = Lamp(x_mm=100, y_mm=200, power_w=3), Lamp(x_mm=400, y_mm=300, power_w=5)


def test_compiled_code_gets_the_lamps_that_have_replaced_others() -> None:
    world = World("default")
    world.simulation.step_with(lambda *_: 0, compiled=True)
    world.set_lamps(LAMPS)
    arguments = world.simulation.arguments
    assert arguments is not None
    arrays = [item for item in arguments if isinstance(item, np.ndarray) and item.dtype.names == Bulb._fields]
    bulbs = world.simulation.plain.light.bulbs
    assert len(bulbs) == len(LAMPS)
    assert [array.tolist() for array in arrays] == [[*map(tuple, bulbs)]]
