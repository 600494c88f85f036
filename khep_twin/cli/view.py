"""`khep-twin view`: logs shown in rerun."""

import os
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


@with_help
def view(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", autocompletion=known_logs)],
    save: Path | None = None,
    png: Path | None = None,
    at: Annotated[float | None, typer.Option(min=0)] = None,
    live: bool = False,
    web: bool = False,
    no_browser: bool = False,
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
    """
    _check_options(logs, save, png, live, web, no_browser)
    check_new(force, save, png)
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


def _note_thinning(log: Path) -> None:
    """Print a note if a long log is shown with fewer samples."""
    from khep_twin.log.reader import read_end_ns
    from khep_twin.log.viewer.thinning import thinning_interval_ns

    end_ns = read_end_ns(log)
    if step_ns := thinning_interval_ns(end_ns):
        reason = f"as it lasts {duration_text(end_ns / NS_PER_S)}; khep-twin export writes all"
        notify(f"{log}: one sample in {step_ns / NS_PER_S:.2f} s is shown, {reason}")


def _check_options(
    logs: list[Path], save: Path | None, png: Path | None, live: bool, web: bool, no_browser: bool
) -> None:
    """Refuse incompatible options, and output files that cannot be written."""
    mode_options = {"--save": save is not None, "--png": png is not None, "--web": web, "--live": live}
    options = [name for name, is_set in mode_options.items() if is_set]
    if len(options) > 1 and options != ["--web", "--live"]:
        raise usage(f"{' and '.join(options)} cannot be combined; expected one of them, or --web and --live")
    if no_browser and not web:
        raise usage("--no-browser is for --web")
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
