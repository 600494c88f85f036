"""`khep-twin export` and `khep-twin report`: logs as tables, datasets, bags of ROS 2 and pages."""

import math
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from khep_twin.cli.completion import logs
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, check_new, check_writable
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.errors import LogError
from khep_twin.files.atomic import atomic_file, is_same, resolve
from khep_twin.files.drawings import write_drawing

LogFile = Annotated[Path, typer.Argument(metavar="FILE", help="A log, FILE.mcap.", autocompletion=logs)]


@with_help
def export(
    log: Annotated[list[Path], typer.Argument(metavar="FILE...", autocompletion=logs)],
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    channels: str | None = None,
    robot: str | None = None,
    transcript: Path | None = None,
    minari: str | None = None,
    task: str | None = None,
    period: Annotated[float | None, typer.Option(show_default=False)] = None,
    ros2: Path | None = None,
    rate: Annotated[float | None, typer.Option(show_default=False)] = None,
    force: Force = False,
) -> None:
    """Write logs as tables, as a dataset or as a bag of ROS 2.

    Args:
        log: A log, FILE.mcap; several for a dataset.
        output: Table to write: .csv, .parquet or .mat; with --minari a folder of datasets.
        channels: Write only these, e.g. proximity,speed; by default all but registers.
        robot: Name of the robot, e.g. khepera1; by default all robots.
        transcript: Write the transcript of the serial line as this CSV file.
        minari: Write a Minari dataset with this id, e.g. khepera/avoid-v0, for offline learning.
        task: Task of the dataset's observations and rewards, e.g. ObstacleAvoidance.
        period: Control period of the dataset [ms]; by default 50.
        ros2: Write a bag of ROS 2 in this folder, with standard messages for its tools.
        rate: Rate of the bag's messages of sensors [Hz]; by default 10.
    """
    if ros2 is not None:
        options = {"-o": output, "--channels": channels, "--robot": robot, "--transcript": transcript}
        _export_bag(log, ros2, rate, {**options, "--minari": minari}, force)
        return
    if rate is not None:
        raise LogError(f"--rate {rate:g}: expected it with --ros2 alone")
    for name, value in (("--task", task), ("--period", period)):
        if minari is None and value is not None:
            raise LogError(f"{name} {value}: expected it with --minari alone")
    if minari is None:
        if len(log) > 1:
            table = f"-o {log[-1]}" if log[-1].suffix != ".mcap" else "one"
            raise LogError(f"{len(log)} logs; expected {table} for a table, or --minari for a dataset")
        _export_tables(log[0], output, channels, robot, transcript, force)
        return
    if channels is not None or transcript is not None:
        raise LogError("--minari with --channels or --transcript; expected a dataset alone")
    if output is None or task is None:
        raise LogError(f"--minari {minari}: expected -o FOLDER and --task NAME with it")
    _export_dataset(log, output, minari, task, 50.0 if period is None else period, robot, force)


def _export_bag(
    logs: list[Path], folder: Path, rate: float | None, other_options: Mapping[str, object], force: bool
) -> None:
    """Write a bag of one log."""
    from khep_twin.ros.bag import RATE_HZ, check_new_bag, write_bag

    for name, value in other_options.items():
        if value is not None:
            raise LogError(f"--ros2 with {name}; expected a bag alone")
    if len(logs) > 1:
        raise LogError(f"{len(logs)} logs; expected one for a bag")
    rate = RATE_HZ if rate is None else rate
    if not 0 < rate <= 1000:
        raise LogError(f"--rate {rate:g}: expected a rate above 0 and up to 1000 Hz")
    check_new_bag(folder, logs[0], force)
    with progress_bar() as progress:
        n_topics, n_messages = write_bag(logs[0], folder, rate, force, progress)
    typer.echo(f"bag         {folder}: {n_topics} topics, {n_messages} messages")


