"""A study as work: all its episodes in one order, divided into independent tasks.

Episodes are numbered from 0 by playpen, controller, noise, vary, lighting, genome, start and seed; the last
varies fastest. A task is a range of these numbers with one playpen, controller, noise, vary and lighting. Its
results depend on the study alone.
"""

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from khep_twin import __version__, playpen
from khep_twin.episodes.controllers import Braitenberg, Driver, Floats, Network
from khep_twin.episodes.device import refusal
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.network_file import SUFFIX
from khep_twin.errors import ControllerError, KhepTwinError, PlaypenError
from khep_twin.files.atomic import read_regular
from khep_twin.files.text import decode
from khep_twin.lab.experiment import start_poses
from khep_twin.playpen import Playpen
from khep_twin.sensing import calibration
from khep_twin.sweep.programs import Program, function_of, genomes_of
from khep_twin.sweep.study import Study, StudyFile, checked


@dataclass(frozen=True, slots=True)
class ControllerSpec:
    """One of a study's controllers: name in the results, controller or program, and genomes (n, n_genes)."""

    name: str
    driver: Driver | Program
    genomes: Floats


@dataclass(frozen=True, slots=True)
class Group:
    """Episodes that differ by genome, start and seed alone.

    Attributes:
        playpen: Index of the study's playpen.
        controller: Index of the study's controller.
        noise: Whether sensors are noisy.
        vary: Whether each episode has another robot of the same make.
        lighting: "all" or "off".
        starts: Words for the starts; "playpen" and "random" depend on the seed.
        first: Number of its first episode.
        count: Number of episodes.
    """

    playpen: int
    controller: int
    noise: bool
    vary: bool
    lighting: str
    starts: tuple[str, ...]
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class Shard:
    """A range of episodes of one group.

    Attributes:
        index: Index of the task, from 0.
        group: Index of the group.
        first: Number of its first episode, among all.
        count: Number of episodes.
    """

    index: int
    group: int
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class Work:
    """Data for a process to run any of a study's tasks.

    Attributes:
        study: Content of the study.
        playpens: Playpens as texts, equal if the playpens are.
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
    playpens = [_playpen(file, name) for name in study.playpens]
    controllers = tuple(_controllers(file))
    groups: list[Group] = []
    first = 0
    grid = study.grid
    starts = [tuple(_starts(file, each)) for each in playpens]
    points = itertools.product(
        range(len(playpens)), range(len(controllers)), grid.noise, grid.vary, grid.lighting
    )
    for place, controller, noise, vary, lighting in points:
        count = len(controllers[controller].genomes) * len(starts[place]) * study.seeds
        groups.append(Group(place, controller, noise, vary, lighting, starts[place], first, count))
        first += count
    tasks: list[Shard] = []
    for number, group in enumerate(groups):
        end = group.first + group.count
        for start in range(group.first, end, study.rollouts_per_task):
            tasks.append(Shard(len(tasks), number, start, min(study.rollouts_per_task, end - start)))
    texts = tuple(playpen.dump(each) for each in playpens)
    measures = tuple(
        (table.name, _program(file, "measure", index, table.file))
        for index, table in enumerate(study.measures)
    )
    work = Work(study, texts, controllers, measures, tuple(groups), tuple(tasks), "", versions())
    measured = [calibration.read(each.robots[0].calibration)[1] for each in playpens]
    return replace(work, digest=_digest(work, measured))


def _playpen(file: StudyFile, name: str) -> Playpen:
    """Return one of a study's playpens, by the name of a shipped one or by path."""
    try:
        found = Playpen.load(name if name in playpen.names() else file.folder / name)
        if len(found.robots) > 1:
            raise PlaypenError(f"{found.name}: {len(found.robots)} robots; expected one in a study")
        setup = EpisodeSetup(found, planar=file.study.planar)  # raises early for unsupported features
        if file.study.device == "cuda" and (trouble := refusal(setup, Braitenberg(), None)):
            raise PlaypenError(f'device = "cuda": {trouble}')
    except KhepTwinError as error:
        raise checked(file, ("playpens",), f'playpens: "{name}"', error) from None
    return found


def _controllers(file: StudyFile) -> Iterator[ControllerSpec]:
    for name in file.study.controllers:
        if not name.endswith(SUFFIX):
            yield ControllerSpec(name, Braitenberg(), np.zeros((1, 0)))
            continue
        try:
            network = Network.load(file.folder / name)
        except ControllerError as error:
            raise checked(file, ("controllers",), f'controllers: "{name}"', error) from None
        yield ControllerSpec(name, network, np.array([network.genes]))
    for index, table in enumerate(file.study.networks):
        yield ControllerSpec(table.name, table.network(), genomes_of(file, "network", index))
    for index, table in enumerate(file.study.programs):
        program = _program(file, "program", index, table.file, table.memory)
        yield ControllerSpec(table.name, program, genomes_of(file, "program", index))


def _program(file: StudyFile, kind: str, index: int, name: str, memory: int = 0) -> Program:
    """Return the program of a study's FILE.py:NAME."""
    path, _, function = name.rpartition(":")
    place, key = (kind, index, "file"), f'{kind} {index + 1}: file = "{name}"'
    try:
        program = Program(decode(read_regular(file.folder / path)), path, function, memory)
        function_of(program)
    except (OSError, ValueError) as trouble:
        reason = getattr(trouble, "strerror", None) or trouble
        raise file.error(place, f"{key}: cannot be read: {reason}") from None
    except ControllerError as error:
        raise checked(file, place, key, error) from None
    return program


def _starts(file: StudyFile, place: Playpen) -> Iterator[str]:
    """Yield a word for each start in a playpen; a grid has one for each of its positions."""
    for wanted in file.study.grid.starts:
        if wanted in ("playpen", "random"):
            yield wanted
            continue
        try:
            yield from (str(start) for start in start_poses.starts([wanted], place, 0, 1, 0))
        except KhepTwinError as error:
            raise checked(file, ("grid", "starts"), f"starts, in {place.name}", error) from None


def _digest(work: Work, measured: list[str]) -> str:
    """Return a hash of all that results depend on: the study, its files, and the versions of the physics."""
    told: list[object] = [
        __version__,
        mujoco.__version__,
        work.study.model_dump(mode="json", exclude={"output"}),
    ]
    told += [list(work.playpens), measured, [[name, measure.text] for name, measure in work.measures]]
    for controller in work.controllers:
        genomes = hashlib.sha256(controller.genomes.tobytes()).hexdigest()
        program = controller.driver.text if isinstance(controller.driver, Program) else ""
        if isinstance(controller.driver, Network) and controller.driver.genes:  # of a file, not of the study
            program = repr(controller.driver)
        told.append([controller.name, controller.genomes.shape, genomes, program])
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
