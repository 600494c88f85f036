"""Parts of a playpen file: one class per table, with the table's keys as attributes."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Field, field_serializer

from khep_twin.board.rom import Rom
from khep_twin.board.turrets import installed_turrets
from khep_twin.files.toml_files import NAME_RULE, Name, OneOf, TomlTable
from khep_twin.playpen.footprint import Circle, Footprint, Rectangle
from khep_twin.playpen.polygon import Point, area, edges, find_crossing, find_inner_walls, wall_pieces
from khep_twin.playpen.stripes import Stripes
from khep_twin.playpen.surfaces import Colour
from khep_twin.robots.body import Body
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import DEFAULT, find_model, installed_models, installed_roms
from khep_twin.units import BULB_RADIUS, ROOM_LUX

BULB_RADIUS_MM = BULB_RADIUS * 1000
"""Radius of a lamp's bulb [mm]."""

SHORTEST_BLINK_S = 0.01
"""Shortest blink period [s]; lamps change at the physics step of 2.5 ms."""

MIN_ANGLE_DEG, MAX_ANGLE_DEG = 10.0, 85.0
"""Angles of the toolbox's light model, fitted to the lamp of the calibration `khepera1` [deg]."""


Coordinate = Annotated[float, Field(ge=0, le=10_000)]
Size = Annotated[float, Field(ge=1, le=10_000)]
Height = Annotated[float, Field(ge=1, le=1000)]
Angle = Annotated[float, Field(ge=-360, le=360)]
Mass = Annotated[float, Field(ge=1, le=10_000)]
Seconds = Annotated[float, Field(ge=0, le=3600)]
CoordinatePair = Annotated[tuple[Coordinate, Coordinate], Field(description="x and y, from 0 to 10000")]
Time = Annotated[float, Field(ge=0, le=1e6)]
TimePair = Annotated[tuple[Time, Time], Field(description="two times from 0 to 1000000")]
ObjectName = Annotated[Name | None, Field(description=NAME_RULE)]


class Arena(TomlTable):
    """The floor within its walls; the walls stand around it, not on it. All lengths in [mm].

    Attributes:
        width_mm: Size along x.
        height_mm: Size along y.
        outline_mm: Corners of a non-rectangular floor, in order, within width and height.
        wall_height_mm: Height of the walls.
        wall_thickness_mm: Thickness of the walls.
        table: Whether it is a table: without walls, 100 mm above the ground, on which robots may fall.
        surface: Surface of the walls.
        stripes: Stripes on the inner sides of the walls.
    """

    width_mm: Annotated[float, Field(ge=100, le=10_000)]
    height_mm: Annotated[float, Field(ge=100, le=10_000)]
    outline_mm: Annotated[
        tuple[CoordinatePair, ...],
        Field(max_length=200, description="corners, such as [[0, 0], [600, 0], [300, 500]]"),
    ] = ()
    wall_height_mm: Height = 50.0
    wall_thickness_mm: Annotated[float, Field(ge=1, le=1000)] = 10.0
    table: bool = False
    surface: Name = "white"
    stripes: Stripes = ()

    @property
    def corners(self) -> tuple[Point, ...]:
        """Corners of the floor, counter-clockwise for a rectangle."""
        width, height = self.width_mm, self.height_mm
        return self.outline_mm or ((0, 0), (width, 0), (width, height), (0, height))

    def outline_problems(self) -> Iterator[str]:
        """Yield the problems of the corners, one line each."""
        corners = self.outline_mm
        if not corners:
            return
        if len(corners) < 3:
            yield f"arena: outline_mm: {len(corners)} corners; expected 3 to 200"
            return
        for number, (x_mm, y_mm) in enumerate(corners, 1):
            for value, limit in ((x_mm, self.width_mm), (y_mm, self.height_mm)):
                if value > limit:
                    yield (
                        f"arena: outline_mm {number}: {value:g}: outside width and height; "
                        f"expected 0 to {limit:g}"
                    )
        for number, (start, end) in enumerate(edges(corners, closed=True), 1):
            if start == end:
                yield f"arena: outline_mm {number}: same as the next corner; expected each corner once"
                return
        if pair := find_crossing(corners):
            yield (
                f"arena: outline_mm: edges {pair[0]} and {pair[1]} meet; expected an outline that "
                "does not cross or touch itself"
            )
        elif abs(area(corners)) < 10_000:
            yield f"arena: outline_mm: {abs(area(corners)):g} mm2; expected at least 10000"
        else:
            for number in find_inner_walls(corners, self.wall_thickness_mm):
                yield (
                    f"arena: outline_mm: the wall after corner {number} is thicker than the room behind it; "
                    "expected thinner walls or more room"
                )


