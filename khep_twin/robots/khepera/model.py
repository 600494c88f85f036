"""The models Khepera and Khepera II; sources as in `khep_twin.units`."""

import re
from collections.abc import Sequence
from dataclasses import replace
from operator import mul

from khep_twin.board.kernel import (
    AMBIENT,
    DEMO_DIVISOR,
    DEMO_SPEED_PULSES,
    DEMO_WEIGHTS,
    LEFT,
    N_REGISTERS,
    PROXIMITY,
    RIGHT,
    SETPOINTS,
    SPEEDS,
    Board,
    Mode,
    Wheel,
)
from khep_twin.board.protocol import MOTION_COMMANDS
from khep_twin.board.rom import ROMS
from khep_twin.robots.body import Body
from khep_twin.robots.model import Bench, Columns, Dialect, Feature, Interface, Read, RobotModel, bars_of
from khep_twin.units import (
    BODY_HEIGHT,
    BODY_RADIUS,
    COUNTS_LIMIT,
    IDLE_CURRENT,
    K213_PIXELS,
    MASS,
    PULSES_PER_TURN,
    SENSOR_HEIGHT,
    SENSOR_LABELS,
    SENSOR_POSITIONS,
    SUPPORT_POSITION,
    WHEEL_BASE,
    WHEEL_RADIUS,
    WHEEL_WIDTH,
    Sensor,
)

_SIDES = ("left", "right")
_SENSORS = tuple(name.replace(" ", "_") for name in SENSOR_LABELS)
_SENSOR_COLUMNS = {
    kind: tuple((f"{kind}_{name}", "counts") for name in _SENSORS) for kind in ("proximity", "ambient")
}
_TRAILING_REGISTERS = (Board.PROXIMITY, Board.AMBIENT, Board.SUPPLY, Board.CURRENT)
_REGISTERS = (
    *(f"{side}_{register.name.lower()}" for side in _SIDES for register in Wheel),
    *(register.name.lower() for register in Board if register not in _TRAILING_REGISTERS),
    *(f"{kind}_{name}" for kind in ("proximity", "ambient") for name in _SENSORS),
    *("supply", "current"),
)
_CHANNELS: dict[str, Columns] = {
    "pose": (("x_m", "m"), ("y_m", "m"), ("heading_rad", "rad")),
    **_SENSOR_COLUMNS,
    "speed": tuple(
        (f"{quantity}_{side}", "pulses/10 ms") for quantity in ("speed", "speed_setpoint") for side in _SIDES
    ),
    "position": tuple((f"position_{side}", "pulses") for side in _SIDES),
    "duty": tuple((f"duty_{side}", "1/255") for side in _SIDES),
    "leds": (("led_lateral", "1 when lit"), ("led_frontal", "1 when lit")),
    "vision": tuple((f"vision_{pixel}", "grey") for pixel in range(K213_PIXELS)),
    "registers": tuple((f"register_{name}", "") for name in _REGISTERS),
}

_BARS = bars_of(dark=500, speed=20)
"""Bars of `khepbase` of the Khepera Toolbox for Matlab, with its limits."""

_DIALECT = Dialect(
    robot_name="a Khepera",
    host_class="khep_twin.host.Khepera",
    versions_reply=re.compile(r"b,\d+\.[\d.]*,\d[\d.]*"),
    probes=("B", "H", "E", "K"),
    stop_requests=("D,0,0",),
    moving=(*MOTION_COMMANDS, "run", "restart"),
    baud=9600,
    reads={
        "proximity": Read("N", len(PROXIMITY), PROXIMITY, range(len(PROXIMITY))),
        "ambient": Read("O", len(AMBIENT), AMBIENT, range(len(AMBIENT))),
        "speed": Read("E", 2, SPEEDS, range(2)),
        # Its counters differ from the encoders' by a constant, which command G sets.
        "position": Read("H", 2, (LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER), range(2)),
    },
)

