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

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from khep_twin.clock import n_steps, to_ns
from khep_twin.episodes.controllers import Network
from khep_twin.episodes.device import Device
from khep_twin.episodes.fitness import TOP_SPEED_PULSES
from khep_twin.episodes.metrics import METRICS
from khep_twin.episodes.network_file import SUFFIX
from khep_twin.errors import KhepTwinError, Location, Problem, StudyError
from khep_twin.files import toml_files
from khep_twin.files.paths import StrPath
from khep_twin.files.toml_files import Name, Problems, TomlTable, format_value
from khep_twin.files.toml_lines import LineNumbers
from khep_twin.randomness import SEED_LIMIT

# Type checkers accept only literal choices; pydantic accepts the tuple, and suggests similar names.
if TYPE_CHECKING:
    Fitness = str
else:
    Fitness = Literal[METRICS]
"""Name of a metric of an episode."""

COLUMNS = frozenset(
    "episode playpen controller genome seed noise vary lighting start start_x_mm start_y_mm "
    "start_heading_deg end_x_m end_y_m end_heading_rad failed_step failure".split()
)
"""Columns of the results besides the metrics."""

Switches = Annotated[tuple[bool, ...], Field(min_length=1, description="a list of true and false")]
Lightings = Annotated[
    tuple[Literal["all", "off"], ...], Field(min_length=1, description='a list of "all" and "off"')
]
Texts = Annotated[tuple[str, ...], Field(min_length=1, description="a list of texts, at least one")]


class NetworkTable(TomlTable):
    """A `[[network]]`: its shape, as in `controllers.Network`, and the source of its genomes."""

    name: Name
    hidden: Annotated[
        tuple[Annotated[int, Field(ge=1, le=1000)], ...],
        Field(description="neurons of each hidden layer, from 1 to 1000"),
    ] = ()
    recurrent: bool = False
    ambient: bool = False
    top_speed_pulses: Annotated[float, Field(gt=0, le=127)] = float(TOP_SPEED_PULSES)
    genomes: Annotated[str | None, Field(description="the path of a .npy or .csv file")] = None
    drawn: Annotated[int | None, Field(ge=1, le=10**7)] = None
    drawn_seed: Annotated[int, Field(ge=0, lt=SEED_LIMIT)] = 0
    drawn_sd: Annotated[float, Field(gt=0, le=1000)] = 1.0

    def network(self) -> Network:
        """Return the controller."""
        return Network(self.hidden, self.recurrent, self.ambient, self.top_speed_pulses)


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
    """Parameters, each with the list of its values."""

    noise: Switches = (True,)
    vary: Switches = (False,)
    lighting: Lightings = ("all",)
    starts: Texts = ("playpen",)


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
    seconds: Annotated[float, Field(gt=0, le=10**6)]
    planar: Annotated[bool, Field(description="true or false")] = False
    device: Device = "cpu"
    step_ms: Annotated[float | None, Field(gt=0, description="2.5, 5 or 10")] = None
    line_baud: Annotated[int | None, Field(ge=1, le=10**9, description="such as 9600")] = None
    period_ms: Annotated[int, Field(ge=10, le=10**4, multiple_of=10, description="a multiple of 10")] = 20
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
        if self.step_ms not in (None, 2.5, 5.0, 10.0):
            yield Problem.of(("step_ms",), f"step_ms = {self.step_ms:g}", "2.5, 5 or 10")
        if self.device == "cuda" and not self.planar:
            yield Problem.of(("device",), 'device = "cuda": episodes in MuJoCo', "planar = true")
        if self.device == "cuda" and self.programs:
            yield Problem.of(("device",), 'device = "cuda": and a [[program]]', "networks or braitenberg")
        try:
            n_steps(to_ns(self.seconds), self.period_ms * 1_000_000)
        except ValueError:
            expected = f"whole control periods of {self.period_ms} ms"
            yield Problem.of(("seconds",), f"seconds = {self.seconds:g}", expected)
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
            for value in sorted({str(value) for value in values if values.count(value) > 1}):
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

    def _value_lists(self) -> Iterator[tuple[Location, tuple[object, ...]]]:
        for key in ("playpens", "controllers", "fitness"):
            yield (key,), getattr(self, key)
        for key in Grid.model_fields:
            yield ("grid", key), getattr(self.grid, key)


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
    if not (path.exists() or path.is_symlink()):
        raise StudyError("no such file", file=path, expected="the path of a study")
    text, source = toml_files.read("studies", path, StudyError)
    study = toml_files.validate(Study, text, source, StudyError)
    return StudyFile(study, source, path.parent.absolute(), LineNumbers(text))


def study_error(file: StudyFile, location: Location, key: str, error: KhepTwinError) -> StudyError:
    """Return an error in a file that a study refers to, as an error of the study."""
    return file.error(location, f"{key}: {str(error).splitlines()[0]}")
