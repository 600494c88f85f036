"""A study as work: all its episodes in a fixed order, divided into independent tasks.

Episodes are numbered from 0 by playpen, controller, point of the grid (`Point`), genome, start and seed; the
last varies fastest. A task (`Shard`) is a range of these numbers in which only genome, start and seed vary.
Its results depend only on the study.
"""

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from khep_twin import __version__, playpen
from khep_twin.episodes.controllers import Braitenberg, Driver, Floats, Network, find_terms
from khep_twin.episodes.device import find_unsupported
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.network_file import SUFFIX
from khep_twin.errors import ControllerError, KhepTwinError, PlaypenError
from khep_twin.files.atomic import read_regular
from khep_twin.files.text import decode
from khep_twin.lab.experiment import start_poses
from khep_twin.playpen import Playpen
from khep_twin.robots.model import RobotModel
from khep_twin.sensing import calibration
from khep_twin.sweep.programs import Program, driver_of, function_of, genomes_of
from khep_twin.sweep.study import COLUMNS, Point, Study, StudyFile, study_error


@dataclass(frozen=True, slots=True)
class ControllerSpec:
    """Controller of a study: name in the results, controller or program, and genomes (n, n_genes)."""

    name: str
    driver: Driver | Program
    genomes: Floats


@dataclass(frozen=True, slots=True)
class Group:
    """Episodes that differ only by genome, start and seed.

    Attributes:
        playpen: Index of the study's playpen.
        controller: Index of the study's controller.
        point: Point of the study's grid.
        starts: Texts of the starts; "playpen" and "random" depend on the seed.
        first: Number of the first episode.
        count: Number of episodes.
    """

    playpen: int
    controller: int
    point: Point
    starts: tuple[str, ...]
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class Shard:
    """A range of episodes of one group.

    Attributes:
        index: Index of the task, from 0.
        group: Index of the group.
        first: Number of the first episode, among all.
        count: Number of episodes.
    """

    index: int
    group: int
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class Work:
    """Data by which a process can run any of a study's tasks.

    Attributes:
        study: Content of the study.
        playpens: Playpens as TOML texts; equal playpens have equal texts.
        controllers: All controllers.
        measures: Names and functions of the user's metrics.
        groups: All groups.
        tasks: All tasks.
        digest: Hash that identifies this work.
        versions: Versions of khep_twin and MuJoCo where the work was created.
    """

    study: Study
    playpens: tuple[str, ...]
    controllers: tuple[ControllerSpec, ...]
    measures: tuple[tuple[str, Program], ...]
    groups: tuple[Group, ...]
    tasks: tuple[Shard, ...]
    digest: str
    versions: str

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return sum(group.count for group in self.groups)


def versions() -> str:
    """Return the versions of khep_twin and MuJoCo here."""
    return f"khep_twin {__version__} with mujoco {mujoco.__version__}"


def work_of(file: StudyFile) -> Work:
    """Return the work of a study.

    Raises:
        StudyError: A playpen, a program or genomes cannot be used.
    """
    study = file.study
    playpens = [_load_playpen(file, name) for name in study.playpens]
    models = {model.robots[0].robot_model.family: model.robots[0].robot_model for model in playpens}
    if len(models) > 1:
        problem = f"playpens: robots of the models {', '.join(models)}; expected one model"
        raise file.error(("playpens",), problem)
    (robot_model,) = models.values()
    controllers = tuple(_load_controllers(file, robot_model))
    groups: list[Group] = []
    first_episode = 0
    starts = [tuple(_start_texts(file, model)) for model in playpens]
    ranges = range(len(playpens)), range(len(controllers)), tuple(study.points())
    for index, controller, point in itertools.product(*ranges):
        count = len(controllers[controller].genomes) * len(starts[index]) * study.seeds
        groups.append(Group(index, controller, point, starts[index], first_episode, count))
        first_episode += count
    tasks: list[Shard] = []
    for number, group in enumerate(groups):
        end = group.first + group.count
        for start in range(group.first, end, study.rollouts_per_task):
            tasks.append(Shard(len(tasks), number, start, min(study.rollouts_per_task, end - start)))
    texts = tuple(playpen.dump(model) for model in playpens)
    measures = tuple(
        (table.name, _load_program(file, "measure", index, table.file))
        for index, table in enumerate(study.measures)
    )
    work = Work(study, texts, controllers, measures, tuple(groups), tuple(tasks), "", versions())
    calibrations = [calibration.read(model.robots[0].calibration)[1] for model in playpens]
    return replace(work, digest=_digest(work, calibrations))


