"""Playpens: the contents of a robot's world, as TOML files in mm, degrees, grams and watts.

The models of `parts` define the format: their attributes are the file's keys, except that the arrays of
tables `[[block]]`, `[[cylinder]]`, `[[wall]]`, `[[patch]]`, `[[lamp]]`, `[[spot]]` and `[[robot]]` become the
tuples `blocks` … `robots`. The origin is the arena's lower left inner corner; x runs right, y up, angles
counter-clockwise from x.

A playpen is also checked as a whole: centres lie inside the arena, names are unique, surfaces exist, and
robots and movable objects do not overlap any other part at the start. Fixed objects may touch and cross each
other and the walls, as in mazes. Lamps are bulbs without posts: robots and objects pass through them during a
run, but must not overlap a bulb at the start.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.playpen.model import Playpen as Playpen
    from khep_twin.playpen.model import PlaypenLike as PlaypenLike
    from khep_twin.playpen.model import dump as dump
    from khep_twin.playpen.model import edited as edited
    from khep_twin.playpen.model import names as names
    from khep_twin.playpen.model import parse as parse
    from khep_twin.playpen.model import place_robots as place_robots
    from khep_twin.playpen.model import schema as schema
    from khep_twin.playpen.parts import BULB_RADIUS_MM as BULB_RADIUS_MM
    from khep_twin.playpen.parts import Arena as Arena
    from khep_twin.playpen.parts import Block as Block
    from khep_twin.playpen.parts import Cylinder as Cylinder
    from khep_twin.playpen.parts import Lamp as Lamp
    from khep_twin.playpen.parts import Lighting as Lighting
    from khep_twin.playpen.parts import Patch as Patch
    from khep_twin.playpen.parts import RadioChannel as RadioChannel
    from khep_twin.playpen.parts import RobotEntry as RobotEntry
    from khep_twin.playpen.parts import Spot as Spot
    from khep_twin.playpen.parts import Wall as Wall
    from khep_twin.playpen.starts import Start as Start
    from khep_twin.playpen.starts import anywhere as anywhere
    from khep_twin.playpen.starts import at_spots as at_spots
    from khep_twin.playpen.starts import at_start as at_start
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
