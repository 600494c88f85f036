"""`make bench`: one table of all benchmarks, each row beside a floor measured in the same rounds.

The floors are a loop around mj_step alone, called from Python, in the same model with its rangefinders, and
a process that only echoes. `python -m benchmarks --help` lists the options; `benchmarks.scale`,
`benchmarks.ports` and `benchmarks.growth` have more detailed tables.
"""

import argparse
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import environments, growth, khepera4, peers, record, ros
from benchmarks.ports import line_row, trip_rows
from benchmarks.scale import NETWORK, POLICY, bare_row, batch_row, episode_row, world_row
from benchmarks.table import LEGEND, Table, measure, text
from khep_twin import units
from khep_twin.cli.compile import compile_all
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen

PLAYPEN = "obstacles"
PEERS = (growth.TWENTY_BLOCKS, "default", "looping-maze")
"""Playpens that are also measured with Kheperax."""


def main_job(part: float, rounds: int) -> Table:
    """Measure the bare loop, the complete twin with its line and log, and episodes without a line."""
    seconds, n_episodes = max(round(60 * part), 1), 32 if part >= 1 else 8
    setup = EpisodeSetup(Playpen.load(PLAYPEN))
    with TemporaryDirectory() as folder:
        rows = [
            bare_row("bare mj_step, rangefinders (floor)", setup, seconds),
            bare_row("bare mj_step, no sensors", setup, seconds, sensors=False),
            world_row("World, no line", Playpen.load(PLAYPEN), seconds),
            line_row("main job over khep://, no log", PLAYPEN, seconds),
            line_row("main job over khep://, logged", PLAYPEN, seconds, Path(folder) / "run.mcap"),
            world_row("World, plain", Playpen.load(PLAYPEN), seconds, compiled=False),
            line_row(
                "main job, logged, plain", PLAYPEN, seconds, Path(folder) / "plain.mcap", compiled=False
            ),
            episode_row("life, plain", setup, seconds, compiled=False),
            episode_row("life, compiled", setup, seconds),
            batch_row("batch, 1 thread", setup, n_episodes, 4 * part, 1),
            batch_row("batch, 2 threads", setup, n_episodes, 4 * part, 2),
            batch_row("batch, networks, 1 thread", setup, n_episodes, 4 * part, 1, NETWORK),
            batch_row(
                "batch, networks, 38400 baud, 1 thread", setup, n_episodes, 4 * part, 1, NETWORK, 38400
            ),
            batch_row("batch, Python policy, 1 thread", setup, n_episodes, 4 * part, 1, POLICY),
            batch_row("batch, Python policy, 2 threads", setup, n_episodes, 4 * part, 2, POLICY),
        ]
        return measure(f"{PLAYPEN}, steps of 2.5 ms", rows, rounds)


def kheperax_table(
    name: str, part: float, rounds: int, python: str | None, versions: dict[str, str]
) -> Table:
    """Measure episodes in MuJoCo and in a plane, and Kheperax in the same playpen.

    Args:
        name: Name of the playpen, or of its obstacles.
        part: Fraction of the usual length.
        rounds: Number of counted rounds.
        python: Python with Kheperax; None if there is none.
        versions: Filled with the versions of Kheperax.
    """
    scene = growth.twenty_blocks() if name == growth.TWENTY_BLOCKS else Playpen.load(name)
    seconds, n_episodes = max(round(20 * part), 1), 32 if part >= 1 else 8
    fine, coarse = EpisodeSetup(scene), EpisodeSetup(scene, step_ns=4 * units.STEP_NS)
    plane, long_s = EpisodeSetup(scene, planar=True), 60 * part
    at_line = EpisodeSetup(scene, planar=True, at_line=True)
    rows = [
        bare_row("bare mj_step, rangefinders (floor)", fine, seconds),
        episode_row("life, steps of 2.5 ms", fine, seconds),
        episode_row("life, steps of 10 ms", coarse, seconds),
        batch_row("batch, 2 threads, 2.5 ms", fine, n_episodes, 4 * part, 2),
        batch_row("batch, 2 threads, 10 ms", coarse, n_episodes, 4 * part, 2),
        batch_row("plane, ROM's vehicle, 1 thread", plane, n_episodes, long_s, 1),
        batch_row("plane, ROM's vehicle, 2 threads", plane, n_episodes, long_s, 2),
        batch_row("plane, networks, 1 thread", plane, n_episodes, long_s, 1, NETWORK),
        batch_row("plane, networks, 2 threads", plane, n_episodes, long_s, 2, NETWORK),
        batch_row("plane, networks, 38400 baud", at_line, n_episodes, long_s, 1, NETWORK, 38400),
    ]
    with ExitStack() as stack:
        if python is not None:
            kheperax = stack.enter_context(peers.Kheperax(python, scene))
            versions |= kheperax.versions
            rows += [
                kheperax.row("Kheperax, 1 robot, 20 ms", 1, 400 * part),
                kheperax.row("Kheperax, 1024 robots, 20 ms", 1024, 4 * part),
            ]
        remarks = [] if python else [peers.ABSENT]
        return measure(f"{name}, beside Kheperax", rows, rounds, remarks=remarks)


