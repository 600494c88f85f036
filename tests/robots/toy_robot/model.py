"""The model Toy: the data that other packages ask for, and the frames on its line."""

import re
import struct
from operator import itemgetter
from pathlib import Path

from khep_twin.board.rom import Rom, RunningMode
from khep_twin.robots.body import Body, SonarRing
from khep_twin.robots.framing import Frames
from khep_twin.robots.model import (
    Dialect,
    Interface,
    Read,
    RobotModel,
    Term,
    bars_of,
    consecutive_registers,
    parse_channels,
    parts_of,
)

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
    scene="two_wheels.xml",
    fits_scene=True,
    sensors=INFRARED,
    wheel_radius=0.015,
    wheel_width=0.006,
    wheel_base=0.07,
    pulses_per_turn=94,
    near_counts=150,
    sonar=SonarRing(("beacon",), (20.0,), radius=0.031, height=0.03, codes=(0,)),
)

START, NAME, SPEEDS, REGISTERS = 0xC5, 1, 2, 3  # first byte of a frame; commands
SIZES = {NAME: 7, SPEEDS: 3, REGISTERS: 37}, {NAME: 3, SPEEDS: 7, REGISTERS: 3}  # of replies, of requests


def frame(command: int, *values: int) -> bytes:
    """Return a frame: start, command, values of 16 bits, and a byte that makes the sum 0 modulo 256."""
    body = struct.pack(f">BB{len(values)}H", START, command, *(value & 0xFFFF for value in values))
    return body + bytes([-sum(body) & 0xFF])


def values(frame: bytes) -> tuple[int, ...]:
    """Return the values of a frame."""
    return struct.unpack(f">{len(frame) // 2 - 1}h", frame[2:-1])


def _length(data: bytes, is_request: bool) -> int:
    """Return the length of the frame at the start of bytes; 0 without one."""
    size = SIZES[is_request].get(data[1], 0) if len(data) > 1 else 3
    return size * (data[0] == START and (len(data) < size or sum(data[:size]) % 256 == 0))


FRAMES = Frames(_length, itemgetter(1), resync=b"\xff" * 7, frame_values=values)
READ_ALL = FRAMES.decode(frame(REGISTERS))

TOY = RobotModel(
    name="toy",
    family="toy",
    title="Toy",
    body=BODY,
    calibration=str(Path(__file__).parent / "toy.toml"),
    roms={"toy-1": Rom(bios="", protocol="", banner=(), modes={1: RunningMode(57_600)})},
    channels=parse_channels(LABELS),
    bars=bars_of(dark=900, speed=500),
    dialect=Dialect(
        robot_name="a Toy",
        host_class="toy_robot.host.Toy",
        versions_reply=re.compile("C501546F79[0-9A-F]{4}"),
        probes=(FRAMES.decode(frame(NAME)), READ_ALL),
        stop_requests=(FRAMES.decode(frame(SPEEDS, 0, 0)),),
        moving=("C502",),
        baud=57_600,
        framing=FRAMES,
        reads={name: Read(READ_ALL, 17, part, part) for name, _, part in consecutive_registers(LABELS)},
        drive=lambda left, right: FRAMES.decode(frame(SPEEDS, left, right)),
    ),
    parts=parts_of("toy_robot", core="CORE", robot="ToyRobot", host="Toy", conformance="CHECKS"),
    plots={"ultrasonic": "ultrasonic [mm]"},
    interface=Interface(
        n_registers=17,
        proximity=(0, 5),
        ambient=(5, 10),
        sides=(1, 2),
        setpoints=(13, 14),
        positions=(15, 16),
        counts=(0, 1023),
        top_speed=200,
        speed_limit=500,
        speed_per_pulse=BODY.pulse_length * 1e5,
    ),
    terms=(Term("ultrasonic", 10, ("beacon",), 0, 1500, "mm"),),
)
