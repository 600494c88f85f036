"""The models Khepera III; sources as in `khep_twin.robots.khepera3`.

Firmware 3.0 came with another gear, so the generations are two models.
"""

import re
from dataclasses import replace
from pathlib import Path

import khep_twin.robots.khepera3.registers as registers
from khep_twin.board.rom import Rom, RunningMode
from khep_twin.robots.body import Body, SonarRing
from khep_twin.robots.framing import Lines
from khep_twin.robots.khepera3.registers import GROUND, PULSES_PER_SPEED, RING, ULTRASONIC
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

ASSETS = Path(__file__).parent / "assets"

COUNTS_LIMIT = 4095
"""Largest count of the converter, of 12 bits (toolbox)."""

SERVER = "kh3server"
"""Firmware with a KoreBot on top, which runs K-Team's server on the line."""

SONAR = SonarRing(
    ULTRASONIC,
    headings_deg=(90, 46, 0, -46, -90),
    radius=0.0,
    height=0.0425,
    codes=(registers.NO_ECHO,) * 3,
    lag=0.05,
    positions=((0.0048, 0.0596), (0.0427, 0.0444), (0.0564, 0.0), (0.0427, -0.0444), (0.0048, -0.0596)),
    nearest=0.19,
    reach=4.0,
    exponent=3.5,
)
"""Places: webots; the age of a distance follows from the period of the bursts. 20 cm (19 here: programs stop
below 20) to 4 m: manual; half the amplitude at 35 degrees (a simulator)."""

BODY = Body(
    radius=0.0675,  # from the middle of the axle to the front
    mass=0.710,
    support_position=0.0449,
    sensor_positions=(
        *((-0.0404, 0.0496), (0.0148, 0.0630), (0.0488, 0.0454), (0.0656, 0.0155), (0.0656, -0.0155)),
        *((0.0488, -0.0454), (0.0148, -0.0630), (-0.0404, -0.0496), (-0.0550, 0.0)),
    ),
    sensor_height=0.0237,
    idle_current=1.4 / 4,
    height=0.070,
    scene=str(ASSETS / "khepera3.xml"),
    sensors=(*RING, *GROUND),
    wheel_radius=0.0205,
    wheel_width=0.003,
    wheel_base=0.08841,
    pulses_per_turn=4198.4,
    near_counts=300,
    ground_positions=((0.060, -0.0099), (0.060, 0.0099)),
    ground_height=0.0117,
    sonar=SONAR,
    wheel_mass=0.010,
    rotor_inertia=2.15e-4,
    voltage_limit=9.0,
)
"""Mass and sensors: webots; wheels: manual; wheel base: toolbox; pulses of firmware 3.0: a public program;
1400 mAh that last 4 hours: manual; diameter and height: K-Team's product page (remembered)."""

VEHICLE = Vehicle(
    left=(2, 2, 2, 5, -12, -4, -2, 2, 4),
    right=(2, -2, -4, -12, 5, 2, 2, 2, 4),
    threshold=100,
    saturation=1000,
    divisor=30 * 12,
    forward=20,
    min_speed=10,
    turn=50,
    moved_pulses=700,
    front=slice(3, 5),
    unit=256,
    gain=12,  # at power-up (manual)
    waits=True,
)
"""Vehicle of letter A (library); the firmware's has the gain of its configuration (assumed)."""

SERVER_VEHICLE = replace(VEHICLE, left=(0, *VEHICLE.left), right=(0, *VEHICLE.right), is_unsigned=True)
"""That of kh3server, which passes the readings 1 to 9: the last is that of the right ground sensor."""

SAMPLED = consecutive_registers(registers.CHANNELS)
"""Channels of a log, consecutive in the robot's registers."""

_REGISTERS = {channel.name: channel.registers for channel in SAMPLED}
FIRST = {name: registers[0] for name, registers in _REGISTERS.items()}
"""First register of each channel."""

_INTERFACE = ring_interface(
    SAMPLED,
    RING,
    counts=(100, COUNTS_LIMIT),
    top_speed=20_000.0,  # 91 mm/s, in use by most programs
    speed_limit=43_000,
    speed_per_pulse=100 / PULSES_PER_SPEED,
)