class Wall(TomlTable):
    """A free-standing wall along a line on the floor.

    Attributes:
        points_mm: Points where it starts, turns and ends.
        closed: True if it continues from the last point to the first.
        thickness_mm: Thickness, half of it to either side of the line.
        stripes: Stripes on all sides of each straight piece, and around each corner.
    """

    name: ObjectName = None
    points_mm: Annotated[
        tuple[CoordinatePair, ...],
        Field(
            min_length=2, max_length=1000, description="at least two points, such as [[100, 100], [100, 300]]"
        ),
    ]
    closed: bool = False
    thickness_mm: Annotated[float, Field(ge=1, le=1000)] = 10.0
    height_mm: Height = 50.0
    surface: Name = "white"
    stripes: Stripes = ()

    @property
    def movable(self) -> bool:
        """False, as walls are fixed."""
        return False

    @property
    def footprints(self) -> tuple[Footprint, ...]:
        """Areas of the floor that it covers, piece by piece."""
        return tuple(wall_pieces(self.points_mm, self.thickness_mm, closed=self.closed))


class _PlacedTable(TomlTable):
    """A part at a place in the arena."""

    name: ObjectName = None
    x_mm: Coordinate
    y_mm: Coordinate


class Patch(_PlacedTable):
    """A part of the floor with another surface: a disc, or a rectangle at an angle. No sensor sees it."""

    radius_mm: Size | None = None
    length_mm: Size | None = None
    width_mm: Size | None = None
    angle_deg: Angle = 0.0
    surface: Name = "black"

    @property
    def footprint(self) -> Footprint:
        """Area of the floor that it covers."""
        if self.radius_mm is not None:
            return Circle(self.x_mm, self.y_mm, self.radius_mm)
        return Rectangle(self.x_mm, self.y_mm, self.length_mm or 0.0, self.width_mm or 0.0, self.angle_deg)

    @property
    def is_one_shape(self) -> bool:
        """True if it is either a disc or a rectangle."""
        sides = [self.length_mm is not None, self.width_mm is not None]
        return not any(sides) if self.radius_mm is not None else all(sides)


class Spot(TomlTable):
    """A named start pose of robots."""

    name: Annotated[Name, Field(description=NAME_RULE)]
    x_mm: Coordinate
    y_mm: Coordinate
    heading_deg: Angle


class Block(_PlacedTable):
    """A cuboid on the floor, with its length along `angle_deg`. `mass_g` applies if it is movable.

    Attributes:
        stripes: Stripes on its four sides.
        ramp: Whether it is a ramp, which rises along its length from the floor to its height; the infrared
            sensors do not see it.
    """

    angle_deg: Angle = 0.0
    length_mm: Size
    width_mm: Size
    height_mm: Height
    surface: Name = "white"
    stripes: Stripes = ()
    movable: bool = False
    mass_g: Mass = 20.0
    ramp: bool = False

    @property
    def footprint(self) -> Rectangle:
        """Area of the floor that it covers."""
        return Rectangle(self.x_mm, self.y_mm, self.length_mm, self.width_mm, self.angle_deg)

    @property
    def footprints(self) -> tuple[Footprint, ...]:
        """Area of the floor that it covers, in one piece."""
        return (self.footprint,)


class Cylinder(_PlacedTable):
    """An upright cylinder on the floor. `mass_g` applies if it is movable.

    Attributes:
        stripes: Stripes around it.
    """

    radius_mm: Size
    height_mm: Height
    surface: Name = "white"
    stripes: Stripes = ()
    movable: bool = False
    mass_g: Mass = 20.0

    @property
    def angle_deg(self) -> float:
        """Angle of 0, as a cylinder is rotationally symmetric."""
        return 0.0

    @property
    def footprint(self) -> Circle:
        """Area of the floor that it covers."""
        return Circle(self.x_mm, self.y_mm, self.radius_mm)

    @property
    def footprints(self) -> tuple[Footprint, ...]:
        """Area of the floor that it covers, in one piece."""
        return (self.footprint,)


Obstacle = Block | Cylinder | Wall
"""A part that stands on the floor."""


class Lamp(_PlacedTable):
    """A light bulb with its centre at x, y, z.

    Attributes:
        power_w: Power of the bulb.
        rgb: Colour, for rendering only.
        on_s: Intervals in which it is on, e.g. [[0, 10], [30, 40]]; always, if empty.
        dim: Dimming factor of its power.
        blink_period_s: Time from one flash to the next; 0 for a steady lamp.
        blink_duty: Fraction of the blink period in which it is on.
        fade_s: Time from dark to bright, and from bright to dark.
        flicker: Amplitude of its flicker, as a fraction of its light (`Lighting.mains_hz`).
    """

    z_mm: Height = 15.0
    power_w: Annotated[float, Field(ge=0, le=1000)]
    rgb: Colour = (255, 217, 77)
    on_s: Annotated[
        tuple[TimePair, ...], Field(max_length=1000, description="intervals, such as [[0, 10], [30, 40]]")
    ] = ()
    dim: Annotated[float, Field(ge=0, le=1)] = 1.0
    blink_period_s: Seconds = 0.0
    blink_duty: Annotated[float, Field(ge=0, le=1)] = 0.5
    fade_s: Seconds = 0.0
    flicker: Annotated[float, Field(ge=0, le=1)] = 0.0

    @property
    def footprint(self) -> Circle:
        """Area of the floor that it covers."""
        return Circle(self.x_mm, self.y_mm, BULB_RADIUS_MM)


