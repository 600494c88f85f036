"""A study as work: all its lives in one order, cut into tasks that any process can do by itself.

Lives are numbered from 0: playpen by playpen, and within one by controller, noise, spread, lighting, genome,
start and seed, the last one first to change. A task is a stretch of these numbers with one playpen,
controller, noise, spread and lighting. What it gives depends on nothing but the study.
"""

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from khep_twin import __version__, playpen
from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.files.atomic import read_regular
from khep_twin.lab.experiment import start_poses
from khep_twin.playpen import Playpen
from khep_twin.rollout.life import Ground
from khep_twin.rollout.minds import Driver, Floats, Wander
from khep_twin.sensing import calibration
from khep_twin.sweep.genomes import genomes_of
from khep_twin.sweep.programs import Program, function_of
from khep_twin.sweep.study import Study, StudyFile, checked


@dataclass(frozen=True, slots=True)
class Controller:
    """One of a study's controllers.

    Attributes:
        name: in the results.
        driver: what drives, or the program that defines it.
        genomes: (n, n_genes).
    """

    name: str
    driver: Driver | Program
    genomes: Floats


@dataclass(frozen=True, slots=True)
class Group:
    """Lives that differ by genome, start and seed alone.

    Attributes:
        playpen: which of the study's.
        controller: which of the study's.
        noise: whether sensors are noisy.
        spread: whether each life has other sensors.
        lighting: "all" or "off".
        starts: words for them; "playpen" and "random" go by the seed.
        first: number of its first life.
        count: of its lives.
    """

    playpen: int
    controller: int
    noise: bool
    spread: bool
    lighting: str
    starts: tuple[str, ...]
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class Task:
    """A stretch of lives of one group.

    Attributes:
        index: of the task, from 0.
        group: which.
        first: number of its first life, among all.
        count: of its lives.
    """

    index: int
    group: int
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class Work:
    """All that a process needs to do any of a study's tasks.

    Attributes:
        study: what it says.
        playpens: as texts, which are equal where playpens are.
        controllers: all of them.
        measures: functions that lives are measured by, by their names.
        groups: all of them.
        tasks: all of them.
        digest: tells this work from any other.
        versions: of what leads the lives, where the work was made.
    """

    study: Study
    playpens: tuple[str, ...]
    controllers: tuple[Controller, ...]
    measures: tuple[tuple[str, Program], ...]
    groups: tuple[Group, ...]
    tasks: tuple[Task, ...]
    digest: str
    versions: str

    @property
    def lives(self) -> int:
        """How many there are."""
        return sum(group.count for group in self.groups)


def versions() -> str:
    """Of what leads lives here."""
    return f"khep_twin {__version__} with mujoco {mujoco.__version__}"


def work_of(file: StudyFile) -> Work:
    """A study made ready.

    Raises:
        StudyError: a playpen, a program or genomes cannot be used.
    """
    study = file.study
    playpens = [_playpen(file, name) for name in study.playpens]
    controllers = tuple(_controllers(file))
    groups: list[Group] = []
    first = 0
    grid = study.grid
    starts = [tuple(_starts(file, each)) for each in playpens]
    points = itertools.product(
        range(len(playpens)), range(len(controllers)), grid.noise, grid.spread, grid.lighting
    )
    for place, mind, noise, spread, lighting in points:
        count = len(controllers[mind].genomes) * len(starts[place]) * study.seeds
        groups.append(Group(place, mind, noise, spread, lighting, starts[place], first, count))
        first += count
    tasks: list[Task] = []
    for number, group in enumerate(groups):
        end = group.first + group.count
        for start in range(group.first, end, study.rollouts_per_task):
            tasks.append(Task(len(tasks), number, start, min(study.rollouts_per_task, end - start)))
    texts = tuple(playpen.dump(each) for each in playpens)
    measures = tuple(
        (table.name, _program(file, "measure", index, table.file))
        for index, table in enumerate(study.measures)
    )
    work = Work(study, texts, controllers, measures, tuple(groups), tuple(tasks), "", versions())
    measured = [calibration.read(each.robots[0].calibration)[1] for each in playpens]
    return replace(work, digest=_digest(work, measured))


def _playpen(file: StudyFile, name: str) -> Playpen:
    """One of a study's playpens, by the name of a shipped one or by path."""
    try:
        found = playpen.load(name if name in playpen.names() else file.folder / name)
        Ground(found, planar=file.study.planar)  # refuses here what lives cannot have
    except KhepTwinError as error:
        raise checked(file, ("playpens",), f'playpens: "{name}"', error) from None
    return found


def _controllers(file: StudyFile) -> Iterator[Controller]:
    for name in file.study.controllers:
        yield Controller(name, Wander(), np.zeros((1, 0)))
    for index, table in enumerate(file.study.networks):
        yield Controller(table.name, table.network(), genomes_of(file, "network", index))
    for index, table in enumerate(file.study.programs):
        program = _program(file, "program", index, table.file, table.memory)
        yield Controller(table.name, program, genomes_of(file, "program", index))


def _program(file: StudyFile, kind: str, index: int, name: str, memory: int = 0) -> Program:
    """What FILE.py:NAME of a study says."""
    path, _, function = name.rpartition(":")
    place, key = (kind, index, "file"), f'{kind} {index + 1}: file = "{name}"'
    try:
        program = Program(read_regular(file.folder / path).decode("utf-8"), path, function, memory)
        function_of(program)
    except (OSError, UnicodeDecodeError) as trouble:
        reason = getattr(trouble, "strerror", None) or "no UTF-8 text"
        raise file.error(place, f"{key}: cannot be read: {reason}") from None
    except ControllerError as error:
        raise checked(file, place, key, error) from None
    return program


def _starts(file: StudyFile, place: Playpen) -> Iterator[str]:
    """Words for each start in a playpen; a grid has one for each of its places."""
    for wish in file.study.grid.starts:
        if wish in ("playpen", "random"):
            yield wish
            continue
        try:
            yield from (str(start) for start in start_poses.starts([wish], place, 0, 1, 0))
        except KhepTwinError as error:
            raise checked(file, ("grid", "starts"), f"starts, in {place.name}", error) from None


def _digest(work: Work, measured: list[str]) -> str:
    """Tells all that results depend on: the study, what it names, and the versions of the physics."""
    told: list[Any] = [
        __version__,
        mujoco.__version__,
        work.study.model_dump(mode="json", exclude={"output"}),
    ]
    told += [list(work.playpens), measured, [[name, measure.text] for name, measure in work.measures]]
    for controller in work.controllers:
        genomes = hashlib.sha256(controller.genomes.tobytes()).hexdigest()
        program = controller.driver.text if isinstance(controller.driver, Program) else ""
        told.append([controller.name, controller.genomes.shape, genomes, program])
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()
