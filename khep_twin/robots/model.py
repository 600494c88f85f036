"""Contract of a model of robot: the data that other packages ask for, and references to its code.

This module knows no model. A package registers its models under the entry point "khep_twin.robots":

    [project.entry-points."khep_twin.robots"]
    toy = "toy_robot.model:TOY"

`parts` names the code that acts, as "module:attribute", which is imported on its first use:

    core            `khep_twin.robots.core.Core`: functions that the stepping core runs
    robot           subclass of `khep_twin.robots.robot.Robot`: the robot of a world
    host            subclass of `khep_twin.host.HostRobot`: the robot at the other end of a line
    conformance     `khep_twin.lab.conformance.port.conform.Checks`: checks at a port
    program         function that returns C functions for programs on the robot, of networks' registers
    computer        `khep_twin.programs.computer.Computer`: devices and files of programs on the robot
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.metadata import EntryPoint
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

from khep_twin.board.rom import Rom
from khep_twin.board.terms import Term as Term
from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import RobotModelError, choices
from khep_twin.lazy import load_entry
from khep_twin.robots.body import PER_METRE, Body
from khep_twin.robots.framing import LINES, Framing
from khep_twin.units import COUNTS_LIMIT

GROUP = "khep_twin.robots"
"""Entry point under which packages register their models."""

Columns = tuple[tuple[str, str], ...]
"""Name and unit of each column of a channel."""


Base = TypeVar("Base")


def robot_name(number: int) -> str:
    """Return the name of a robot of any model in scenes, logs and pictures, by its number in the playpen."""
    return f"khepera{number}"


class Feature(StrEnum):
    """Use of a robot that not every model has; the value is its purpose in messages."""

    TURRETS = "turrets"
    LINE = "an episode with a line"
    TOOLBOX = "a controller in the toolbox's form"
    RECORDING_CHECKS = "the checks of a recording"


class Read(NamedTuple):
    """Request that reads registers.

    Attributes:
        request: Text of the request.
        n_values: Number of values in its reply.
        registers: Registers that it reads.
        values: Indices of their values in the reply.
    """

    request: str
    n_values: int
    registers: Sequence[int]
    values: Sequence[int]


class Dialect(NamedTuple):
    """Protocol of a family of robots, as the line needs it.

    Attributes:
        robot_name: Family of robots, for messages.
        host_class: Name of the host class for it.
        versions_reply: Pattern of the reply to the first of `probes`.
        probes: Reads that resynchronize the line; the reply to the first names the kind of robot.
        stop_requests: Requests that stop the motors, one after the other.
        moving: Prefixes of requests that move the robot.
        baud: Usual baud rate.
        framing: Ends of the messages; requests and replies are given by their texts.
        reads: Requests that read registers, by channel, or by another name for a part of one.
        drive: Function that returns the request that sets the speed setpoints [register].
        open_loop: Format of the request that sets the motors' duties, and the registers of these; or empty.
    """

    robot_name: str
    host_class: str
    versions_reply: re.Pattern[str]
    probes: tuple[str, ...]
    stop_requests: tuple[str, ...]
    moving: tuple[str, ...]
    baud: int
    framing: Framing = LINES
    reads: Mapping[str, Read] = {}
    drive: Callable[[int, int], str] = "D,{:d},{:d}".format
    open_loop: tuple[str, Sequence[int]] = "", ()

    @property
    def identification(self) -> bytes:
        """Bytes that end an unfinished request, and then ask for the kind of robot."""
        return self.framing.resync + self.framing.encode(self.probes[0])

    def read_of(self, register: int) -> Read | None:
        """Return the request that reads a register; None without one."""
        return next((read for read in self.reads.values() if register in read.registers), None)

    def may_move(self, request: str) -> bool:
        """Return whether a request may move the robot."""
        return request not in self.stop_requests and request.lstrip().startswith(self.moving)


class Interface(NamedTuple):
    """Registers that controllers of episodes read and set; pairs are left and right, or first and end.

    Attributes:
        n_registers: Number of registers.
        proximity: First register of proximity, which rises towards an obstacle, and the end of them.
        ambient: First register of ambient light, and the end of them.
        sides: Registers of proximity to the left and to the right.
        setpoints: Registers of the speed setpoints.
        positions: Registers of the wheels' positions [pulses].
        counts: Proximity without obstacles, which is 0 for metrics, and that which is 1 for networks and
            metrics [counts].
        top_speed: Speed that is 1 for metrics, and for actions and observations of tasks [register].
        speed_limit: Largest setpoint [register].
        speed_per_pulse: Speed of one pulse per 10 ms [register].
    """

    n_registers: int
    proximity: tuple[int, int]
    ambient: tuple[int, int]
    sides: tuple[int, int]
    setpoints: tuple[int, int]
    positions: tuple[int, int]
    counts: tuple[int, int]
    top_speed: float
    speed_limit: int
    speed_per_pulse: float = 1.0

    @property
    def n_proximity(self) -> int:
        """Number of sensors of proximity."""
        return self.proximity[1] - self.proximity[0]

    @property
    def n_ambient(self) -> int:
        """Number of sensors of ambient light."""
        return self.ambient[1] - self.ambient[0]


class Bench(NamedTuple):
    """Tests by which a user calibrates a robot whose line is text.

    Attributes:
        walls_mm: Distances of a white wall from its edge at which its sensors read between both ends.
        cylinders_mm: Those of a white cylinder.
        height_mm: Height of these objects; a higher one gives the same readings.
        duty: Format of the request that sets the duties of both motors.
        duties: Steps of duty.
        duty_limit: Duty above which the tyres may slip and hide the motors' behaviour.
        resets: Prefixes of requests that set the counters.
        polls: Channels that tell a motor's speed, the one that a session polls first.
    """

    walls_mm: tuple[float, ...]
    cylinders_mm: tuple[float, ...]
    height_mm: float
    duty: str
    duties: tuple[int, ...]
    duty_limit: int
    resets: tuple[str, ...]
    polls: tuple[str, ...] = ("speed", "position")

    @property
    def duty_command(self) -> str:
        """Command that sets the duties."""
        return self.duty.partition(",")[0]


@dataclass(frozen=True, slots=True)
class Bar:
    """Kind of bar of a panel.

    Attributes:
        full: Value that fills the bar.
        legend: Entry in the legend.
        lowest: Smallest part; below 0 if negative values fill the bar downwards.
    """

    full: int
    legend: str
    lowest: float = 0.0

    def filled_part(self, value: float) -> float:
        """Return the part of the bar that a value fills, at most 1."""
        return min(max(value / self.full, self.lowest), 1.0)


@dataclass(frozen=True, slots=True)
class RobotModel:
    """A model of robot.

    Attributes:
        name: Name in playpen files.
        family: Name of the models with the same protocol, sensors and channels.
        title: Name for readers, e.g. "Khepera IV".
        body: Body.
        calibration: Usual calibration: a shipped name, or the path of a file, whose stem is its bare name.
        roms: Versions of its firmware by name, the default first.
        channels: Columns of its channels in a log, by the name of the channel, in the order of a table.
        bars: Bars of its panel: proximity [counts], light [counts] and speed [register].
        dialect: Protocol on its line.
        parts: References to its code, see the module.
        features: Uses that it supports.
        plots: Titles of further plots, by channel.
        rgb_leds: Names of LEDs whose red, green and blue are in the channel "leds", 0 to 63.
        interface: Registers for controllers of episodes; None if it runs in no episodes.
        terms: Further readings that tasks observe and controllers of episodes read.
        speed_modes: Registers of the motors' control, and their values with speed setpoints in force.
        tasks: Further tasks of environments by name, each a `khep_twin.envs.Task` as "module:object".
        vehicle: Function that returns the setpoints of its Braitenberg vehicle [register], by the readings of
            proximity; None without a vehicle.
        template: First text of a controller for it: a file in assets, or a path; empty for a straight drive.
        bench: Tests that calibrate it; None without a fit.
        accelerometer_signs: Signs of its axes, to x forward, y left and z up.
    """

    name: str
    family: str
    title: str
    body: Body
    calibration: str
    roms: Mapping[str, Rom]
    channels: Mapping[str, Columns]
    bars: Mapping[str, Bar]
    dialect: Dialect
    parts: Mapping[str, str]
    features: frozenset[Feature] = frozenset()
    plots: Mapping[str, str] = field(default_factory=dict[str, str])
    rgb_leds: tuple[str, ...] = ()
    interface: Interface | None = None
    terms: tuple[Term, ...] = ()
    speed_modes: Mapping[int, int] = field(default_factory=dict[int, int])
    tasks: Mapping[str, str] = field(default_factory=dict[str, str])
    vehicle: Callable[[Sequence[int]], tuple[int, int]] | None = None
    template: str = ""
    bench: Bench | None = None
    accelerometer_signs: tuple[int, int, int] = (1, 1, 1)

    @property
    def calibration_name(self) -> str:
        """Bare name of its usual calibration."""
        return Path(self.calibration).stem

    def load(self, part: str, kind: type[Base]) -> Base:
        """Return a part that is an instance of `kind`.

        Raises:
            RobotModelError: The model lacks the part, or it is another object.
        """
        if not isinstance(value := self._load_part(part), kind):
            raise self._part_error(part, value, f"a {kind.__name__}")
        return value

    def load_class(self, part: str, base: type[Base]) -> type[Base]:
        """Return a part that is a subclass of `base`.

        Raises:
            RobotModelError: The model lacks the part, or it is another object.
        """
        value = self._load_part(part)
        if isinstance(value, type) and issubclass(cast(type[object], value), base):
            return value
        raise self._part_error(part, cast(object, value), f"a subclass of {base.__name__}")

    @property
    def episode_interface(self) -> Interface:
        """Registers for controllers of episodes.

        Raises:
            RobotModelError: It runs in no episodes.
        """
        if self.interface is None:
            raise RobotModelError(f"model = {self.name!r} gives no interface; expected one for an episode")
        return self.interface

    @property
    def fit_bench(self) -> Bench:
        """Tests that calibrate it; a `RobotModelError` without them."""
        if self.bench is None:
            raise RobotModelError(f"model = {self.name!r} gives no bench; expected one for a fit")
        return self.bench

    @property
    def sonar_unit(self) -> float:
        """Unit of the channel "ultrasonic" [m]; 0 without the channel."""
        columns = self.channels.get("ultrasonic", ())
        return 1 / PER_METRE[columns[0][1]] if columns else 0.0

    @property
    def known_terms(self) -> Mapping[str, Term]:
        """Terms of the model and of its turrets by their names."""
        turrets = installed_turrets().values() if Feature.TURRETS in self.features else ()
        return {term.name: term for term in (*self.terms, *(term for kind in turrets for term in kind.terms))}

    def find_terms(self, names: Sequence[str], commanded: bool = False) -> list[Term]:
        """Return terms by their names; `commanded` for those that controllers set.

        Raises:
            RobotModelError: It lacks a term, or a name is there twice.
        """
        terms = {name: term for name, term in self.known_terms.items() if term.order or not commanded}
        kind, default = ("command", "two speeds") if commanded else ("term", "proximity and ambient light")
        for name in names:
            if name not in terms:
                expected = choices(name, terms) if terms else f"expected {default} alone"
                raise RobotModelError(f"model {self.name}: {kind} {name!r}: unknown; {expected}")
        if len({*names}) < len(names):
            raise RobotModelError(f"{kind}s = {[*names]}: a name is there twice; expected it once")
        return [terms[name] for name in names]

    def place_terms(self, names: Sequence[str]) -> list[Term]:
        """Return terms by their names, with the registers of turrets behind those of the robot."""
        terms, end = list[Term](), self.episode_interface.n_registers
        for term in self.find_terms(names):
            terms.append(term._replace(register=end) if term.turret else term)
            end += len(term.names) if term.turret else 0
        return terms

    def load_task(self, name: str) -> object:
        """Return a task.

        Raises:
            RobotModelError: It cannot be loaded.
        """
        return self._load(self.tasks[name])

    def _load_part(self, part: str) -> object:
        """Import a part."""
        if part not in self.parts:
            raise RobotModelError(f"model {self.name}: no part {part!r}; expected it among its parts")
        return self._load(self.parts[part])

    def _load(self, reference: str) -> object:
        """Import an object by its reference."""
        entry = EntryPoint(self.name, reference, GROUP)
        return load_entry(entry, f"model {self.name}: {reference}", RobotModelError)

    def _part_error(self, part: str, value: object, expected: str) -> RobotModelError:
        return RobotModelError(f"model {self.name}: part {part} is {value!r}; expected {expected}")


def bars_of(dark: int, speed: int, largest: int = COUNTS_LIMIT) -> dict[str, Bar]:
    """Return the bars of a panel by the counts in the dark, a speed [register], and the largest count."""
    return {
        "proximity": Bar(largest, f"proximity, 0 to {largest}"),
        # The count of ambient light decreases with the light.
        "light": Bar(dark, f"light, {dark} dark to 0 bright"),
        "speed": Bar(speed, f"speed, -{speed} to {speed}", lowest=-1.0),
    }


def parts_of(package: str, **attributes: str) -> dict[str, str]:
    """Return references to parts: attributes of modules of a package, which have the names of the parts."""
    return {part: f"{package}.{part}:{attribute}" for part, attribute in attributes.items()}


def parse_channels(labels: Mapping[str, str]) -> dict[str, Columns]:
    """Return the columns of channels by their labels, and of "registers", which has those of all of them."""
    channels = {name: parse_columns(name, label) for name, label in labels.items()}
    registers = tuple((f"register_{name}", "") for columns in channels.values() for name, _ in columns)
    return {**channels, "registers": registers}


def parse_columns(channel: str, label: str) -> Columns:
    """Return the columns of a channel by its label: "left, right [unit]", or "left, right [unit; unit]"."""
    names, _, unit = label.removesuffix("]").partition(" [")
    columns = [f"{channel}_{name.replace(' ', '_')}".lower() for name in names.split(", ")]
    units = unit.split("; ")
    return tuple(zip(columns, units if len(units) == len(columns) else [unit] * len(columns), strict=True))


class SampledRegisters(NamedTuple):
    """Registers that form a channel of a log.

    Attributes:
        name: Name of the channel.
        label: Names of its numbers, and their unit in brackets.
        registers: Indices of the registers.
    """

    name: str
    label: str
    registers: Sequence[int]


def consecutive_registers(labels: Mapping[str, str]) -> tuple[SampledRegisters, ...]:
    """Return the channels of consecutive registers from the labels of the channels."""
    ends = accumulate((label.count(",") + 1 for label in labels.values()), initial=0)
    parts = zip(labels.items(), pairwise(ends), strict=True)
    return tuple(SampledRegisters(name, label, range(*part)) for (name, label), part in parts)


def ring_interface(
    channels: Sequence[SampledRegisters],
    ring: Sequence[str],
    counts: tuple[int, int],
    top_speed: float,
    speed_limit: int,
    speed_per_pulse: float = 1.0,
) -> Interface:
    """Return the interface of consecutive channels, by the names of the sensors around the robot.

    Setpoints follow the speeds. The other arguments are attributes of `Interface`.
    """
    first = {channel.name: channel.registers[0] for channel in channels}
    proximity, ambient = first["proximity"], first["ambient"]
    speed, position = first["speed"], first["position"]
    return Interface(
        channels[-1].registers[-1] + 1,
        proximity=(proximity, proximity + len(ring)),
        ambient=(ambient, ambient + len(ring)),
        sides=(proximity + ring.index("left"), proximity + ring.index("right")),
        setpoints=(speed + 2, speed + 3),
        positions=(position, position + 1),
        counts=counts,
        top_speed=top_speed,
        speed_limit=speed_limit,
        speed_per_pulse=speed_per_pulse,
    )