def _load_playpen(file: StudyFile, name: str) -> Playpen:
    """Return one of a study's playpens, by the name of a shipped one or by path."""
    try:
        model = Playpen.load(name if name in playpen.names() else file.folder / name)
        if len(model.robots) > 1:
            raise PlaypenError(f"{model.name}: {len(model.robots)} robots; expected one in a study")
        for planar in file.study.values("planar"):
            setup = EpisodeSetup(model, planar=planar)  # raises early for unsupported features
            if file.study.device == "cuda" and (reason := find_unsupported(setup, Braitenberg(), None)):
                raise PlaypenError(f'device = "cuda": {reason}')
    except KhepTwinError as error:
        raise study_error(file, ("playpens",), f'playpens: "{name}"', error) from None
    return model


def _load_controllers(file: StudyFile, model: RobotModel) -> Iterator[ControllerSpec]:
    for name in file.study.controllers:
        try:
            driver = Network.load(file.folder / name) if name.endswith(SUFFIX) else Braitenberg()
            find_terms(driver, model)
        except KhepTwinError as error:
            raise study_error(file, ("controllers",), f'controllers: "{name}"', error) from None
        yield ControllerSpec(name, driver, np.array([getattr(driver, "genes", ())]))
    for index, table in enumerate(file.study.networks):
        try:
            network, limit = table.network(model), model.episode_interface.speed_limit
        except KhepTwinError as error:
            location = "network", index, "terms"
            raise study_error(file, location, f"network {index + 1}: terms", error) from None
        if network.top_speed > limit:
            location = "network", index, "top_speed_pulses"
            problem = f"network {index + 1}: top_speed_pulses = {network.top_speed:g}"
            raise file.error(location, f"{problem}; expected a number up to {limit}")
        yield ControllerSpec(table.name, network, genomes_of(file, "network", index, network.n_genes))
    for index, table in enumerate(file.study.programs):
        program = _load_program(file, "program", index, table.file, table.memory)
        try:
            find_terms(driver_of(program), model)
        except KhepTwinError as error:
            location, key = ("program", index, "file"), f'program {index + 1}: file = "{table.file}"'
            raise study_error(file, location, key, error) from None
        yield ControllerSpec(table.name, program, genomes_of(file, "program", index, None))


def _load_program(file: StudyFile, kind: str, index: int, name: str, memory: int = 0) -> Program:
    """Return the program of a study's FILE.py:NAME."""
    path, _, function = name.rpartition(":")
    location, key = (kind, index, "file"), f'{kind} {index + 1}: file = "{name}"'
    try:
        program = Program(decode(read_regular(file.folder / path)), path, function, memory)
        function_of(program)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise file.error(location, f"{key}: cannot be read: {reason}") from None
    except ControllerError as error:
        raise study_error(file, location, key, error) from None
    return program


def _start_texts(file: StudyFile, model: Playpen) -> Iterator[str]:
    """Yield a text for each start in a playpen; a grid has one per position."""
    for spec in file.study.grid.starts:
        if spec in ("playpen", "random"):
            yield spec
            continue
        try:
            yield from (str(start) for start in start_poses.starts([spec], model, 0, 1, 0))
        except KhepTwinError as error:
            raise study_error(file, ("grid", "starts"), f"starts, in {model.name}", error) from None


def _digest(work: Work, calibrations: list[str]) -> str:
    """Return a hash of all that results depend on: the study, its files, the columns, and the versions."""
    study = work.study.model_dump(mode="json", exclude={"output"})
    content: list[object] = [__version__, mujoco.__version__, sorted(COLUMNS), study]
    content += [list(work.playpens), calibrations, [[name, measure.text] for name, measure in work.measures]]
    for controller in work.controllers:
        genomes = hashlib.sha256(controller.genomes.tobytes()).hexdigest()
        program = controller.driver.text if isinstance(controller.driver, Program) else ""
        if isinstance(controller.driver, Network) and controller.driver.genes:  # of a file, not of the study
            program = repr(controller.driver)
        content.append([controller.name, controller.genomes.shape, genomes, program])
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
