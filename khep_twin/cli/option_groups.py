"""Options of commands, and groups of them that several commands share.

    @with_help
    def run(*, seconds: float = 60.0, robot: RobotOptions, log: LogOptions) -> None: ...

A group is a dataclass: each field is an option. The help text of an option is in the docstring of its command
or group (`Args`, `Attributes`), or in typer's `Annotated`.
"""

import inspect
import math
import re
from collections.abc import Callable
from contextlib import ExitStack, closing
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin

import typer

from khep_twin.cli.completion import models, playpens
from khep_twin.cli.options import Force, Switch, notify, running_mode, usage

if TYPE_CHECKING:
    from khep_twin.log.log_file import FileRecorder
    from khep_twin.playpen import Playpen
    from khep_twin.ports.twin import Twin, TwinOptions


ADDRESS = "127.0.0.1:8765"
"""Default address, which Foxglove also proposes."""


def with_help(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command whose options have the help texts of its docstring; groups of options are expanded."""
    signature = inspect.signature(command)
    groups: dict[str, Any] = {
        name: parameter.annotation
        for name, parameter in signature.parameters.items()
        if is_dataclass(parameter.annotation)
    }

    @wraps(command)
    def command_with_options(**option_values: Any) -> None:
        group_values = {
            name: group(**{field.name: option_values.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        command(**option_values, **group_values)

    command_with_options.__doc__, options = _described_options(command)
    parameters = [
        option
        for name in signature.parameters
        for option in (_described_options(groups[name])[1].values() if name in groups else [options[name]])
    ]
    command_with_options.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportAttributeAccessIssue]
    return command_with_options


def _described_options(target: Callable[..., object]) -> tuple[str, dict[str, inspect.Parameter]]:
    """Return the docstring of a command or a group without its options, and these with their help texts."""
    text, *section = re.split(r"\n\n(?:Args|Attributes):\n", inspect.getdoc(target) or "")
    entries = re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", "".join(section), re.MULTILINE)
    help_texts = {name: " ".join(entry.split()) for name, entry in entries}
    options: dict[str, inspect.Parameter] = {}
    for name, option in inspect.signature(target).parameters.items():
        annotation = option.annotation
        if name in help_texts:
            flags = [f"--{name.replace('_', '-')}"] if option.annotation is bool else []
            plain = option.annotation, typer.Option(*flags)
            kind, info = get_args(annotation) if get_origin(annotation) is Annotated else plain
            info = copy(info)
            info.help = help_texts[name]
            annotation = Annotated[kind, info]
        options[name] = option.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=annotation)
    return text, options


def option_names(*groups: type) -> set[str]:
    """Return the names of the options of groups, as in `typed_options`."""
    return {field.name for group in groups for field in fields(group)}


@dataclass(frozen=True, slots=True)
class RobotOptions:
    """Options of a simulated robot.

    Attributes:
        seed: Seed of every random stream of the run.
        noise: Add noise to the sensors, as on the robot.
        vary: Draw another robot of the same model, by the seed.
        mode: Running mode: 1, 2, 3 for 9600, 19200, 38400 baud, with rom khepera2 also 8, 9 for 57600,
            115200; 0 demo; 7 self-test.
        rom: Version of the firmware: 5.02, 4.06 or khepera2.
        model: Model of the robot: body, sensors and, without --rom, firmware.
        battery_used_min: Run on cells used for this number of minutes; by default on the charger.
    """

    seed: int = 0
    noise: Switch = Switch.ON
    vary: Switch = Switch.OFF
    mode: str | None = None
    rom: str | None = None
    model: Annotated[str | None, typer.Option(autocompletion=models)] = None
    battery_used_min: Annotated[float | None, typer.Option(min=0, max=1000)] = None

    def options(self, robot: int | None = 0) -> "TwinOptions":
        """Return the options of a twin with this robot on the line; all robots for None."""
        from khep_twin.ports.twin import TwinOptions

        return TwinOptions(
            self.seed,
            robot,
            self.noise is Switch.ON,
            self.vary is Switch.ON,
            self.rom,
            running_mode(self.mode),
            self.battery_used_min,
            model=self.model,
        )


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """Playpen and lamps of a run."""

    playpen: Annotated[
        str, typer.Option(help="Playpen of the twin: a shipped name, or a path.", autocompletion=playpens)
    ] = "default"
    lighting: Annotated[
        str | None, typer.Option(help="Lamps: all, random, sequenced or off; by default as in the playpen.")
    ] = None
    without_lamp: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="Remove the lamp nearest to this position [mm].")
    ] = None

    def load(self, override: "Playpen | None" = None) -> "Playpen":
        """Return the playpen `override`, or else the option's, with the requested lamps."""
        from khep_twin.lab.experiment.start_poses import parse_numbers, with_lighting, without_nearest_lamp
        from khep_twin.playpen import Playpen

        playpen = with_lighting(Playpen.load(self.playpen) if override is None else override, self.lighting)
        for position_text in self.without_lamp or []:
            position = parse_numbers(position_text, 2)
            if position is None:
                raise usage(f"--without-lamp {position_text}: expected X,Y in mm, such as 50,450")
            playpen = without_nearest_lamp(playpen, *position)
        return playpen


@dataclass(frozen=True, slots=True)
class LengthOptions:
    """Length of a run."""

    seconds: Annotated[float | None, typer.Option(help="Stop after this time [s]; 60 by default.")] = None
    cycles: Annotated[int | None, typer.Option(help="Stop after this number of cycles.")] = None

    def __post_init__(self) -> None:
        """Refuse an empty or endless run."""
        if (self.seconds is not None and not 0 < self.seconds < math.inf) or (
            self.cycles is not None and self.cycles < 1
        ):
            raise usage("--seconds and --cycles are above 0 and finite")


@dataclass(frozen=True, slots=True)
class LogOptions:
    """Log of a run, and the behaviour if it cannot be written."""

    log: Annotated[Path | None, typer.Option(help="Record the run in this MCAP file.")] = None
    ignore_log_errors: Annotated[
        bool,
        typer.Option(
            "--ignore-log-errors",
            help="Continue without the log if it can no longer be written (full disk), with exit code 3.",
        ),
    ] = False
    force: Force = False

    def __post_init__(self) -> None:
        """Refuse --ignore-log-errors without a log."""
        if self.ignore_log_errors and self.log is None:
            raise usage("--ignore-log-errors is about a log that fails; expected --log FILE.mcap with it")

    @property
    def on_failure(self) -> Callable[[str], None] | None:
        """Function that takes the message about a failed log; None to end the run."""
        return notify if self.ignore_log_errors else None

    def check(self, recorder: "FileRecorder | None") -> None:
        """End a run whose log has failed, with the exit code for that."""
        if recorder is None or recorder.failure is None:
            return
        if self.ignore_log_errors:
            raise typer.Exit(3)
        raise recorder.failure


@dataclass(frozen=True, slots=True)
class LiveViewOptions:
    """Options of a live view in Foxglove."""

    foxglove: Annotated[
        bool, typer.Option("--foxglove", help=f"Show the run live in Foxglove, which connects to {ADDRESS}.")
    ] = False
    foxglove_at: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Show it at this address instead; port 0 for any free port."),
    ] = None

    def open_viewers(
        self, stack: ExitStack, name: str, *, viewer: bool, real_time: bool, allow_remote: bool = False
    ) -> "Callable[[Twin], None]":
        """Open the requested live view and MuJoCo viewer; return a function that shows a twin in them.

        Args:
            stack: Context that closes them.
            name: Name that Foxglove shows.
            viewer: True for MuJoCo's viewer.
            real_time: True to slow down a twin that runs ahead of the wall clock.
            allow_remote: Allow connections from other machines.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
            PortError: The address cannot be used, or other machines could reach it.
        """
        server = window = None
        if self.foxglove or self.foxglove_at is not None:
            from khep_twin.ports.network import listening_address

            address = ADDRESS if self.foxglove_at is None else self.foxglove_at
            option = "--allow-remote of khep-twin serve"
            host, port = listening_address(address, "watch the run", allow_remote=allow_remote, option=option)
            from khep_twin.log.foxglove_live import LAYOUT, FoxgloveServer

            server = stack.enter_context(closing(FoxgloveServer(host, port, f"khep_twin {name}")))
            notify(f"Foxglove connects to {server.address}; a layout to import there: {LAYOUT}")
        if viewer:
            from khep_twin.drawing.mujoco_viewer import MujocoViewer

            window = stack.enter_context(closing(MujocoViewer(real_time=real_time)))

        def watch(twin: "Twin") -> None:
            if window is not None:
                window.watch(twin.world)
            if server is not None:
                from khep_twin.log.foxglove_live import FoxgloveRecorder

                twin.watch(FoxgloveRecorder(server, twin.world, real_time=real_time))

        return watch
