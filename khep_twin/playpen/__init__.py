"""Playpens: contents of a robot's world, as a TOML file in mm, degrees, grams and watts.

The models of `parts` are the format: their attributes are the file's keys, except that the arrays of
tables `[[block]]`, `[[cylinder]]`, `[[wall]]`, `[[patch]]`, `[[lamp]]`, `[[spot]]` and `[[robot]]` become the
tuples `blocks` … `robots`. The origin is the arena's lower left inner corner; x runs right, y up, angles
counter-clockwise from x.

A playpen is also checked for placement: centres lie inside the arena, names are unique, surfaces exist, and
robots and movable objects start clear of everything else. Fixed objects may touch and cross each other and
the walls, as in mazes. Lamps are bulbs without posts: robots and objects pass through them during a run, but
none that reaches up to a bulb may start there.
"""

from khep_twin.playpen.model import Playpen, dump, edited, load, names, parse, place_robots, schema
from khep_twin.playpen.parts import (
    BULB_RADIUS_MM,
    Arena,
    Block,
    Cylinder,
    Lamp,
    Lighting,
    Patch,
    RadioChannel,
    RobotEntry,
    Spot,
    Wall,
)

__all__ = [
    "BULB_RADIUS_MM",
    "Arena",
    "Block",
    "Cylinder",
    "Lamp",
    "Lighting",
    "Patch",
    "Playpen",
    "RadioChannel",
    "RobotEntry",
    "Spot",
    "Wall",
    "dump",
    "edited",
    "load",
    "names",
    "parse",
    "place_robots",
    "schema",
]
