"""A run of a shadow on the command line: its options, alarms as lines, and a summary."""

import math
import re
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.options import notify, print_files, print_kept_log, usage
from khep_twin.clock import NS_PER_S
from khep_twin.errors import PlaypenError

if TYPE_CHECKING:
    from khep_twin.playpen import Playpen
    from khep_twin.shadow.following import AlarmChange
    from khep_twin.shadow.recording import LineChunk
    from khep_twin.shadow.shadow import ShadowSettings
    from khep_twin.shadow.shadow_log import ShadowLog
    from khep_twin.shadow.update import Update


class ExitOn(StrEnum):
    """Event that ends a shadow."""

    ALARM = "alarm"
    LOST = "lost"


EXIT_CODES = {ExitOn.ALARM: 4, ExitOn.LOST: 5}
"""Exit codes of the events; 3 stands for a failed log, or a run that differs."""

_HALF_WIDTH_95 = 1.96
"""Half width of a 95 % interval [standard deviations]."""

_LEARNED_INTERVAL_NS = 10 * NS_PER_S
"""Interval between two records of learned values in the log [ns]."""

_NUMBER = r"-?\d{1,6}(?:\.\d{1,6})?"
_POSE = re.compile(rf"({_NUMBER}),({_NUMBER}),({_NUMBER})")
_DEVIATIONS = re.compile(r"(\d{1,4}(?:\.\d{1,6})?),(\d{1,3}(?:\.\d{1,6})?)")


