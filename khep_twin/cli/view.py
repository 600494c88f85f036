"""`khep-twin view`: logs shown in rerun, or written as a page."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.completion import logs as known_logs
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, check_new, notify, print_files, usage
from khep_twin.cli.progress import duration_text, progress
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.atomic import is_same, unusable
from khep_twin.process.invocation import command
from khep_twin.process.signals import stopping

MAX_LOGS = 8
"""Maximum number of logs on a page, side by side."""


@with_help
def view(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", autocompletion=known_logs)],
    save: Path | None = None,
    png: Path | None = None,
    at: Annotated[float | None, typer.Option(min=0)] = None,
    live: bool = False,
    web: bool = False,
    no_browser: bool = False,
    html: Path | None = None,
    with_log: bool = False,
    force: Force = False,
) -> None:
    """Show a log in rerun, or several side by side.

    The views are arena, robots from above, curves and transcript.

    Args:
        logs: Log, FILE.mcap, or several to compare.
        save: Write a rerun recording, FILE.rrd, instead of opening it.
        png: Render a still as this PNG file instead, without a screen.
        at: Simulated time of the still [s]; by default the run's end.
        live: Follow the log of a running `run` or `serve` while it is written.
        web: Show it in a browser on this machine instead of a window.
        no_browser: With --web: only print the page's address.
        html: Write one HTML file that plays the logs in any browser, without rerun or a network.
        with_log: With --html: keep the logs in the file, to be saved from there.
    """
    _check_options(logs, save, png, live, web, no_browser, html, with_log)
    check_new(force, save, png, html)
    if html is not None:
        write_html(logs, html, with_log, force)
        return
    if live:
        # Hides rerun's error when the window is closed and its connection breaks; rerun reads this once.
        os.environ.setdefault("RUST_LOG", "off")
    for log in () if live else logs:
        _note_thinning(log)
    if png is not None:
        from khep_twin.log.viewer.replay import view_still

        view_still(logs, png, at, progress, force)
        typer.echo(f"picture  {png}")
        return
    from khep_twin.log.viewer.replay import view as view_logs

    if save is not None:
        view_logs(logs, save, bar=progress, replace=force)
        print_files("recording", [save], command(save, program="rerun"))
        return
    from khep_twin.log.viewer.process import Web

    page = Web(typer.echo, not no_browser) if web else None
    with stopping() as stop:
        if live:
            from khep_twin.log.viewer.live import view_live

            view_live(logs[0], page, stop, notify)
        else:
            view_logs(logs, web=page, stop=stop, bar=progress)


def write_html(logs: Sequence[Path], target: Path, with_log: bool, force: bool) -> None:
    """Write a page that plays logs, and print its name and size."""
    from khep_twin.web.run_page import RunPage

    with progress() as show:
        RunPage(logs, with_log=with_log, progress=show).save(target, force)
    typer.echo(f"page     {target}: {target.stat().st_size / 1e6:.1f} MB, opens in any browser")


def check_html(target: Path, logs: Sequence[Path] = ()) -> None:
    """Refuse the file of a page that cannot be written."""
    if target.suffix.lower() not in (".html", ".htm"):
        raise usage(f"--html {target}: expected a name that ends in .html")
    if any(is_same(target, log) for log in logs):
        raise LogError(f"{target}: this is the log itself; expected a separate file")
    if reason := unusable(target):
        raise usage(f"--html {target}: cannot be written: {reason}")


def _note_thinning(log: Path) -> None:
    """Print a note if a long log is shown with fewer samples."""
    from khep_twin.log.reader import read_end_ns
    from khep_twin.log.viewer.thinning import thinning_interval_ns

    end_ns = read_end_ns(log)
    if step_ns := thinning_interval_ns(end_ns):
        reason = f"as it lasts {duration_text(end_ns / NS_PER_S)}; khep-twin export writes all"
        notify(f"{log}: one sample in {step_ns / NS_PER_S:.2f} s is shown, {reason}")


def _check_options(
    logs: list[Path],
    save: Path | None,
    png: Path | None,
    live: bool,
    web: bool,
    no_browser: bool,
    html: Path | None,
    with_log: bool,
) -> None:
    """Refuse incompatible options, and output files that cannot be written."""
    files = {"--save": save, "--png": png, "--html": html}
    mode_options = {name: path is not None for name, path in files.items()} | {"--web": web, "--live": live}
    options = [name for name, is_set in mode_options.items() if is_set]
    if len(options) > 1 and options != ["--web", "--live"]:
        raise usage(f"{' and '.join(options)} cannot be combined; expected one of them, or --web and --live")
    if no_browser and not web:
        raise usage("--no-browser is for --web")
    if with_log and html is None:
        raise usage("--with-log keeps the logs in a page; expected --html FILE.html with it")
    if html is not None:
        check_html(html, logs)
        if len(logs) > MAX_LOGS:
            raise usage(f"--html: {len(logs)} logs; expected at most {MAX_LOGS}, side by side")
    if save is not None and save.suffix.lower() != ".rrd":
        raise usage(f"--save {save}: expected a name that ends in .rrd, a recording for rerun")
    if live and len(logs) > 1:
        raise usage(f"--live follows one log, not {len(logs)}")
    if png is not None:
        if png.suffix.lower() != ".png":
            raise usage(f"--png {png}: expected a name that ends in .png")
        if reason := unusable(png):
            raise usage(f"--png {png}: cannot be written: {reason}")
        if any(is_same(png, log) for log in logs):
            raise LogError(f"{png}: this is the log itself; expected a separate file")