LightingMode = Literal["all", "random", "sequenced"]


class Lighting(TomlTable):
    """Selection of the active lamps, and model of their light.

    Attributes:
        mode: "all", or one lamp at a time, "random" or "sequenced" in the file's order; the next one when a
            robot comes near the active lamp or a wall of the arena.
        switch_distance_mm: Distance from robot's edge to bulb or wall at which the lamps switch (assumed:
            half a robot); 0 for never.
        law: "optics" as measured, or "toolbox" as in the Khepera Toolbox for Matlab, without shadows.
        min_angle_deg: Angle from the sensor's axis up to which the toolbox's law attenuates no light.
        max_angle_deg: Angle from the sensor's axis from which the toolbox's law passes no light.
        mains_hz: Frequency of the mains; lamps flicker twice in each of its periods.
        room_lux: Illuminance by the room's ambient light, for vision turrets [lx].
    """

    mode: LightingMode = "all"
    switch_distance_mm: Annotated[float, Field(ge=0, le=10_000)] = 30.0
    law: Literal["optics", "toolbox"] = "optics"
    min_angle_deg: Annotated[float, Field(ge=0, le=180)] = MIN_ANGLE_DEG
    max_angle_deg: Annotated[float, Field(ge=1, le=180)] = MAX_ANGLE_DEG
    mains_hz: Annotated[float, Field(ge=10, le=100)] = 50.0
    room_lux: Annotated[float, Field(ge=0, le=100_000)] = ROOM_LUX


class RadioChannel(TomlTable):
    """Channel that the robots' radio turrets share.

    Attributes:
        range_mm: Distance between two robots' centres up to which a transmission arrives (assumed: the
            largest arena's width).
        loss: Probability that a transmission is lost on its way to a receiver (none "in a good
            environment": K-Team's manual of the radio base).
        air_time_ms: Duration of a transmission, rounded up to control periods of 10 ms (assumed: 16
            bytes and as many as 12 around them at the 9600 baud of the radio base).
    """

    range_mm: Annotated[float, Field(ge=0, le=100_000)] = 10_000.0
    loss: Annotated[float, Field(ge=0, le=1)] = 0.0
    air_time_ms: Annotated[float, Field(gt=0, le=10_000)] = 30.0


def model_defaults(model: str) -> Mapping[str, str]:
    """Return the keys of a robot that its model determines, if a file omits them."""
    robot_model = find_model(model)
    return {"calibration": robot_model.calibration, "rom": next(iter(robot_model.roms))}


class RobotEntry(_PlacedTable):
    """A robot at its start.

    Attributes:
        model: Model; it determines the defaults of calibration and rom.
        calibration: Calibration of its sensors: a name in assets/calibration, that of its model's usual one,
            or the path of a file.
        mode: Running mode: 1 to 3 for the serial line at 9600, 19200 or 38400 baud, 0 for the
            demonstration in which the robot drives, 7 for the self-test, and 8 and 9 with rom khepera2 for
            57600 and 115200 baud.
        spots: Names of spots; it starts at one that the seed selects, and needs no x, y and heading.
        rom: Version of its firmware.
        turrets: Turrets plugged on top.
        battery_used_min: Minutes of operation on its battery before the start; on the charger if not given.
    """

    heading_deg: Angle
    spots: Annotated[
        tuple[str, ...], Field(max_length=1000, description='names of spots, such as ["a", "b"]')
    ] = ()
    model: Annotated[str, OneOf(installed_models)] = DEFAULT
    calibration: Annotated[
        str,
        Field(min_length=1, max_length=1024, description="the name of a calibration, or the path of a file"),
    ] = "khepera1"
    mode: Annotated[int, Field(ge=0, le=15)] = 1
    rom: Annotated[str, OneOf(installed_roms)] = "5.02"
    turrets: Annotated[tuple[str, ...], Field(max_length=32, description='names, such as ["gripper"]')] = ()
    battery_used_min: Annotated[float | None, Field(ge=0, le=1000)] = None

    @field_serializer("calibration")
    def _name_calibration(self, calibration: str) -> str:
        """Return the bare name of the model's usual calibration, whose path differs by machine."""
        model = self.robot_model
        return model.calibration_name if calibration == model.calibration else calibration

    @property
    def robot_model(self) -> RobotModel:
        """Its model."""
        return find_model(self.model)

    @property
    def firmware(self) -> Rom:
        """Version of its firmware, one of its model's."""
        return self.robot_model.roms[self.rom]

    @property
    def body(self) -> Body:
        """Body of its model."""
        return self.robot_model.body

    @property
    def footprint(self) -> Circle:
        """Area of the floor that it covers, with its turrets."""
        turrets = installed_turrets()
        radii = [turrets[name].reach for name in self.turrets if name in turrets]
        return Circle(self.x_mm, self.y_mm, max([self.body.radius, *radii]) * 1000)