class ShadowRun:
    """Run of a shadow that follows a robot.

    Args:
        playpen: Playpen with the robot.
        settings: Settings of the shadow.
        exit_on: Events, of which the first ends the run.
        output: Log of the shadow to write.
        parent: Log that is followed; None for a robot.
    """

    def __init__(
        self,
        playpen: "Playpen",
        settings: "ShadowSettings",
        exit_on: Collection[ExitOn],
        output: Path | None,
        parent: Path | None = None,
    ) -> None:
        from khep_twin.sensing import calibration
        from khep_twin.shadow.following import Follower
        from khep_twin.shadow.shadow import Shadow

        self._calibration = calibration.read(playpen.robots[0].calibration)[0]
        self._shadow = Shadow(playpen, settings)
        self._follower = Follower(self._shadow)
        self._exit_on = exit_on
        self._warm_up(playpen, settings)
        self._log = None
        if output is not None:
            from khep_twin.log.recorder import FLUSH_NS
            from khep_twin.shadow.shadow_log import LIVE_FLUSH_NS, ShadowLog

            flush_ns = FLUSH_NS if parent else LIVE_FLUSH_NS
            self._log = ShadowLog(output, playpen, settings, parent=parent, flush_ns=flush_ns)
        self._playpen = playpen
        self._show_update: Callable[[Update], None] | None = None
        self._output = output
        self._learned_logged_ns = 0
        print_kept_log(self._log)

    def follow(
        self,
        chunks: "Iterable[LineChunk]",
        stop: Callable[[], bool],
        show: Callable[[str], None] | None = None,
    ) -> int:
        """Follow a line until its end, an event of `exit_on` or a signal; return the exit code.

        Args:
            chunks: Bytes transmitted on the line.
            stop: Function that returns whether to end.
            show: Function that takes the pose, as text, after each reply.
        """
        for chunk in chunks:
            for update in self._follower.feed(chunk):
                if self._log is not None:
                    self._write_log(self._log, update)
                if self._show_update is not None:
                    self._show_update(update)
                events = {ExitOn.ALARM} if update.alarms else set[ExitOn]()
                for change in self._follower.changes(update):
                    typer.echo(alarm_line(change))
                if (is_lost := self._follower.loss_change(update)) is not None:
                    typer.echo(_lost_line(update, is_lost))
                    events |= {ExitOn.LOST} if is_lost else set()
                for event in sorted(events.intersection(self._exit_on)):
                    return EXIT_CODES[event]
                if show is not None:
                    show(_status_text(update))
            if stop():
                return 130
        return 0

    @contextmanager
    def show_in_viewer(self, *, web: bool) -> Generator[None]:
        """Show all updates in rerun, in a window or in a browser."""
        from khep_twin.shadow.shadow_viewer import ShadowViewer

        with ShadowViewer(self._playpen, self._shadow.settings, self._output, web=web) as viewer:
            self._show_update = viewer.show
            yield

    def close(self) -> None:
        """Complete the log."""
        if self._log is not None:
            self._log.write_learned(self._shadow.learned)
            self._log.close()

    def print_summary(self, duration_s: float | None = None) -> None:
        """Print the robot's pose, the learned values, the speed of the run, and the log's path.

        Args:
            duration_s: Duration of the run [s]; None if it followed the robot live.
        """
        last = self._follower.last_update
        if last is None:
            typer.echo("khep-twin: no reply with values was heard; expected replies to N or H", err=True)
        else:
            for line in self._summary(last):
                typer.echo(line)
            duration_text = "" if duration_s is None else f" in {duration_s:.1f} s"
            seconds, replies = last.time_ns / NS_PER_S, self._follower.replies
            typer.echo(f"{seconds:.1f} s followed{duration_text}, {replies} replies", err=True)
            if math.isnan(last.measured[0]):
                notify("no reply to N was heard; expected some: the pose is by commands and counters alone")
        if self._output is not None:
            print_files("log", [self._output], width=9, err=True)

    def _write_log(self, log: "ShadowLog", update: "Update") -> None:
        log.write(update)
        if update.time_ns - self._learned_logged_ns >= _LEARNED_INTERVAL_NS:
            self._learned_logged_ns = update.time_ns
            log.write_learned(self._shadow.learned)

    @staticmethod
    def _warm_up(playpen: "Playpen", settings: "ShadowSettings") -> None:
        """Load all compiled code, so that it does not delay the line."""
        from khep_twin.shadow.recording import reads_of
        from khep_twin.shadow.shadow import Shadow

        scratch_shadow = Shadow(playpen, replace(settings, particles=10))
        dialect = playpen.robots[0].robot_model.dialect
        replies = {read.request: ",0" * read.n_values for read in reads_of(dialect)}
        replies = {dialect.drive(1, 1): "", **replies}
        for time_ns, (request, values) in enumerate(replies.items(), 1):
            reply = request[0].lower() + values
            scratch_shadow.feed(time_ns * NS_PER_S // 10, True, request.encode() + b"\n")
            scratch_shadow.feed(time_ns * NS_PER_S // 10 + NS_PER_S // 20, False, reply.encode() + b"\r\n")

    def _summary(self, last: "Update") -> Iterator[str]:
        """Yield lines about states, pose, dead reckoning and wheels, with 95 % intervals."""
        yield f"state      {last.state} at the end; {self._follower.states}"
        (x, y, heading), covariance = last.estimate.pose, last.estimate.covariance
        dx, dy, turn_deviation = (_HALF_WIDTH_95 * math.sqrt(covariance[i, i]) for i in range(3))
        yield (
            f"pose       {x * 1e3:.1f} mm +- {dx * 1e3:.1f}, {y * 1e3:.1f} mm +- {dy * 1e3:.1f}, "
            f"{math.degrees(heading):.1f} degrees +- {math.degrees(turn_deviation):.1f} (95 %)"
        )
        distance_mm = math.hypot(last.reckoned[0] - x, last.reckoned[1] - y) * 1e3
        turn_deg = math.degrees(math.remainder(last.reckoned[2] - heading, math.tau))
        yield f"reckoning  {distance_mm:.0f} mm and {turn_deg:+.1f} degrees off, by commands alone"
        learned, prior = self._shadow.learned, self._calibration.wheels
        radius, ratio, base = learned.wheels.tolist()
        deviations = (_HALF_WIDTH_95 * learned.wheel_deviations).tolist()
        yield (
            f"wheels     radius {prior.radius_mm * radius:.3f} mm +- {prior.radius_mm * deviations[0]:.3f}, "
            f"right over left {prior.right_over_left * ratio:.4f} +- {deviations[1]:.4f}, "
            f"base {prior.base_mm * base:.2f} mm +- {prior.base_mm * deviations[2]:.2f} (95 %)"
        )


def _status_text(update: "Update") -> str:
    """Return time, state, pose and faults as the text of a status line."""
    (x, y, heading), covariance = update.estimate.pose, update.estimate.covariance
    deviation_mm = 1e3 * math.sqrt((covariance[0, 0] + covariance[1, 1]) / 2)
    faults = ", ".join(alarm.fault for alarm in update.alarms) or "no alarm"
    suspected = ", ".join(f"{suspect.name} {100 * suspect.probability:.0f} %" for suspect in update.suspected)
    return (
        f"{update.time_ns / NS_PER_S:.1f} s  {update.state}  {x * 1e3:.0f}, {y * 1e3:.0f} mm +- "
        f"{_HALF_WIDTH_95 * deviation_mm:.0f}, {math.degrees(heading):.0f} degrees  {faults}"
        f"{'; suspected ' if suspected else ''}{suspected}"
    )


def _lost_line(update: "Update", is_lost: bool) -> str:
    """Return a line that the robot is lost, or has been found at a pose."""
    x, y, heading = update.estimate.pose
    pose = f"{x * 1e3:.0f}, {y * 1e3:.0f} mm, {math.degrees(heading):.0f} degrees"
    text = "lost: its place is searched for" if is_lost else f"found: at {pose}"
    return f"{update.time_ns / NS_PER_S:9.2f} s  {text}"


def alarm_line(change: "AlarmChange") -> str:
    """Return a line about the start or end of an alarm."""
    alarm = change.alarm
    status = f"{alarm.sureness:.0%} sure" if alarm.ended_ns is None else "over"
    details = f"{alarm.channel}, since {alarm.since_ns / NS_PER_S:.2f} s, {status}"
    return f"{change.time_ns / NS_PER_S:9.2f} s  {alarm.fault}: {details}"


@dataclass(frozen=True, slots=True)
class ShadowOptions:
    """Options of a shadow."""

    start: Annotated[
        str, typer.Option(help="Start: known, as in the playpen; X,Y,HEADING in mm and degrees; or unknown.")
    ] = "known"
    within: Annotated[str, typer.Option(metavar="MM,DEG", help="Standard deviations of a known start.")] = (
        "10,5"
    )
    seed: Annotated[int, typer.Option(help="Seed of the particles.")] = 0
    particles: Annotated[
        int, typer.Option(min=10, max=100_000, help="Number of particles, once the pose is known.")
    ] = 1000

    def as_arguments(self) -> list[str]:
        """Return these options as arguments of a command line."""
        return [f"--{field.name}={getattr(self, field.name)}" for field in fields(self)]

    def load(self, name: str, robot: int = 0) -> tuple["Playpen", bool]:
        """Return the playpen with only this robot, at its start, and whether it has other robots."""
        from khep_twin.playpen import Playpen, at_start

        playpen = Playpen.load(name)
        if not 0 <= robot < len(playpen.robots):
            expected = f"0 to {len(playpen.robots) - 1}" if len(playpen.robots) > 1 else "0"
            raise PlaypenError(f"{name}: robot {robot}; expected {expected}, as it has {len(playpen.robots)}")
        has_others = len(playpen.robots) > 1
        playpen = playpen.model_copy(update={"robots": (playpen.robots[robot],)})
        if pose := _POSE.fullmatch(self.start):
            x_mm, y_mm, heading_deg = map(float, pose.groups())
            arena = playpen.arena
            if not (0 <= x_mm <= arena.width_mm and 0 <= y_mm <= arena.height_mm):
                expected = f"a place in the arena of {arena.width_mm:g} x {arena.height_mm:g} mm"
                raise usage(f"--start {self.start}: outside; expected {expected}")
            playpen = at_start(playpen, 0, (x_mm, y_mm, heading_deg))
        return playpen, has_others

    def settings(self, baud: int) -> "ShadowSettings":
        """Return the settings of a shadow."""
        from khep_twin.shadow.shadow import ShadowSettings
        from khep_twin.shadow.start import PUBLISHED

        if self.start not in ("known", "unknown") and not _POSE.fullmatch(self.start):
            raise usage(f"--start {self.start}: expected known, unknown or X,Y,HEADING, such as 100,250,90")
        if (within := _DEVIATIONS.fullmatch(self.within)) is None:
            raise usage(f"--within {self.within}: expected MM,DEG, such as 10,5")
        place_deviation, heading_deviation = float(within[1]) / 1e3, math.radians(float(within[2]))
        spread = PUBLISHED._replace(place=place_deviation, heading=heading_deviation)
        return ShadowSettings(self.seed, self.particles, self.start != "unknown", spread, baud)
