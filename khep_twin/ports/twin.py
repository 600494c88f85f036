"""A twin ready for a host: a world, the robot on the line and the log, built from options.

Every port (khep://, serve) and the command line describe a twin by the same options, so that the same
words give the same run.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Self

from khep_twin.board.fault_injection import parse_fault
from khep_twin.board.rom import ROMS
from khep_twin.clock import TimeSource
from khep_twin.errors import PortError
from khep_twin.files.paths import StrPath
from khep_twin.log.recorder import Recorder, WorldRecorder
from khep_twin.log.run_description import LogPrefix, RunDescription
from khep_twin.playpen import Playpen, PlaypenLike
from khep_twin.playpen.checks import playpen_problems, unfit
from khep_twin.playpen.parts import MODELS
from khep_twin.randomness import SEED_LIMIT
from khep_twin.robot import Robot
from khep_twin.world import World


@dataclass(frozen=True, slots=True)
class TwinOptions:
    """Options of a simulated playpen; those that are None stay as the playpen has them.

    Attributes:
        seed: Seed of every random stream.
        robot: Number of the robot on the line; None for all of them.
        noise: Add noise to the sensors.
        vary: Draw the robots anew around their calibration: others of the same make.
        rom: Version of the robot's firmware.
        mode: Running mode, which sets the line's speed.
        battery_used_min: Time that the robot has run on its cells at start [min].
        unpaced: Let bytes cross the line in no time.
        strict_line: Garble the bytes of a host whose line is set to another speed than the robot's.
        faults: Faults of the robots, in the syntax of `khep_twin.board.fault_injection`.
        log: File to record the run in.
        model: Robot's body, with its sensors and, unless `rom` is given, its firmware.
    """

    seed: int = 0
    robot: int | None = 0
    noise: bool = True
    vary: bool = False
    rom: str | None = None
    mode: int | None = None
    battery_used_min: float | None = None
    unpaced: bool = False
    strict_line: bool = False
    faults: tuple[str, ...] = ()
    log: StrPath | None = None
    model: str | None = None

    def __post_init__(self) -> None:
        """Raise a `PortError` for values that no playpen allows."""
        if not 0 <= self.seed < SEED_LIMIT:
            raise PortError(key="seed", value=self.seed, expected="an integer from 0 to 2**63-1")
        used_min = self.battery_used_min
        if used_min is not None and not 0 <= used_min <= 1000:
            raise PortError(key="battery_used_min", value=used_min, expected="0 to 1000")
        if self.rom is not None and self.rom not in ROMS:
            raise PortError(key="rom", value=self.rom, expected=ROMS)
        if self.model is not None and self.model not in MODELS:
            raise PortError(key="model", value=self.model, expected=MODELS)


class SimulatedTime:
    """Time that passes as fast as its world can be simulated, a `TimeSource`."""

    def __init__(self, world: World) -> None:
        self._world = world

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` at once."""
        self._world.advance_to(time_ns)

    def attend(self) -> None:
        """Do nothing: a program has its own world."""


