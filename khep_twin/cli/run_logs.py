"""Logs of `khep-twin run`, one in all or one per new twin, and the picture and page made from them."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from khep_twin import drawing
from khep_twin.cli.option_groups import LogOptions
from khep_twin.cli.options import check_new, print_files, print_kept_log, usage
from khep_twin.cli.view import MAX_LOGS, write_html
from khep_twin.errors import LogError

if TYPE_CHECKING:
    from khep_twin.lab.experiment.controller_source import Source
    from khep_twin.log.recorder import Recorder
    from khep_twin.ports.twin import Twin


class RunLogs:
    """Logs of a run, or of a series, from which a picture and a page may be made at the end."""

    def __init__(
        self, options: LogOptions, picture: Path | None, html: Path | None, source: "Source"
    ) -> None:
        self._options = options
        self._path = options.log
        self._picture = picture
        self._html = html
        self._source = source
        self._recorders: list[Recorder] = []

    def record(self, twin: "Twin", run_number: int | None = None) -> None:
        """Start the log of a twin; with a number, a separate one, NAME-001.mcap."""
        from khep_twin.lab.experiment.series_run import numbered_path

        if self._path is None:
            return
        path = self._path if run_number is None else numbered_path(self._path, run_number)
        twin.record(
            path,
            facts=self._source.facts,
            attachments=self._source.attachments,
            on_failure=self._options.on_failure,
        )
        print_kept_log(twin.recorder)
        if twin.recorder is not None:
            self._recorders.append(twin.recorder)

    def check_new(self, runs: int | None, force: bool, resume: bool) -> None:
        """Refuse to replace finished logs: the only one, or one per run with `runs`.

        With `resume`, logs of the same controller may be replaced: an interrupted run leaves a complete log,
        and is repeated.
        """
        from khep_twin.lab.experiment.series_run import numbered_path

        check_new(force, self._picture, self._html)
        if self._html is not None and runs is not None and runs > MAX_LOGS:
            raise usage(f"--html: {runs} runs; expected at most {MAX_LOGS}, side by side")
        if self._path is not None:
            paths = [self._path] if runs is None else [numbered_path(self._path, i + 1) for i in range(runs)]
            check_new(force, *(path for path in paths if not (resume and self._has_same_controller(path))))

    def _has_same_controller(self, path: Path) -> bool:
        """Return whether a file is a log of this controller."""
        from khep_twin.log.reader import read_label

        try:
            label = read_label(path)
        except LogError:
            return False
        facts, attachments = self._source.facts.items(), self._source.attachments.items()
        return facts <= label.metadata.items() and attachments <= label.attachments.items()

    def has_failed(self) -> bool:
        """Return whether a log has failed and --ignore-log-errors is not set."""
        return not self._options.ignore_log_errors and any(recorder.failure for recorder in self._recorders)

    def finish(self) -> None:
        """Print the logs' paths and draw them; end the command if a log has failed."""
        for recorder in self._recorders:
            self._options.check(recorder)
        paths = [recorder.path for recorder in self._recorders]
        if not paths:
            return
        if self._picture is not None:
            from khep_twin.log.reader import read_log

            runs = [read_log(log) for log in paths]
            # With several logs, each path is labelled by its log's name.
            tracks = [replace(path, robot=run.source.stem) for run in runs for path in run.paths]
            figure = drawing.draw(runs[0].playpen, runs[0].paths if len(runs) == 1 else tracks)
            drawing.save(figure, self._picture, self._options.force)
            typer.echo(f"picture  {self._picture}")
        if self._html is not None:
            write_html(paths, self._html, False, self._options.force)
        print_files("log", paths)
