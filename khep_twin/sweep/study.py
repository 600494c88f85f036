"""Studies: TOML files that define the episodes of a sweep.

    version = 1
    name = "noise"
    playpens = ["looping-maze"]
    controllers = ["braitenberg"]
    seeds = 100
    seconds = 60
    output = "noise"

    [grid]
    noise = [true, false]

A study runs every playpen with every controller, genome and seed, at every point of the grid. The models
define the format: their attributes are the file's keys, except the tuples of `[[network]]`, `[[program]]` and
`[[measure]]`. Paths in a study are relative to its folder.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

from pydantic import Field, PlainSerializer, WrapValidator, field_validator, model_validator

from khep_twin import units
from khep_twin.clock import n_steps, to_ns
from khep_twin.episodes.controllers import Network
from khep_twin.episodes.device import Device
from khep_twin.episodes.episode_setup import PLANAR_STEP_NS
from khep_twin.episodes.metrics import METRICS
from khep_twin.episodes.network_file import SUFFIX
from khep_twin.errors import KhepTwinError, Location, Problem, StudyError
from khep_twin.files import toml_files
from khep_twin.files.paths import StrPath
from khep_twin.files.toml_files import Name, Problems, TomlTable, format_value
from khep_twin.files.toml_lines import LineNumbers
from khep_twin.randomness import SEED_LIMIT
from khep_twin.robots.model import RobotModel
from khep_twin.sensing.noise import MAX_SCALE, Scale

# Type checkers accept only literal choices; pydantic accepts the tuple, and suggests similar names.
if TYPE_CHECKING:
    Fitness = str
else:
    Fitness = Literal[METRICS]
"""Name of a metric of an episode."""

NS_PER_MS = 1_000_000


class Point(NamedTuple):
    """Point of a study's grid.

    Attributes:
        noise: Whether sensors are noisy, or a scale of their noise.
        vary: Whether each episode has another robot of the same model.
        lighting: "all" or "off".
        planar: Whether the robot moves in a plane instead of MuJoCo.
        line_baud: Speed of the line between controller and robot [baud]; 0 for none.
        step_ms: Step of the physics [ms].
        period_ms: Control period [ms].
        seconds: Duration of an episode [s].
    """

    noise: float
    vary: bool
    lighting: str
    planar: bool
    line_baud: int
    step_ms: float
    period_ms: int
    seconds: float


COLUMNS = frozenset(
    (
        *"episode playpen controller genome seed start start_x_mm start_y_mm start_heading_deg".split(),
        *"end_x_m end_y_m end_heading_rad failed_step failure".split(),
        *Point._fields,
    )
)
"""Columns of the results besides the metrics."""

Switches = Annotated[tuple[bool, ...], Field(min_length=1, description="a list of true and false")]
NoiseLevel = Annotated[
    Scale,
    WrapValidator(lambda level, check: level if isinstance(level, bool) else check(level)),
    PlainSerializer(lambda level: level),
]
NoiseLevels = Annotated[
    tuple[NoiseLevel, ...],
    Field(min_length=1, description=f"a list of true, false, and scales from 0 to {MAX_SCALE}"),
]
Lightings = Annotated[
    tuple[Literal["all", "off"], ...], Field(min_length=1, description='a list of "all" and "off"')
]
Texts = Annotated[tuple[str, ...], Field(min_length=1, description="a list of texts, at least one")]

Seconds = Annotated[float, Field(gt=0, le=10**6)]
LineBaud = Annotated[int, Field(ge=0, le=10**9)]
PeriodMs = Annotated[int, Field(ge=10, le=10**4, multiple_of=10)]


class NetworkTable(TomlTable):
    """A `[[network]]`: its shape, as in `controllers.Network`, and the source of its genomes."""

    name: Name
    hidden: Annotated[
        tuple[Annotated[int, Field(ge=1, le=1000)], ...],
        Field(description="neurons of each hidden layer, from 1 to 1000"),
    ] = ()
    recurrent: bool = False
    ambient: bool = False
    terms: tuple[str, ...] = ()
    top_speed_pulses: Annotated[float | None, Field(gt=0)] = None
    genomes: Annotated[str | None, Field(description="the path of a .npy or .csv file")] = None
    drawn: Annotated[int | None, Field(ge=1, le=10**7)] = None
    drawn_seed: Annotated[int, Field(ge=0, lt=SEED_LIMIT)] = 0
    drawn_sd: Annotated[float, Field(gt=0, le=1000)] = 1.0

    def network(self, model: RobotModel) -> Network:
        """Return the controller of a robot.

        Raises:
            RobotModelError: The model lacks a term.
        """
        top_speed = self.top_speed_pulses or 0.0
        return Network(
            self.hidden, self.recurrent, self.ambient, top_speed, terms=self.terms, model=model.family
        )


class ProgramTable(TomlTable):
    """A `[[program]]`: a user's function, as in `controllers.Function`."""

    name: Name
    file: Annotated[str, Field(pattern=r"^.+\.py:[A-Za-z_]\w*$", description="FILE.py:NAME")]
    memory: Annotated[int, Field(ge=0, le=10**6)] = 0
    genomes: Annotated[str | None, Field(description="the path of a .npy or .csv file")] = None


