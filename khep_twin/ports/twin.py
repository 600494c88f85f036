"""A twin ready for a host: a world, the robot on the line and the log, built from options.

All ports (khep://, serve) and the command line describe a twin by the same options, so that the same options
give the same run.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Self

from khep_twin.board.fault_injection import parse_fault
from khep_twin.clock import TimeSource
from khep_twin.errors import KhepTwinError, PortError
from khep_twin.files.paths import StrPath
from khep_twin.log.recorder import Recorder, WorldRecorder
from khep_twin.log.run_description import LogPrefix, RunDescription
from khep_twin.playpen import Playpen, PlaypenLike
from khep_twin.playpen.checks import find_unfit_keys, playpen_problems
from khep_twin.playpen.parts import model_defaults
from khep_twin.randomness import SEED_LIMIT
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import installed_models, installed_roms, is_installed
from khep_twin.robots.robot import Robot
from khep_twin.world import World


@dataclass(frozen=True, slots=True)
class TwinOptions:
    """Options of a simulated playpen; options that are None keep the playpen's values.

    Attributes:
        seed: Seed of every random stream.
        robot: Number of the robot on the line; None for all of them.
        noise: Add noise to the sensors.
        vary: Draw the robots' parameters randomly around their calibration, as for other units of the model.
        rom: Version of the robot's firmware.
        mode: Running mode, which sets the line's baud rate.
        battery_used_min: Use of the robot's cells before the run [min].
        unpaced: Transmit bytes without delay.
        strict_line: Garble the bytes of a host with another baud rate than the robot's.
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
        """Raise a `PortError` for values that are invalid in every playpen."""
        if not 0 <= self.seed < SEED_LIMIT:
            raise PortError(key="seed", value=self.seed, expected="an integer from 0 to 2**63-1")
        used_min = self.battery_used_min
        if used_min is not None and not 0 <= used_min <= 1000:
            raise PortError(key="battery_used_min", value=used_min, expected="0 to 1000")
        if self.rom is not None and self.rom not in installed_roms():
            raise PortError(key="rom", value=self.rom, expected=installed_roms())
        if self.model is not None and not is_installed(self.model):
            raise PortError(key="model", value=self.model, expected=installed_models())


class SimulatedTime:
    """Simulated time without pacing, a `TimeSource`."""

    def __init__(self, world: World) -> None:
        self._world = world

    def advance_to(self, time_ns: int) -> None:
        """Advance the world to `time_ns` immediately."""
        self._world.advance_to(time_ns)

    def attend(self) -> None:
        """Do nothing: the world belongs to one program."""


class Twin:
    """A world with robots on the line.

    Attributes:
        time_source: Source of simulated time, which is as fast as possible by default.
        world: World of the robots.
        robots: Robots on the line.
        robot: First robot on the line.
        options: Options of the twin.
        recorder: Recorder of its log; None without.
        branched_at_ns: Time at which the run branched off another one [ns]; None for another run.
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
        self.branched_at_ns: int | None = None
        self.views: list[WorldRecorder] = []

    @property
    def robot_model(self) -> RobotModel:
        """Model of the first robot on the line."""
        return self.world.playpen.robots[self.robot.index].robot_model

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the twin; a branch that is refused before its first step leaves no log."""
        if (
            isinstance(error, KhepTwinError)
            and self.recorder is not None
            and self.branched_at_ns == self.world.time_ns
        ):
            self.recorder.discard()
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
        prefix: LogPrefix | None = None,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        """Record the run from now.

        Args:
            path: Path of the complete log, by convention NAME.mcap.
            facts: Further facts about the run, for example the name of its controller.
            attachments: Texts by name besides those of the twin.
            prefix: Start of the run from another log; facts and attachments are then complete.
            on_failure: Callback for the message if the log cannot be written any more, while the run
                continues; None ends the run by a `LogError`.

        Raises:
            LogError: The log cannot be written.
        """
        # The log's name is not recorded: the same run gives the same bytes under any name.
        settings = {key: value for key, value in asdict(self.options).items() if key != "log"}
        run = RunDescription(settings, facts or {}, attachments or {}, prefix)
        self.recorder = Recorder(path, self.world, run, on_failure)
        self.world.add_observer(self.recorder, sample_now=prefix is None or prefix.state is None)

    def watch(self, view: WorldRecorder) -> None:
        """Show the run from now in a live view."""
        self.views.append(view)
        self.world.add_observer(view)

    def show(self) -> None:
        """Show the run from now in rerun, below the cell of a Jupyter notebook.

        The view is updated a few times a second and after each cell. A second call shows it again.

        Raises:
            KhepTwinError: The program is not a Jupyter notebook.
            MissingExtraError: rerun's extra for notebooks is not installed.
        """
        # Only notebooks need rerun here, which takes a second to load.
        from khep_twin.log.viewer.notebook import NotebookView

        view = next((recorder for recorder in self.views if isinstance(recorder, NotebookView)), None)
        if view is None:
            view = NotebookView(self.world, asdict(self.options))
            self.watch(view)
        view.display()

    def flush(self) -> None:
        """Write all buffered records to the log and the live views."""
        for recorder in (self.recorder, *self.views):
            if recorder is not None:
                recorder.flush()

    def close(self) -> None:
        """Complete the log, and send the remaining records to the live views."""
        with ExitStack() as stack:  # the log is completed even if a view fails
            if self.recorder is not None:
                stack.callback(self.recorder.close)
            for view in self.views:
                stack.callback(view.close)