_TERMS = (
    Term("ground", FIRST["proximity"] + len(RING), GROUND, 0, COUNTS_LIMIT, "counts"),
    Term("ultrasonic", FIRST["ultrasonic"], ULTRASONIC, 0, 400, "cm"),
)

_FRAMING = Lines(number=re.compile("[dl]?(-?[0-9]{1,10})"), has_reversed_ends=True)
"""Numbers in requests have a prefix of their size. Replies end in LF CR (a host), of kh3server in CR LF."""

_SIZES = {"proximity": ("N", 12), "ambient": ("O", 12), "speed": ("E", 2), "position": ("R", 2)}
_READS = {
    name: Read(letter, size, _REGISTERS[name][:size], range(min(size, len(_REGISTERS[name]))))
    for name, (letter, size) in _SIZES.items()
} | {
    f"ultrasonic {number}": Read(f"G,{number}", 17, [register], [1])
    for number, register in enumerate(_REGISTERS["ultrasonic"], 1)
}


def _roms_of(version: str) -> dict[str, Rom]:
    """Return the programs of a robot with a version of the dsPIC's firmware."""
    rom = Rom(bios=version, protocol="", banner=(), modes={1: RunningMode(registers.BAUD)})
    return {version: rom, SERVER: rom}


KHEPERA_3 = RobotModel(
    name="khepera3",
    family="khepera3",
    title="Khepera III",
    body=BODY,
    calibration=str(ASSETS / "khepera3.toml"),
    roms=_roms_of("3.0"),
    channels=parse_channels(registers.CHANNELS),
    bars=bars_of(dark=4000, speed=20_000, largest=COUNTS_LIMIT),
    dialect=Dialect(
        robot_name="a Khepera III",
        host_class="khep_twin.host.Khepera3",
        # A Khepera's versions have points; a Khepera IV's are letters.
        versions_reply=re.compile(r"b,\d+,\d+"),
        probes=("B", "E", "R", "V,0"),
        stop_requests=("A,2", "D,l0,l0"),
        moving=("A", "D", "F", "L", "P"),
        baud=registers.BAUD,
        framing=_FRAMING,
        reads=_READS,
        drive="D,l{:d},l{:d}".format,
        open_loop=("L,l{},l{}", _REGISTERS["duty"]),
    ),
    parts={
        **parts_of("khep_twin.robots.khepera3", core="CORE", robot="Khepera3Robot", host="Khepera3"),
        "conformance": "khep_twin.robots.khepera3.conformance:KHEPERA_3_CHECKS",
        "computer": "khep_twin.robots.khepera3.computer:COMPUTER",
        "program": "khep_twin.robots.khepera3.computer:bus_source",
    },
    plots={"ultrasonic": "ultrasonic [cm]"},
    interface=_INTERFACE,
    terms=_TERMS,
    speed_modes=dict(
        enumerate([registers.PicMode.NORMAL] * 2 + [registers.ControlType.SPEED] * 2, FIRST["control"])
    ),
    vehicle=VEHICLE.speeds,
    template=str(ASSETS / "template.py"),
    # The measured speed lags behind the positions, which the fit therefore takes.
    bench=Bench(
        walls_mm=(20, 30, 45, 65, 100),
        cylinders_mm=(20, 30, 45),
        height_mm=200,
        duty="L,l{},l{}",
        duties=(600, 0, -600, 0, 450, -150, 0),
        duty_limit=1023,
        resets=("I", "M"),
        polls=("position",),
    ),
)

KHEPERA_3_V2 = replace(
    KHEPERA_3,
    name="khepera3-firmware2",
    title="Khepera III with firmware 2",
    body=replace(BODY, pulses_per_turn=2764.8),
    calibration=str(ASSETS / "khepera3-firmware2.toml"),
    roms=_roms_of("2.0"),
)
"""Before firmware 3.0: motors of another gear, 43.2:1, with 64 pulses a turn (manual)."""

MODELS = KHEPERA_3, KHEPERA_3_V2