class Twin:
    """A world with robots on the line.

    Attributes:
        time_source: Passage of time, which is as fast as possible by default.
        world: World of the robots.
        robots: Robots on the line.
        robot: First of them.
        options: Options that it was opened with.
        recorder: Recorder of its log; None without.
        views: Recorders of its live views.
    """

    def __init__(
        self,
        world: World,
        robots: tuple[Robot, ...],
        options: TwinOptions,
        time_source: TimeSource | None = None,
    ) -> None:
        self.world = world
        self.time_source = time_source or SimulatedTime(world)
        self.robots = robots
        self.robot = robots[0]
        self.options = options
        self.recorder: Recorder | None = None
        self.views: list[WorldRecorder] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def advance_to(self, time_ns: int) -> None:
        """Advance the simulation to `time_ns`."""
        self.time_source.advance_to(time_ns)

    def record(
        self,
        path: StrPath,
        *,
        facts: Mapping[str, str] | None = None,
        attachments: Mapping[str, str] | None = None,
        beginning: LogPrefix | None = None,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        """Record the run from here on.

        Args:
            path: Path of the finished log, by custom NAME.mcap.
            facts: Further facts about the run, such as the name of its controller.
            attachments: Texts by name besides the twin's own.
            beginning: Beginning of the run, which another log has; facts and attachments are then complete.
            on_failure: Callback that takes the line about a log that cannot be written any more; the run goes
                on without it; None ends the run by a `LogError`.

        Raises:
            LogError: The log cannot be written.
        """
        # The log's own name is no part of the run: the same run gives the same bytes under any name.
        settings = {key: value for key, value in asdict(self.options).items() if key != "log"}
        run = RunDescription(settings, facts or {}, attachments or {}, beginning)
        self.recorder = Recorder(path, self.world, run, on_failure)
        self.world.add_observer(self.recorder, sample_now=beginning is None or beginning.state is None)

    def watch(self, view: WorldRecorder) -> None:
        """Show the run from here on in a live view."""
        self.views.append(view)
        self.world.add_observer(view)

    def show(self) -> None:
        """Show the run from here on in rerun, below the cell of a notebook.

        The view has what is new a few times a second and after each cell. A second call shows it again.

        Raises:
            KhepTwinError: The program is no notebook of Jupyter.
            MissingExtraError: rerun's part for notebooks is not installed.
        """
        # Only notebooks need rerun here, which takes a second to load.
        from khep_twin.log.viewer.notebook import NotebookView

        view = next((each for each in self.views if isinstance(each, NotebookView)), None)
        if view is None:
            view = NotebookView(self.world, asdict(self.options))
            self.watch(view)
        view.display()

    def flush(self) -> None:
        """Pass on everything so far to the log and the live views."""
        for recorder in (self.recorder, *self.views):
            if recorder is not None:
                recorder.flush()

    def close(self) -> None:
        """Complete the log, and pass on the rest to the live views."""
        with ExitStack() as ends:  # the log is whole even if a view fails
            if self.recorder is not None:
                ends.callback(self.recorder.close)
            for view in self.views:
                ends.callback(view.close)


def open_twin(playpen: PlaypenLike, options: TwinOptions | None = None) -> Twin:
    """Open a world for a playpen.

    Raises:
        PlaypenError: The playpen cannot be used.
        CalibrationError: A robot's calibration cannot be used.
        PortError: The playpen has no such robot.
        FaultError: There is no such fault.
        LogError: The log cannot be written.
    """
    options = options or TwinOptions()
    chosen, on_the_line = equipped(playpen, options)
    faults = tuple(parse_fault(fault) for fault in options.faults)
    world = World(
        chosen,
        seed=options.seed,
        noise=options.noise,
        vary=options.vary,
        unpaced=options.unpaced,
        strict_line=options.strict_line,
        faults=faults,
    )
    twin = Twin(world, tuple(world.robots[index] for index in on_the_line), options)
    if options.log is not None:
        twin.record(options.log)
    return twin


def equipped(playpen: PlaypenLike, options: TwinOptions) -> tuple[Playpen, Sequence[int]]:
    """Return a playpen whose robots are as the options have them, and the indices of those on the line."""
    chosen = Playpen.load(playpen)
    count = len(chosen.robots)
    if count == 0 or (options.robot is not None and not 0 <= options.robot < count):
        number = 0 if options.robot is None else options.robot
        found = f"robot = {number}: not in playpen {chosen.name!r}"
        raise PortError(found, key="robot", value=number, expected=range(count))
    on_the_line = range(count) if options.robot is None else [options.robot]
    keys = ("rom", "mode", "battery_used_min")
    changes = {key: value for key in keys if (value := getattr(options, key)) is not None}
    robots = list(chosen.robots)
    for index in on_the_line:
        before = robots[index]
        model = before.model if options.model is None else options.model
        follows = {} if model == before.model else {"model": model, **MODELS[model]}
        robots[index] = changed = before.model_copy(update={**follows, **changes})
        for key, value, wanted in unfit(changed):
            found = f"{key} = {value!r} with model = {changed.model!r}"
            raise PortError(f"{found}; expected {wanted}", key=key, value=value)
        if reason := ROMS[changed.rom].refused(changed.mode):
            found = f"mode = {changed.mode:X} with rom = {changed.rom!r}: {reason}"
            raise PortError(found, key="mode", value=changed.mode)
    chosen = chosen.model_copy(update={"robots": tuple(robots)})
    if options.model is not None and (problem := next(playpen_problems(chosen), None)):
        raise PortError(f"{chosen.name} with model = {options.model!r}: {problem.text}")
    return chosen, on_the_line