def open_twin(playpen: PlaypenLike, options: TwinOptions | None = None) -> Twin:
    """Open a world for a playpen.

    Raises:
        PlaypenError: The playpen cannot be used.
        CalibrationError: A robot's calibration cannot be used.
        PortError: The playpen has no robot with this number.
        FaultError: A fault is unknown or malformed.
        LogError: The log cannot be written.
    """
    options = options or TwinOptions()
    new_playpen, indices = equip_playpen(playpen, options)
    faults = tuple(parse_fault(fault) for fault in options.faults)
    world = World(
        new_playpen,
        seed=options.seed,
        noise=options.noise,
        vary=options.vary,
        unpaced=options.unpaced,
        strict_line=options.strict_line,
        faults=faults,
    )
    twin = Twin(world, tuple(world.robots[index] for index in indices), options)
    if options.log is not None:
        twin.record(options.log)
    return twin


def equip_playpen(playpen: PlaypenLike, options: TwinOptions) -> tuple[Playpen, Sequence[int]]:
    """Return the playpen with the options applied to its robots, and the indices of those on the line."""
    new_playpen = Playpen.load(playpen)
    n_robots = len(new_playpen.robots)
    if n_robots == 0 or (options.robot is not None and not 0 <= options.robot < n_robots):
        number = 0 if options.robot is None else options.robot
        problem = f"robot = {number}: not in playpen {new_playpen.name!r}"
        raise PortError(problem, key="robot", value=number, expected=range(n_robots))
    indices = range(n_robots) if options.robot is None else [options.robot]
    keys = ("rom", "mode", "battery_used_min")
    option_values = {key: value for key in keys if (value := getattr(options, key)) is not None}
    robots = list(new_playpen.robots)
    for index in indices:
        old_robot = robots[index]
        model = old_robot.model if options.model is None else options.model
        model_values = {} if model == old_robot.model else {"model": model, **model_defaults(model)}
        robots[index] = new_robot = old_robot.model_copy(update={**model_values, **option_values})
        for key, value, expected in find_unfit_keys(new_robot):
            problem = f"{key} = {value!r} with model = {new_robot.model!r}"
            raise PortError(f"{problem}; expected {expected}", key=key, value=value)
        if reason := new_robot.firmware.refusal_reason(new_robot.mode):
            problem = f"mode = {new_robot.mode:X} with rom = {new_robot.rom!r}: {reason}"
            raise PortError(problem, key="mode", value=new_robot.mode)
    new_playpen = new_playpen.model_copy(update={"robots": tuple(robots)})
    if options.model is not None and (misfit := next(playpen_problems(new_playpen), None)):
        raise PortError(f"{new_playpen.name} with model = {options.model!r}: {misfit.text}")
    return new_playpen, indices
