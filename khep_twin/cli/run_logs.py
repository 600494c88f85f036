"""The logs of `khep-twin run`, one or one for each new twin, and the picture drawn from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from khep_twin.cli.options import check_log, check_new, complain, tell_kept, usage
from khep_twin.invocation import command

if TYPE_CHECKING:
    from khep_twin.lab.experiment.controller_source import Source
    from khep_twin.log.recorder import Recorder
    from khep_twin.ports.twin import Twin


class RunLogs:
    """Logs of a run, or of a series.

    Args:
        path: Path of the log; None for none.
        picture: Picture that is drawn from it at the end; None for none.
        carry_on: Continue runs without a log that cannot be written.
        source: Source of the controller.
    """

    def __init__(self, path: Path | None, picture: Path | None, carry_on: bool, source: "Source") -> None:
        self._path, self._picture, self._carry_on, self._source = path, picture, carry_on, source
        self._folder = Path.cwd()  # a controller may go to another one
        self._recorders: list[Recorder] = []

    def record(self, twin: "Twin", number: int | None = None) -> None:
        """Start the log of a twin; with a number its own one, NAME-001.mcap."""
        from khep_twin.lab.experiment.series import numbered

        if self._path is None:
            return
        path = self._path if number is None else numbered(self._path, number)
        told = complain if self._carry_on else None
        twin.record(
            self._folder / path, facts=self._source.facts, attachments=self._source.attachments, carry_on=told
        )
        tell_kept(twin.recorder)
        if twin.recorder is not None:
            self._recorders.append(twin.recorder)

    def check_new(self, runs: int | None, force: bool) -> None:
        """Refuse to replace finished logs: the only one, or with `runs` one for each."""
        from khep_twin.lab.experiment.series import numbered

        if self._path is not None:
            paths = [self._path] if runs is None else [numbered(self._path, i + 1) for i in range(runs)]
            check_new(force, *paths)

    def failed(self) -> bool:
        """Return True if a log has failed that runs cannot go on without."""
        return not self._carry_on and any(each.failure is not None for each in self._recorders)

    def finish(self) -> None:
        """Print where the logs are and draw them; end the command if one has failed."""
        for recorder in self._recorders:
            check_log(recorder, self._carry_on)
        typed = self._path is not None and self._path.is_absolute()
        paths = [each.path if typed else each.path.relative_to(self._folder) for each in self._recorders]
        if not paths:
            return
        if self._picture is not None:
            draw_logs(paths, self._picture)
            typer.echo(f"picture  {self._picture}")
        more = f" to {paths[-1].name}" if len(paths) > 1 else ""
        typer.echo(f"log      {paths[0]}{more}      look at it: {command('view', paths[0])}")


def draw_logs(logs: Sequence[Path], picture: Path) -> None:
    """Draw the playpen and the driven paths of logs."""
    from khep_twin.drawing import map as drawing
    from khep_twin.log.attached import playpen_of
    from khep_twin.log.reader import read

    runs = [read(log) for log in logs]
    tracks = [
        drawing.DrawnPath(
            name if len(logs) == 1 else log.stem, track.times_ns / 1e9, track.pose[:, :2] * 1000
        )
        for log, run in zip(logs, runs, strict=True)
        for name, track in run.robots.items()
    ]
    found = playpen_of(runs[0].attachments, logs[0])
    drawing.save(drawing.draw(found, tracks), picture)


def check_picture(picture: Path | None, log: Path | None, fast: bool) -> None:
    """Refuse a picture that could not be drawn at the end of the run."""
    if picture is None:
        return
    if log is None and not fast:
        raise usage("--picture draws the path from the log; expected --log FILE.mcap, too")
    if picture.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise usage(f"--picture {picture}: expected a name that ends in .png, .svg or .pdf")
    if log is not None and picture.resolve() == log.resolve():
        raise usage(f"--picture {picture}: this is the log; expected a file of its own")
    if not picture.parent.is_dir():
        raise usage(f"--picture {picture}: there is no directory {picture.parent}")