def trip_table(part: float, rounds: int) -> Table:
    """Measure round trips over pseudo-terminals."""
    with trip_rows(round(1000 * part)) as rows:
        return measure("B over a pty", rows, rounds, unit="round trips per s")


def tables(quick: bool, python: str | None, versions: dict[str, str]) -> Iterator[Table]:
    """Yield all parts of the table, each as soon as it is measured.

    Args:
        quick: Whether to run shorter, and without the largest.
        python: Python with Kheperax; None if there is none.
        versions: Filled with the versions of Kheperax.
    """
    part, rounds = (0.25, 2) if quick else (1.0, 7)
    yield main_job(part, rounds)
    yield trip_table(part, rounds)
    yield ros.table(round(60 * part), rounds)
    if sys.platform == "linux" and shutil.which("cc"):
        with TemporaryDirectory() as folder:
            yield khepera4.table(Path(folder), part, rounds)
    for name in PEERS[: 1 if quick else None]:
        yield kheperax_table(name, part, rounds, python, versions)
    yield from environments.tables(part, rounds)
    yield from growth.tables(part, 1 if quick else 3, 2 if quick else None)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure the twin's speed.")
    parser.add_argument("--quick", action="store_true", help="run half a minute, for rough numbers")
    parser.add_argument("--kheperax", metavar="PYTHON", help=f"Python with Kheperax; or {peers.VARIABLE}")
    parser.add_argument(
        "--save",
        nargs="?",
        const=record.FOLDER,
        type=Path,
        metavar="FOLDER",
        help="save the results to a file; without FOLDER in benchmarks/results",
    )
    parser.add_argument("--show", type=Path, metavar="FILE", help="print saved results, measure nothing")
    options = parser.parse_args()
    if options.show is not None:
        try:
            saved = record.read(options.show)
        except KhepTwinError as error:
            parser.error(str(error))
        print(f"{text(saved.tables)}\n\n{LEGEND}\n{record.head(saved)}")
        return
    try:
        python = peers.kheperax_python(options.kheperax)
        if options.save is not None and not options.save.is_dir():
            raise KhepTwinError(f"{options.save}: no directory; expected an existing one")
    except KhepTwinError as error:
        parser.error(str(error))
    with suppress(KhepTwinError):  # nothing is compiled here, which the rows show
        compile_all()  # otherwise it would slow down the first rows
    load, start_s, versions = record.load(), time.monotonic(), dict[str, str]()
    measured: list[Table] = []
    for table in tables(options.quick, python, versions):
        print(text([table]), end="\n\n", flush=True)
        measured.append(table)
    run_record = record.Record(
        date.today().isoformat(), load, record.machine(), record.versions(versions), tuple(measured)
    )
    print(f"{LEGEND}\n{record.head(run_record)}\n{time.monotonic() - start_s:.0f} s")
    if options.save is not None:
        print(f"saved {record.save(run_record, options.save).name}")


if __name__ == "__main__":
    sys.exit(main())
