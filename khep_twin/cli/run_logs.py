"""The logs of `khep-twin run`, one or one for each new twin, and the picture drawn from them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from khep_twin.cli.option_groups import LogOptions
from khep_twin.cli.options import check_new, tell_kept, tell_written

if TYPE_CHECKING:
    from khep_twin.lab.experiment.controller_source import Source
    from khep_twin.log.recorder import Recorder
    from khep_twin.ports.twin import Twin


class RunLogs:
    """Logs of a run, or of a series, from which a picture may be drawn at the end."""

    def __init__(self, options: LogOptions, picture: Path | None, source: "Source") -> None:
        self._options, self._path, self._picture, self._source = options, options.log, picture, source
        self._recorders: list[Recorder] = []

    def record(self, twin: "Twin", number: int | None = None) -> None:
        """Start the log of a twin; with a number its own one, NAME-001.mcap."""
        from khep_twin.lab.experiment.series_run import numbered

        if self._path is None:
            return
        path = self._path if number is None else numbered(self._path, number)
        twin.record(
            path,
            facts=self._source.facts,
            attachments=self._source.attachments,
            on_failure=self._options.on_failure,
        )
        tell_kept(twin.recorder)
        if twin.recorder is not None:
            self._recorders.append(twin.recorder)

    def check_new(self, runs: int | None, force: bool, resume: bool) -> None:
        """Refuse to replace finished logs: the only one, or with `runs` one for each.

        With `resume`, those of the same controller may be: an interrupted run has left its log whole, and is
        run again.
        """
        from khep_twin.lab.experiment.series_run import numbered

        check_new(force, self._picture)
        if self._path is not None:
            paths = [self._path] if runs is None else [numbered(self._path, i + 1) for i in range(runs)]
            check_new(force, *(path for path in paths if not (resume and self._is_own(path))))

    def _is_own(self, path: Path) -> bool:
        """Return whether a file is a log of this controller."""
        from khep_twin.errors import LogError
        from khep_twin.log.reader import read_label

        try:
            label = read_label(path)
        except LogError:
            return False
        facts, attachments = self._source.facts.items(), self._source.attachments.items()
        return facts <= label.metadata.items() and attachments <= label.attachments.items()

    def failed(self) -> bool:
        """Return whether a log has failed without which runs cannot continue."""
        return not self._options.ignore_log_errors and any(each.failure for each in self._recorders)

    def finish(self) -> None:
        """Print where the logs are and draw them; end the command if one has failed."""
        for recorder in self._recorders:
            self._options.check(recorder)
        paths = [each.path for each in self._recorders]
        if not paths:
            return
        if self._picture is not None:
            draw_logs(paths, self._picture, self._options.force)
            typer.echo(f"picture  {self._picture}")
        tell_written("log", paths)


def draw_logs(logs: Sequence[Path], picture: Path, force: bool) -> None:
    """Draw the playpen and the driven paths of logs."""
    from khep_twin.drawing import map as drawing
    from khep_twin.log.reader import read_log

    runs = [read_log(log) for log in logs]
    # Of several logs, paths have the names of these.
    paths = [replace(path, robot=run.source.stem) for run in runs for path in run.paths]
    figure = drawing.draw(runs[0].playpen, runs[0].paths if len(runs) == 1 else paths)
    drawing.save(figure, picture, force)