class MeasureTable(TomlTable):
    """A `[[measure]]`: a user's fitness, a function of an episode's end (`run_shard.evaluate`)."""

    name: Name
    file: Annotated[str, Field(pattern=r"^.+\.py:[A-Za-z_]\w*$", description="FILE.py:NAME")]


class Grid(TomlTable):
    """Parameters, each with the list of its values; those of None have one value, a key of the study."""

    noise: NoiseLevels = (True,)
    vary: Switches = (False,)
    lighting: Lightings = ("all",)
    starts: Texts = ("playpen",)
    planar: Annotated[
        tuple[bool, ...] | None, Field(min_length=1, description="a list of true and false")
    ] = None
    line_baud: Annotated[
        tuple[LineBaud, ...] | None, Field(min_length=1, description="a list of numbers such as 9600, or 0")
    ] = None
    step_ms: Annotated[
        tuple[float, ...] | None, Field(min_length=1, description="a list of 2.5, 5 and 10")
    ] = None
    period_ms: Annotated[
        tuple[PeriodMs, ...] | None, Field(min_length=1, description="a list of multiples of 10")
    ] = None
    seconds: Annotated[
        tuple[Seconds, ...] | None, Field(min_length=1, description="a list of numbers above 0")
    ] = None

    @field_validator("noise")
    @classmethod
    def _as_one_type(cls, noise: tuple[float, ...]) -> tuple[float, ...]:
        """Return switches unchanged, but as numbers beside a number: a column has one type."""
        return noise if all(isinstance(scale, bool) for scale in noise) else tuple(map(float, noise))


class Home(TomlTable):
    """Home of the fitness `homing`."""

    x_mm: float
    y_mm: float
    radius_mm: Annotated[float, Field(gt=0)]
    charge_s: Annotated[float, Field(gt=0)]


