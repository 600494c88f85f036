"""The Khepera Toolbox's lamps: RoboRunner's Place Lamp, Remove Lamp and Lamp Control, for programs.

    open_default()
    place_lamp(450, 250)                # 7 W, the lamp of the toolbox's light model
    move_lamp(450, 250, 450, 400)       # the lamp nearest to a position
    remove_lamp(450, 400)
    lamp_control("sequenced")

They change the playpen that is open, at any time, and convert all sensors.
"""

import math
from typing import SupportsFloat

from khep_twin.errors import PlaypenError
from khep_twin.interventions.move_robot import scan
from khep_twin.interventions.switching import set_lamps
from khep_twin.lab.experiment.start_poses import nearest_lamp, with_lighting, without_nearest_lamp
from khep_twin.playpen import Lamp, Playpen
from khep_twin.toolbox.simulator import get_open_playpen

POWER_W = 7.0
"""Power of the lamp for which the toolbox's light model was measured [W]."""


def place_lamp(
    xabs: SupportsFloat, yabs: SupportsFloat, power_w: SupportsFloat = POWER_W, z: SupportsFloat = 15.0
) -> None:
    """Place a lamp in the playpen, RoboRunner's Place Lamp.

    Args:
        xabs: Position of the bulb's centre in x, from the arena's lower left inner corner [mm].
        yabs: Position in y, likewise [mm].
        power_w: Power of the bulb [W].
        z: Height of the bulb's centre above the floor [mm].

    Raises:
        PlaypenError: It lies outside the arena, or its values are not allowed.
    """
    lamp = Lamp.model_construct(x_mm=float(xabs), y_mm=float(yabs), z_mm=float(z), power_w=float(power_w))
    playpen = _current_playpen()
    _set_lamps("place_lamp", playpen.model_copy(update={"lamps": (*playpen.lamps, lamp)}))


def move_lamp(xabs: SupportsFloat, yabs: SupportsFloat, to_x: SupportsFloat, to_y: SupportsFloat) -> None:
    """Move the lamp that is nearest to a position to another position; both as for `place_lamp`.

    Raises:
        PlaypenError: There is no lamp, or its new position lies outside the arena.
    """
    playpen = _current_playpen()
    nearest = nearest_lamp(playpen, float(xabs), float(yabs))
    moved = nearest.model_copy(update={"x_mm": float(to_x), "y_mm": float(to_y)})
    lamps = tuple(moved if lamp is nearest else lamp for lamp in playpen.lamps)
    _set_lamps("move_lamp", playpen.model_copy(update={"lamps": lamps}))


def remove_lamp(xabs: SupportsFloat, yabs: SupportsFloat) -> None:
    """Remove the lamp that is nearest to a position [mm], RoboRunner's Remove Lamp.

    Raises:
        PlaypenError: There is no lamp.
    """
    _set_lamps("remove_lamp", without_nearest_lamp(_current_playpen(), float(xabs), float(yabs)))


def lamp_control(mode: str) -> None:
    """Switch the lamps: "all", or one by one, "random" or "sequenced", RoboRunner's Lamp Control.

    The mode starts immediately; "off" removes all lamps.

    Raises:
        PlaypenError: The mode is unknown.
    """
    _set_lamps("lamp_control", with_lighting(_current_playpen(), mode))


def _current_playpen() -> Playpen:
    return get_open_playpen().twin.world.playpen


def _set_lamps(command: str, playpen: Playpen) -> None:
    """Replace the lamps and the lighting of the playpen that is open."""
    world = get_open_playpen().twin.world
    settings = [(lamp.x_mm, lamp.y_mm, lamp.z_mm, lamp.power_w) for lamp in playpen.lamps]
    if invalid := next((position for position in settings if not all(map(math.isfinite, position))), None):
        raise PlaypenError(f"{command}: x, y, z, power = {invalid}: expected finite numbers")
    try:
        set_lamps(world, playpen.lamps, playpen.lighting)
    except PlaypenError as error:
        raise PlaypenError(f"{command}: {error}") from None
    scan(world)
