"""The model Scout: the data that other packages ask for, and the words on its line."""

import math
import re
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path

from khep_twin.board.rom import Rom, RunningMode
from khep_twin.robots.body import Body, SonarRing
from khep_twin.robots.framing import Lines
from khep_twin.robots.model import (
    Dialect,
    Interface,
    Read,
    RobotModel,
    Term,
    bars_of,
    parse_channels,
    parts_of,
)

FOLDER = Path(__file__).parent
RING, GROUND, SONAR = ("left", "right", "back"), ("ground left", "ground right"), ("west", "north", "east")
LABELS = {
    "proximity": f"{', '.join((*RING, *GROUND))} [counts]",
    "ambient": f"{', '.join((*RING, *GROUND))} [counts]",
    "ultrasonic": f"{', '.join(SONAR)} [mm]",
    "speed": "left, right, setpoint left, setpoint right [0.01 rad/s]",
    "position": "left, right [pulses]",
    "leds": "lamp red, lamp green, lamp blue [0 to 63]",
    "battery": "voltage [mV]",
}
"""Channels of its registers, one after the other, with their columns and units."""
SIZES = [label.count(",") + 1 for label in LABELS.values()]
PROXIMITY, AMBIENT, ULTRASONIC, SPEED, POSITION, LEDS, BATTERY, N_REGISTERS = accumulate(SIZES, initial=0)
GROUND_PROXIMITY, SETPOINT, NEAREST_MM, REACH_MM, NO_ECHO = PROXIMITY + len(RING), SPEED + 2, 80, 3000, 9999

READS = {"look": (PROXIMITY, ULTRASONIC), "range": (ULTRASONIC, SPEED), "wheels": (SPEED, LEDS)}
READS["power"] = BATTERY, N_REGISTERS
ORDERS = {"drive": (SETPOINT, 2, -2000, 2000), "lamp": (LEDS, 3, 0, 63)}
"""Words: registers that a request reads; first register, number, and limits of values that it sets."""
N_VALUES = {
    "id": 4,
    **{word: end - first for word, (first, end) in READS.items()},
    **dict.fromkeys(ORDERS, 1),
}

BODY = Body(
    radius=0.1,
    mass=1.2,
    support_position=0.08,
    sensor_positions=((0.062, 0.074), (0.062, -0.074), (-0.096, 0.0)),
    sensor_height=0.04,
    idle_current=0.3,
    height=0.081,
    scene=str(FOLDER / "scout.xml"),
    sensors=(*RING, *GROUND),
    wheel_radius=0.025,
    wheel_width=0.012,
    wheel_base=0.15,
    pulses_per_turn=1024,
    near_counts=200,
    ground_positions=((0.07, 0.03), (0.07, -0.03)),
    ground_height=0.008,
    sonar=SonarRing(SONAR, (60, 0, -60), radius=0.095, height=0.035, codes=(0, NO_ECHO)),
)


class WordLines(Lines):
    """Lines of words, whose replies are numbers only: their count tells to which request they belong."""

    def has_one_reply(self, request: str) -> bool:
        return True

    def answers(self, request: str, reply: str) -> bool:
        return len(reply.split()) == N_VALUES.get(self.command(request))

    def values(self, text: str) -> Sequence[int]:
        words = text.split()
        return [int(word) for word in (words[1:] if words and words[0].isalpha() else words)]


def read(word: str, first: int, end: int) -> Read:
    """Return the request of a word that reads registers, among others."""
    start, stop = READS[word]
    return Read(word, stop - start, range(first, end), range(first - start, end - start))


SCOUT = RobotModel(
    name="scout",
    family="scout",
    title="Scout",
    body=BODY,
    calibration=str(FOLDER / "scout.toml"),
    roms={"scout-2": Rom(bios="", protocol="", banner=(), modes={1: RunningMode(38_400)})},
    channels=parse_channels(LABELS),
    bars=bars_of(dark=800, speed=2000),
    dialect=Dialect(
        robot_name="a Scout",
        host_class="second_robot.host.Scout",
        versions_reply=re.compile(r"200 3 2 \d+"),
        probes=("id", "wheels", "look"),
        stop_requests=("drive 0 0",),
        moving=("drive",),
        baud=38_400,
        framing=WordLines(),
        reads={
            "proximity": read("look", PROXIMITY, AMBIENT),
            "ambient": read("look", AMBIENT, ULTRASONIC),
            "ultrasonic": read("range", ULTRASONIC, SPEED),
            "speed": read("wheels", SPEED, POSITION),
            "position": read("wheels", POSITION, LEDS),
            "battery": read("power", BATTERY, N_REGISTERS),
        },
        drive="drive {:d} {:d}".format,
    ),
    parts=parts_of("second_robot", core="CORE", robot="ScoutRobot", host="Scout", conformance="CHECKS"),
    plots={"ultrasonic": "ultrasonic [mm]", "battery": "battery [mV]"},
    rgb_leds=("lamp",),
    interface=Interface(
        n_registers=N_REGISTERS,
        proximity=(PROXIMITY, GROUND_PROXIMITY),
        ambient=(AMBIENT, AMBIENT + len(RING)),
        sides=(PROXIMITY, PROXIMITY + 1),
        setpoints=(SETPOINT, SETPOINT + 1),
        positions=(POSITION, POSITION + 1),
        counts=(0, 1023),
        top_speed=800,
        speed_limit=2000,
        speed_per_pulse=math.tau / BODY.pulses_per_turn * 1e4,
    ),
    terms=(
        Term("ground", GROUND_PROXIMITY, GROUND, 0, 1023, "counts"),
        Term("ultrasonic", ULTRASONIC, SONAR, 0, REACH_MM, "mm"),
        Term("voltage", BATTERY, ("battery",), 6000, 8400, "mV"),
    ),
)