def _export_tables(
    log: Path,
    output: Path | None,
    channels: str | None,
    robot: str | None,
    transcript: Path | None,
    force: bool,
) -> None:
    """Write tables and the transcript of a log."""
    from khep_twin.lab.report import export as tables
    from khep_twin.log.reader import read_first_messages

    if output is None and transcript is None:
        raise LogError("nothing to write; expected -o FILE.csv, .parquet or .mat, or --transcript FILE.csv")
    _check_outputs(log, *filter(None, (output, transcript)))
    kind = "" if output is None else tables.check_suffix(output)
    if transcript is not None and transcript.suffix.lower() != ".csv":
        raise LogError(f"--transcript {transcript}: expected a name that ends in .csv")
    check_new(force, output, transcript)
    channel_names = None if channels is None else [name.strip() for name in channels.split(",")]
    recording = read_first_messages(log)
    robots = tables.choose_robots(recording, robot)
    selection = tables.choose_channels(recording, robots, channel_names)
    robot_names = tables.describe_robots(robots)
    if output is not None:
        if kind != ".mat" and not selection:
            raise LogError(f"{log}: {robot_names} has no samples; expected --transcript, or -o FILE.mat")
        with atomic_file(output, force) as file, progress_bar() as progress:
            if kind == ".mat":
                data, n_rows = tables.matrices(log, robots, selection, progress)
                file.write(data)
            else:
                n_rows = tables.write_table(log, robots, selection, kind, file, progress)
        names = ", ".join(channel.name for channel in selection) or "no samples"
        typer.echo(f"table       {output}: {robot_names}: {names}; {n_rows} rows")
    if transcript is not None:
        with atomic_file(transcript, force) as file, progress_bar() as progress:
            n_lines = tables.write_transcript(log, robots, file, progress)
        typer.echo(f"transcript  {transcript}: {robot_names}: {n_lines} lines")


def _export_dataset(
    logs: list[Path], folder: Path, dataset_id: str, name: str, period: float, robot: str | None, force: bool
) -> None:
    """Write a Minari dataset of logs."""
    from khep_twin.envs.tasks import find_task
    from khep_twin.lab.dataset.episodes import episodes_of
    from khep_twin.lab.dataset.minari_files import check_new_dataset, spaces_of, spec_of, write_dataset
    from khep_twin.log.reader import read_end_ns

    if not 0 < period < math.inf:
        raise LogError(f"--period {period:g}: expected a time in ms")
    task, period_ns = find_task(name), round(period * 1e6)
    check_new_dataset(folder, dataset_id, force)
    with progress_bar() as progress:
        n_episodes, n_steps = write_dataset(
            folder,
            dataset_id,
            chain.from_iterable(episodes_of(log, task, period_ns, robot, progress) for log in logs),
            spec_of(task, period_ns),
            spaces_of(task),
            description=f"{task.name}, from logs, with a control period of {period:g} ms",
            force=force,
        )
    used_s, logged_s = n_steps * period / 1e3, sum(read_end_ns(log) for log in logs) / 1e9
    typer.echo(
        f"dataset     {folder / dataset_id}: {n_episodes} episodes, {n_steps} steps, {used_s:.1f} of the "
        f"logs' {logged_s:.1f} s"
    )


def report(
    log: LogFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Page to write: .html or .pdf.")],
    force: Force = False,
) -> None:
    """Write a page about a run.

    It shows path, sensors, wheels and metrics.
    """
    kind = output.suffix.lower()
    if kind not in (".html", ".pdf"):
        raise LogError(f"{output}: expected a name that ends in .html or .pdf")
    _check_outputs(log, output)
    check_new(force, output)
    from khep_twin.lab.report.report import make_report as report_on
    from khep_twin.log.reader import read_series
    from khep_twin.log.shadow_channels import is_shadow
    from khep_twin.log.shadow_track import read_shadow

    recording = read_series(log)
    run_report = report_on(recording, str(log), read_shadow(log) if is_shadow(recording.label) else None)
    if kind == ".html":
        from khep_twin.lab.report.pages import html as pages
    else:
        from khep_twin.lab.report.pdf import pdf as pages
    write_drawing(output, pages(run_report), force)
    typer.echo(f"report  {output}")


def _check_outputs(log: Path, *outputs: Path) -> None:
    """Refuse output files that cannot be written, and the log itself."""
    for path in outputs:
        check_writable(path)
        if is_same(path, log):
            raise LogError(f"{path}: this is the log; expected a separate file")
    if len({resolve(path) for path in outputs}) < len(outputs):
        raise LogError(f"{outputs[0]}: named twice; expected a separate file for each")