class Study(TomlTable):
    """Content of a study."""

    version: Annotated[int, Field(ge=1, le=1, description="1")]
    name: Name
    playpens: Texts
    controllers: Annotated[tuple[str, ...], Field(description="a list of texts")] = ()
    networks: Annotated[tuple[NetworkTable, ...], Field(alias="network")] = ()
    programs: Annotated[tuple[ProgramTable, ...], Field(alias="program")] = ()
    measures: Annotated[tuple[MeasureTable, ...], Field(alias="measure")] = ()
    seeds: Annotated[int, Field(ge=1, le=10**9)]
    first_seed: Annotated[int, Field(ge=0, le=2**62)] = 0
    seconds: Seconds | None = None
    planar: Annotated[bool, Field(description="true or false")] = False
    device: Device = "cpu"
    step_ms: Annotated[float | None, Field(gt=0, description="2.5, 5 or 10")] = None
    line_baud: Annotated[LineBaud | None, Field(description="such as 9600, or 0 for no line")] = None
    period_ms: Annotated[PeriodMs, Field(description="a multiple of 10")] = 20
    fitness: Annotated[
        tuple[Fitness, ...], Field(min_length=1, description=f"a list of {', '.join(METRICS)}")
    ] = ("obstacle_avoidance", "distance_m")
    home: Home | None = None
    grid: Grid = Grid()
    rollouts_per_task: Annotated[int, Field(ge=1, le=10**6)] = 1000
    output: Annotated[str, Field(min_length=1, description="the path of a folder")]

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        if problems := list(self._find_problems()):
            raise Problems(problems)
        return self

    def _find_problems(self) -> Iterator[Problem]:
        for key in sorted(_STUDY_PARAMETERS & self.model_fields_set):
            if getattr(self.grid, key) is not None:
                yield Problem.of(("grid", key), f"grid: {key}: is a key of the study, too", "one of them")
        for step_ms in self.values("step_ms"):
            if step_ms not in (None, 2.5, 5.0, 10.0):
                yield Problem.of(self._location("step_ms"), f"step_ms = {step_ms:g}", "2.5, 5 or 10")
        if self.device == "cuda" and not all(self.values("planar")):
            yield Problem.of(("device",), 'device = "cuda": episodes in MuJoCo', "planar = true")
        if self.device == "cuda" and self.programs:
            yield Problem.of(("device",), 'device = "cuda": and a [[program]]', "networks or braitenberg")
        for seconds, period_ms in itertools.product(self.values("seconds"), self.values("period_ms")):
            if seconds is None:
                yield Problem.of((), "seconds is missing", "the duration of an episode")
                break
            try:
                n_steps(to_ns(seconds), period_ms * NS_PER_MS)
            except ValueError:
                expected = f"whole control periods of {period_ms} ms"
                yield Problem.of(self._location("seconds"), f"seconds = {seconds:g}", expected)
        for name in self.controllers:
            if name != "braitenberg" and not name.endswith(SUFFIX):
                choices = ("braitenberg", f"a network's FILE{SUFFIX}")
                problem = f"controllers: {format_value(name)}: unknown"
                yield Problem.of(("controllers",), problem, choices, name)
        if not (self.controllers or self.networks or self.programs):
            yield Problem.of((), "no controller", "controllers, a [[network]] or a [[program]]")
        if "homing" in self.fitness and self.home is None:
            yield Problem(("fitness",), 'fitness = "homing": there is no [home]')
        for key, values in self._value_lists():
            for value in dict.fromkeys(value for value in values if values.count(value) > 1):
                yield Problem.of(key, f"{key[-1]} has {format_value(value)} twice", "once")
        controllers: set[str] = {*self.controllers}
        columns = {*COLUMNS, *METRICS}
        for kind, tables, known_names in (
            ("network", self.networks, controllers),
            ("program", self.programs, controllers),
            ("measure", self.measures, columns),
        ):
            for index, table in enumerate(tables):
                if table.name in known_names:
                    problem = f'{kind} {index + 1}: name = "{table.name}": taken'
                    yield Problem.of((kind, index, "name"), problem, "a unique name")
                known_names.add(table.name)
        for index, table in enumerate(self.networks):
            if (table.genomes is None) == (table.drawn is None):
                count = "both" if table.drawn else "neither"
                problem = f"network {index + 1}: has {count} of genomes and drawn"
                yield Problem.of(("network", index), problem, "one of them")

    def points(self) -> Iterator[Point]:
        """Yield all points of the grid; the last parameter varies fastest."""
        for values in itertools.product(*map(self.values, Point._fields)):
            point = Point(*values)
            step_ms = point.step_ms or (PLANAR_STEP_NS if point.planar else units.STEP_NS) / NS_PER_MS
            yield point._replace(line_baud=point.line_baud or 0, step_ms=step_ms)

    def values(self, parameter: str) -> tuple[Any, ...]:
        """Return the values of a parameter, from the grid or from the study's key."""
        values = getattr(self.grid, parameter)
        return (getattr(self, parameter),) if values is None else values

    def _location(self, parameter: str) -> Location:
        """Return where the values of a parameter stand in the file."""
        return (parameter,) if getattr(self.grid, parameter) is None else ("grid", parameter)

    def _value_lists(self) -> Iterator[tuple[Location, tuple[object, ...]]]:
        for key in ("playpens", "controllers", "fitness"):
            yield (key,), getattr(self, key)
        for key in Grid.model_fields:
            yield ("grid", key), getattr(self.grid, key) or ()


_STUDY_PARAMETERS = Grid.model_fields.keys() & Study.model_fields.keys()
"""Parameters of the grid that are also keys of a study."""


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A study read from a file.

    Attributes:
        study: Content of the study.
        source: Name of the file in messages.
        folder: Folder of the file.
        lines: Lines of its keys.
    """

    study: Study
    source: str
    folder: Path
    lines: LineNumbers

    @property
    def output(self) -> Path:
        """Folder of the results."""
        return self.folder / self.study.output

    def error(self, location: Location, text: str) -> StudyError:
        """Return an error at a location in the file."""
        problem = Problem(location, text, file=self.source, line=self.lines.find(location))
        return StudyError(problems=[problem])


def load(path: StrPath) -> StudyFile:
    """Load a study by its path.

    Raises:
        StudyError: There is no file, or it cannot be used; one line per problem.
    """
    path = Path(path)
    text, source = toml_files.read("studies", path, StudyError)
    study = toml_files.validate(Study, text, source, StudyError)
    return StudyFile(study, source, path.parent.absolute(), LineNumbers(text))


def study_error(file: StudyFile, location: Location, key: str, error: KhepTwinError) -> StudyError:
    """Return an error in a file that a study refers to, as an error of the study."""
    return file.error(location, f"{key}: {str(error).splitlines()[0]}")
