"""Playpens: what a robot's world holds, as a TOML file in mm, degrees, grams and watts.

The models below are the format: their attributes are the file's keys, except that the arrays of tables
`[[block]]`, `[[cylinder]]`, `[[lamp]]` and `[[robot]]` become the tuples `blocks`, `cylinders`, `lamps` and
`robots`. The origin is the arena's lower left inner corner; x runs right, y up, angles counter-clockwise
from x.

A playpen is checked as a place too: centres lie inside the arena, names are used once, surfaces exist, and
robots and movable objects start clear of everything else. Fixed objects may touch and cross each other and
the walls, as mazes need it. Lamps are bulbs without posts: a run's robots and objects pass through them, but
none that reaches up to a bulb may start there.
"""

import os
from collections.abc import Iterator, Mapping
from itertools import chain, islice
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from khep_twin import toml_files
from khep_twin.errors import PlaypenError, TurretError, choices
from khep_twin.footprint import Circle, Rectangle
from khep_twin.placement import Thing, label, placement_problems
from khep_twin.rom import ROMS
from khep_twin.surfaces import BUILT_IN_SURFACES, Surface
from khep_twin.toml_files import NAME_WISH, PROBLEM_LIMIT, Name, Table
from khep_twin.turrets import find, installed
from khep_twin.units import BODY_HEIGHT, BODY_RADIUS, BULB_RADIUS

BULB_RADIUS_MM = BULB_RADIUS * 1000
"""Of a lamp [mm]."""

MIN_ANGLE_DEG, MAX_ANGLE_DEG = 10.0, 85.0
"""Of the toolbox's law of light: what meets the lamp of the calibration `khepera1` best [deg]."""


Place = Annotated[float, Field(ge=0, le=10_000)]
Size = Annotated[float, Field(ge=1, le=10_000)]
Height = Annotated[float, Field(ge=1, le=1000)]
Angle = Annotated[float, Field(ge=-360, le=360)]
Mass = Annotated[float, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(ge=0, le=3600)]
ObjectName = Annotated[Name | None, Field(description=NAME_WISH)]


class Arena(Table):
    """The floor within four walls; the walls stand around it, not on it. All in [mm]."""

    width_mm: Annotated[float, Field(ge=100, le=10_000)]
    height_mm: Annotated[float, Field(ge=100, le=10_000)]
    wall_height_mm: Height = 50.0
    wall_thickness_mm: Annotated[float, Field(ge=1, le=1000)] = 10.0
    surface: Name = "white"


class Block(Table):
    """A cuboid on the floor; its length runs at `angle_deg`. `mass_g` counts where it is movable."""

    name: ObjectName = None
    x_mm: Place
    y_mm: Place
    angle_deg: Angle = 0.0
    length_mm: Size
    width_mm: Size
    height_mm: Height
    surface: Name = "white"
    movable: bool = False
    mass_g: Mass = 20.0

    @property
    def footprint(self) -> Rectangle:
        """What it covers of the floor."""
        return Rectangle(self.x_mm, self.y_mm, self.length_mm, self.width_mm, self.angle_deg)


class Cylinder(Table):
    """An upright cylinder on the floor. `mass_g` counts where it is movable."""

    name: ObjectName = None
    x_mm: Place
    y_mm: Place
    radius_mm: Size
    height_mm: Height
    surface: Name = "white"
    movable: bool = False
    mass_g: Mass = 20.0

    @property
    def footprint(self) -> Circle:
        """What it covers of the floor."""
        return Circle(self.x_mm, self.y_mm, self.radius_mm)


class Lamp(Table):
    """A light bulb with its centre at x, y, z.

    Attributes:
        power_w: of the bulb.
        dim: part of its power that it is turned to.
        blink_period_s: from one flash to the next; 0 for a steady lamp.
        blink_duty: part of that time in which it is on.
        fade_s: that it takes to go from dark to bright, and back.
    """

    name: ObjectName = None
    x_mm: Place
    y_mm: Place
    z_mm: Height = 15.0
    power_w: Annotated[float, Field(ge=0, le=1000)]
    dim: Annotated[float, Field(ge=0, le=1)] = 1.0
    blink_period_s: Seconds = 0.0
    blink_duty: Annotated[float, Field(ge=0, le=1)] = 0.5
    fade_s: Seconds = 0.0

    @property
    def footprint(self) -> Circle:
        """What it covers of the floor."""
        return Circle(self.x_mm, self.y_mm, BULB_RADIUS_MM)


class Lighting(Table):
    """Which lamps are on, and how their light is reckoned.

    Attributes:
        mode: "all", or one at a time, the next when a robot comes near it or a wall of the arena: drawn at
            "random", or "sequenced" in the file's order.
        switch_distance_mm: how near, from the robot's edge to bulb or wall (assumed: half a robot).
        law: "optics" as measured, or "toolbox" as the Khepera Toolbox for Matlab reckoned, without shadows.
        min_angle_deg: the toolbox's, up to which a lamp off the sensor's axis loses nothing.
        max_angle_deg: the toolbox's, from which on nothing is left.
    """

    mode: Literal["all", "random", "sequenced"] = "all"
    switch_distance_mm: Annotated[float, Field(ge=0, le=10_000)] = 30.0
    law: Literal["optics", "toolbox"] = "optics"
    min_angle_deg: Annotated[float, Field(ge=0, le=180)] = MIN_ANGLE_DEG
    max_angle_deg: Annotated[float, Field(ge=1, le=180)] = MAX_ANGLE_DEG