_PARTS = {
    "core": "khep_twin.robots.khepera.core:CORE",
    "robot": "khep_twin.robots.khepera.robot:KheperaRobot",
    "host": "khep_twin.host.khepera:Khepera",
    "conformance": "khep_twin.lab.conformance.port.catalogue:KHEPERA_CHECKS",
}


def _vehicle_speeds(proximity: Sequence[int]) -> tuple[int, int]:
    """Return the speeds of the Braitenberg vehicle: proximity x weights / 400 + 10."""
    left, right = (sum(map(mul, weights, proximity)) for weights in zip(*DEMO_WEIGHTS, strict=True))
    return round(left / DEMO_DIVISOR) + DEMO_SPEED_PULSES, round(right / DEMO_DIVISOR) + DEMO_SPEED_PULSES


_INTERFACE = Interface(
    N_REGISTERS,
    proximity=(PROXIMITY[0], PROXIMITY[-1] + 1),
    ambient=(AMBIENT[0], AMBIENT[-1] + 1),
    sides=(PROXIMITY[Sensor.LEFT_90], PROXIMITY[Sensor.RIGHT_90]),
    setpoints=(SETPOINTS[0], SETPOINTS[1]),
    positions=(LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER),
    counts=(0, COUNTS_LIMIT),
    top_speed=20.0,  # 160 mm/s
    speed_limit=127,
)

KHEPERA_1 = RobotModel(
    name="khepera1",
    family="khepera",
    title="Khepera",
    body=Body(
        radius=BODY_RADIUS,
        mass=MASS,
        support_position=SUPPORT_POSITION,
        sensor_positions=SENSOR_POSITIONS,
        sensor_height=SENSOR_HEIGHT,
        idle_current=IDLE_CURRENT,
        height=BODY_HEIGHT,
        scene="khepera.xml",
        sensors=SENSOR_LABELS,
        wheel_radius=WHEEL_RADIUS,
        wheel_width=WHEEL_WIDTH,
        wheel_base=WHEEL_BASE,
        pulses_per_turn=PULSES_PER_TURN,
        near_counts=100,
    ),
    calibration="khepera1",
    roms={name: ROMS[name] for name in ("5.02", "4.06", "khepera2")},
    channels=_CHANNELS,
    bars=_BARS,
    dialect=_DIALECT,
    parts=_PARTS,
    features=frozenset(Feature),
    interface=_INTERFACE,
    speed_modes={first + Wheel.MODE: Mode.SPEED for first in (LEFT, RIGHT)},
    vehicle=_vehicle_speeds,
    template="controller_template.py",
    bench=Bench(
        walls_mm=(6, 12, 17, 21, 25, 29),
        cylinders_mm=(6, 12, 18),
        height_mm=50,
        duty="P,{},{}",
        duties=(40, 0, -40, 0, 30, -10, 0),
        duty_limit=50,
        resets=("G", "restart"),
    ),
)

KHEPERA_2 = replace(
    KHEPERA_1,
    name="khepera2",
    title="Khepera II",
    body=replace(
        KHEPERA_1.body,
        radius=0.035,
        mass=0.080,
        support_position=0.0295,
        sensor_positions=(
            (0.0133, 0.0266),
            (0.0227, 0.0227),
            (0.0300, 0.0078),
            (0.0300, -0.0078),
            (0.0227, -0.0227),
            (0.0133, -0.0266),
            (-0.0289, -0.0111),
            (-0.0289, 0.0111),
        ),
        sensor_height=0.017,
        wheel_base=0.055,
        idle_current=0.2464,
        fits_scene=True,
    ),
    calibration="khepera2",
    roms={name: ROMS[name] for name in ("khepera2", "5.02", "4.06")},
)
"""70 mm and 80 g (simulators, host libraries); sensors as in its manual's figure 7, scaled to that diameter,
their height after Webots; wheel base as in its calibration; 250 mAh that last 60 minutes (manual II), less
the motors' share; supports and height like the Khepera's (assumed)."""

MODELS = KHEPERA_1, KHEPERA_2
