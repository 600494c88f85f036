"""The model Khepera IV; sources as in `khep_twin.robots.khepera4`."""

import math
import re
from pathlib import Path

import khep_twin.robots.khepera4.registers as registers
from khep_twin.board.rom import Rom, RunningMode
from khep_twin.robots.body import Body, SonarRing
from khep_twin.robots.khepera4.registers import GROUND, PACKET_SIZE, RING, ULTRASONIC
from khep_twin.robots.model import (
    Bench,
    Dialect,
    Read,
    RobotModel,
    Term,
    bars_of,
    consecutive_registers,
    parse_channels,
    parts_of,
    ring_interface,
)
from khep_twin.robots.vehicle import Vehicle
from khep_twin.units import COUNTS_LIMIT

SONAR = SonarRing(
    ULTRASONIC,
    (90, 45, 0, -45, -90),
    0.066,
    0.0445,
    registers.ULTRASONIC_CODES,
    lag=0.07,
    nearest=0.25,
    reach=2.5,
    exponent=2.27,
)
"""Headings, 0.25 to 2.5 m: manual; distance from the centre: assumed; height: drawing. A distance is 20 to
120 ms old. The amplitude is 0.5 at 42.5 degrees off the axis (typical, assumed)."""

BODY = Body(
    radius=0.0704,
    mass=0.540,
    support_position=0.050,
    sensor_positions=tuple(
        (round(0.068 * math.cos(heading), 6), round(0.068 * math.sin(heading), 6))
        for heading in map(math.radians, (135, 90, 45, 0, -45, -90, -135, 180))
    ),
    sensor_height=0.01435,
    idle_current=0.4857,
    height=0.0577,
    scene=str(Path(__file__).parent / "assets" / "khepera4.xml"),
    sensors=(*RING, *GROUND),
    wheel_radius=0.021,
    wheel_width=0.0065,
    wheel_base=0.1054,
    pulses_per_turn=19_456,
    near_counts=150,
    support_solref=(-600.0, -50.0),
    ground_positions=((0.020, 0.059), (0.0613, 0.010), (0.0613, -0.010), (0.020, -0.059)),
    ground_height=0.0047,
    sonar=SONAR,
    wheel_mass=0.025,
    rotor_inertia=8e-5,
    voltage_limit=9.0,
)
"""Its manual, see `assets/khepera4.xml`; 3400 mAh that last 7 hours without motors; casters on
springs of some 100 N/m, without which wheels would leave the floor at the foot of any ramp (assumed)."""

VEHICLE = Vehicle(
    left=(2, 3, 4, -7, -4, -3, -2, 1),
    right=(-2, -3, -4, -9, 4, 3, 2, 1),
    threshold=80,
    saturation=500,
    divisor=3,
    forward=200,
    min_speed=10,
    turn=120,
    moved_pulses=4424,
    front=slice(3, 4),
)
"""That of kh4server (library)."""

SAMPLED = consecutive_registers(registers.CHANNELS)
"""Channels of a log, consecutive in the robot's registers."""

_REGISTERS = {channel.name: channel.registers for channel in SAMPLED}
_FIRST = {name: registers[0] for name, registers in _REGISTERS.items()}
_READS = {
    **{name: ("N" if name == "proximity" else "O", 12, range(12)) for name in ("proximity", "ambient")},
    **{"ultrasonic": ("G", 5, range(5)), "speed": ("E", 2, range(2)), "position": ("R", 2, range(2))},
    # Each of their replies lists ten values of x, then of y, then of z.
    **{
        name: (letter, 3 * PACKET_SIZE, range(0, 3 * PACKET_SIZE, PACKET_SIZE))
        for name, letter in (("accelerometer", "T"), ("gyroscope", "S"))
    },
}
"""Letter, number of values and indices of the read ones by channel."""
_TOP_RATE = 8_000  # 528 deg/s (assumed)

_INTERFACE = ring_interface(
    SAMPLED,
    RING,
    counts=(100, COUNTS_LIMIT),
    top_speed=600.0,  # 407 mm/s, half of its top speed (assumed)
    speed_limit=2**15 - 1,
)

_TERMS = (
    Term("ground", _FIRST["proximity"] + len(RING), GROUND, 0, COUNTS_LIMIT, "counts"),
    Term("ultrasonic", _FIRST["ultrasonic"], ULTRASONIC, 0, 250, "cm"),
    Term("gyroscope", _FIRST["gyroscope"] + 2, ("turn",), -_TOP_RATE, _TOP_RATE, "0.066 deg/s"),
)

KHEPERA_4 = RobotModel(
    name="khepera4",
    family="khepera4",
    title="Khepera IV",
    body=BODY,
    calibration="khepera4",
    # The server has no banner and one baud rate (manual, chapter 6).
    roms={"kh4server": Rom(bios="", protocol="", banner=(), modes={1: RunningMode(registers.BAUD)})},
    channels=parse_channels(registers.CHANNELS),
    bars=bars_of(dark=980, speed=500),
    # D does not stop the server's vehicle, and H and K are not reads.
    dialect=Dialect(
        robot_name="a Khepera IV",
        host_class="khep_twin.host.Khepera4",
        versions_reply=re.compile(r"b,[A-P],\d+"),
        probes=("B", "E", "R", "G"),
        stop_requests=("A,2", "D,0,0"),
        moving=("A", "D", "F", "L"),
        baud=registers.BAUD,
        reads={
            name: Read(letter, n_values, _REGISTERS[name][: len(indices)], indices)
            for name, (letter, n_values, indices) in _READS.items()
        },
        open_loop=("L,{},{}", _REGISTERS["duty"]),
    ),
    parts={
        **parts_of("khep_twin.robots.khepera4", core="CORE", robot="Khepera4Robot", host="Khepera4"),
        "computer": "khep_twin.robots.khepera4.computer:COMPUTER",
        "program": "khep_twin.robots.khepera4.computer:bus_source",
        "conformance": "khep_twin.robots.khepera4.conformance:KHEPERA_4_CHECKS",
    },
    plots={
        "ultrasonic": "ultrasonic [cm]",
        "accelerometer": "accelerometer [1/16384 g]",
        "gyroscope": "gyroscope [0.066 deg/s]",
    },
    rgb_leds=registers.LEDS,
    interface=_INTERFACE,
    terms=_TERMS,
    speed_modes={_FIRST["control"]: registers.Control.SPEED},
    vehicle=VEHICLE.speeds,
    accelerometer_signs=(1, 1, -1),
    template=str(Path(__file__).parent / "assets" / "template.py"),
    # At full duty the twin's tyres slip by 0.05 %; paper of A4 is 210 mm wide.
    bench=Bench(
        walls_mm=(35, 45, 60, 80, 110),
        cylinders_mm=(30, 40, 55),
        height_mm=200,
        duty="L,{},{}",
        duties=(800, 0, -800, 0, 600, -200, 0),
        duty_limit=2940,
        resets=("I", "Z"),
    ),
    tasks={
        "KheperaIVObstacleAvoidance": "khep_twin.robots.khepera4.tasks:OBSTACLE_AVOIDANCE",
        "KheperaIVLineFollowing": "khep_twin.robots.khepera4.tasks:LINE_FOLLOWING",
    },
)

MODELS = (KHEPERA_4,)