class Robot(Table):
    """A robot at its start.

    Attributes:
        calibration: of its sensors: a name in assets/calibration, or the path of a file.
        mode: its running mode: 1 to 3 for the serial line at 9600, 19200 or 38400 baud, 0 for the
            demonstration that drives by itself, 7 for the self-test, with rom khepera2 also 8 and 9 for
            57600 and 115200 baud.
        rom: the version of its firmware.
        turrets: what is plugged on top.
        battery_used_min: minutes that it has run on its cells at start; without it, it is on the charger.
    """

    name: ObjectName = None
    x_mm: Place
    y_mm: Place
    heading_deg: Angle
    model: Literal["khepera1"] = "khepera1"
    calibration: Annotated[
        str,
        Field(min_length=1, max_length=1024, description="the name of a calibration, or the path of a file"),
    ] = "khepera1"
    mode: Annotated[int, Field(ge=0, le=15)] = 1
    rom: Literal["5.02", "4.06", "khepera2"] = "5.02"
    turrets: Annotated[tuple[str, ...], Field(max_length=32, description='names, such as ["gripper"]')] = ()
    battery_used_min: Annotated[float | None, Field(ge=0, le=1000)] = None

    @property
    def footprint(self) -> Circle:
        """What it covers of the floor, with the turrets that there are."""
        known = installed()
        reaches = [known[name].reach for name in self.turrets if name in known]
        return Circle(self.x_mm, self.y_mm, max(BODY_RADIUS, *reaches, 0.0) * 1000)


class Playpen(Table):
    """A whole playpen."""

    version: Annotated[int, Field(ge=1, le=1, description="1")]
    name: Name
    arena: Arena
    lighting: Lighting = Lighting()
    surfaces: Annotated[Mapping[Name, Surface], Field(default_factory=dict[str, Surface])]
    blocks: Annotated[tuple[Block, ...], Field(alias="block")] = ()
    cylinders: Annotated[tuple[Cylinder, ...], Field(alias="cylinder")] = ()
    lamps: Annotated[tuple[Lamp, ...], Field(alias="lamp")] = ()
    robots: Annotated[tuple[Robot, ...], Field(alias="robot")] = ()

    def surface(self, name: str) -> Surface:
        """The surface of a name, built-in or this playpen's own."""
        return BUILT_IN_SURFACES.get(name) or self.surfaces[name]

    @model_serializer(mode="wrap")
    def _without_empty_arrays(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # A file with `lamp = []` in it could not be given a [[lamp]] by hand.
        return {key: value for key, value in serialize(self).items() if value not in ([], (), {})}

    @model_validator(mode="after")
    def _is_a_place(self) -> Self:
        arena = self.arena
        placement = placement_problems(list(_things(self)), arena.width_mm, arena.height_mm)
        problems = list(
            islice(chain(_surface_problems(self), _robot_problems(self), placement), PROBLEM_LIMIT + 1)
        )
        if problems:
            raise ValueError("\n".join(problems))
        return self


def load(path_or_name: str | os.PathLike[str]) -> Playpen:
    """A playpen by the bare name of a shipped one, or by path.

    Raises:
        PlaypenError: there is none, or its file cannot be used; one line per problem.
    """
    text, source = toml_files.read("playpens", Path(path_or_name), PlaypenError)
    return parse(text, source)


def parse(text: str, source: str) -> Playpen:
    """The text of a playpen file.

    Args:
        text: in TOML.
        source: what to call the file in messages.

    Raises:
        PlaypenError: it cannot be used; one line per problem.
    """
    return toml_files.validate(Playpen, text, source, PlaypenError)


def dump(playpen: Playpen) -> str:
    """A playpen as the text of a file, always the same for the same playpen; `parse` gives it back."""
    return toml_files.dump(playpen)


def names() -> list[str]:
    """The playpens that ship with the package."""
    return toml_files.names("playpens")


def _surface_problems(playpen: Playpen) -> Iterator[str]:
    for name in playpen.surfaces:
        if name in BUILT_IN_SURFACES:
            yield f"surfaces {name}: built in; right is a name other than {', '.join(BUILT_IN_SURFACES)}"
    known = {**BUILT_IN_SURFACES, **playpen.surfaces}
    users: dict[str, Arena | Block | Cylinder] = {"arena": playpen.arena}
    users |= {label("block", number, item.name): item for number, item in enumerate(playpen.blocks, 1)}
    users |= {label("cylinder", number, item.name): item for number, item in enumerate(playpen.cylinders, 1)}
    for place, item in users.items():
        if item.surface not in known:
            yield f'{place}: surface = "{item.surface}": unknown; {choices(item.surface, known)}'


def _robot_problems(playpen: Playpen) -> Iterator[str]:
    """What of a robot's keys does not go together."""
    for number, robot in enumerate(playpen.robots, 1):
        place = label("robot", number, robot.name)
        if reason := ROMS[robot.rom].refused(robot.mode):
            yield f"{place}: mode = {robot.mode}: {reason}"
        try:
            find(robot.turrets)
        except TurretError as error:
            yield f"{place}: turrets = {list(robot.turrets)}: {error}"


def _things(playpen: Playpen) -> Iterator[Thing]:
    for number, item in enumerate(playpen.blocks, 1):
        yield Thing("block", number, item.name, item.footprint, 0, item.height_mm, item.movable)
    for number, item in enumerate(playpen.cylinders, 1):
        yield Thing("cylinder", number, item.name, item.footprint, 0, item.height_mm, item.movable)
    for number, item in enumerate(playpen.lamps, 1):
        low_mm, high_mm = item.z_mm - BULB_RADIUS_MM, item.z_mm + BULB_RADIUS_MM
        yield Thing("lamp", number, item.name, item.footprint, low_mm, high_mm, False)
    for number, item in enumerate(playpen.robots, 1):
        yield Thing("robot", number, item.name, item.footprint, 0, BODY_HEIGHT * 1000, True)
