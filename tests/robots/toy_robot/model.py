"""The model Toy: the data that other packages ask for."""

import re
from pathlib import Path

from khep_twin.board.rom import Rom, RunningMode
from khep_twin.robots.body import Body, SonarRing
from khep_twin.robots.model import Bar, Dialect, Interface, RobotModel, Term, parse_columns

BAUD = 57_600
FOLDER = Path(__file__).parent
INFRARED = ("nose", "left cheek", "right cheek", "ear", "tail")
LABELS = {
    "proximity": f"{', '.join(INFRARED)} [counts]",
    "ambient": f"{', '.join(INFRARED)} [counts]",
    "ultrasonic": "beacon [mm]",
    "speed": "left, right, setpoint left, setpoint right [mm/s]",
    "position": "left, right [pulses]",
}
"""Channels of its registers, one after the other, with their columns and units."""

BODY = Body(
    radius=0.045,
    mass=0.3,
    support_position=0.036,
    sensor_positions=((0.044, 0.005), (0.038, 0.021), (0.036, -0.026), (0.002, 0.044), (-0.041, -0.014)),
    sensor_height=0.016,
    idle_current=0.1,
    height=0.036,
    scene=str(FOLDER / "toy.xml"),
    sensors=INFRARED,
    wheel_radius=0.015,
    wheel_width=0.006,
    wheel_base=0.07,
    pulses_per_turn=94,
    near_counts=150,
    sonar=SonarRing(("beacon",), (20.0,), radius=0.031, height=0.03, codes=(0,)),
)

_COLUMNS = {name: parse_columns(name, label) for name, label in LABELS.items()}

TOY = RobotModel(
    name="toy",
    family="toy",
    title="Toy",
    body=BODY,
    calibration=str(FOLDER / "toy.toml"),
    roms={"toy-1": Rom(bios="", protocol="", banner=(), modes={1: RunningMode(BAUD)})},
    channels={
        **_COLUMNS,
        "registers": tuple((f"register_{name}", unit) for part in _COLUMNS.values() for name, unit in part),
    },
    bars={
        "proximity": Bar(1023, "proximity, 0 to 1023"),
        "light": Bar(900, "light, 900 dark to 0 bright"),
        "speed": Bar(500, "speed, -500 to 500", lowest=-1.0),
    },
    dialect=Dialect(
        robot_name="a Toy",
        host_class="toy_robot.host.Toy",
        versions_reply=re.compile(r"b,toy,\d+"),
        probe_letters="BR",
        stop_requests=("M,0000,0000",),
        moving=("M",),
        baud=BAUD,
    ),
    parts={
        "core": "toy_robot.core:CORE",
        "robot": "toy_robot.robot:ToyRobot",
        "host": "toy_robot.host:Toy",
        "conformance": "toy_robot.conformance:CHECKS",
    },
    plots={"ultrasonic": "ultrasonic [mm]"},
    interface=Interface(
        n_registers=17,
        proximity=0,
        n_proximity=5,
        ambient=5,
        n_ambient=5,
        left_setpoint=13,
        right_setpoint=14,
        left_side=1,
        right_side=2,
        rest_counts=0,
        counts_limit=1023,
        top_speed=200,
        speed_limit=500,
        left_position=15,
        right_position=16,
        speed_per_pulse=BODY.pulse_length * 1e5,
    ),
    terms=(Term("ultrasonic", 10, ("beacon",), 0, 1500, "mm"),),
)
