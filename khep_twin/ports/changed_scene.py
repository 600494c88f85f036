"""A run that goes on in another scene: what was edited stands where the edit says, all else as it was."""

import math

import mujoco

from khep_twin.errors import PlaypenError
from khep_twin.interventions.move_robot import current_playpen
from khep_twin.log.recorded import BranchPoint
from khep_twin.playpen import Block, Cylinder, Playpen, RobotEntry
from khep_twin.playpen.changes import changed_tables, no_room_for, posed, set_values
from khep_twin.simulation.physics_state import physics_state
from khep_twin.simulation.scene_transfer import place, transfer_state
from khep_twin.units import metres
from khep_twin.world import World


def take_over_state(new: World, old: World, before: Playpen, change: BranchPoint) -> None:
    """Take over the state of a world in another scene; what an edit changes stands where it says.

    Args:
        new: World of the other scene, at its start.
        old: World whose state goes on.
        before: Playpen of the old scene, at its start.
        change: Change of the scene.

    Raises:
        PlaypenError: What was changed has no room.
    """
    stands = current_playpen(old)
    # The poses of now may be outside the arena, where no file may put a thing.
    edited = posed(set_values(old.playpen, change.edits), stands, change.edits)
    if problem := no_room_for(edited, stands):
        raise PlaypenError(f"{', '.join(change.edits)}: {problem}")
    moved = changed_tables(set_values(before, change.edits), before)
    scene, placed = (new.model, new.data), dict[str, tuple[float, float, float]]()
    for index in moved.pop("robot"):
        entry = edited.robots[index]
        if _pose(entry) != _pose(stands.robots[index]):
            placed[f"khepera{index}/base"] = _pose(entry)
    for kind, indices in moved.items():
        for index in indices:
            if (entry := edited.objects[kind][index]).movable:
                placed[f"{kind}{index}"] = _pose(entry)
    mujoco.mj_resetData(new.model, new.data)
    transfer_state((old.model, old.data), scene, list(placed))
    for body, (x_mm, y_mm, heading_deg) in placed.items():
        place(scene, body, metres(x_mm), metres(y_mm), math.radians(heading_deg))
    state = old.state()._replace(physics=physics_state(*scene))
    relit = set_values(before, change.edits)
    new.set_state(state)
    if (relit.lamps, relit.lighting) != (before.lamps, before.lighting):
        new.set_lamps(edited.lamps, edited.lighting, keep_switched=True)


def _pose(entry: RobotEntry | Block | Cylinder) -> tuple[float, float, float]:
    """Return the position [mm] and heading [deg] of a robot or an object."""
    heading: float = getattr(entry, "heading_deg", getattr(entry, "angle_deg", 0.0))
    return entry.x_mm, entry.y_mm, heading
