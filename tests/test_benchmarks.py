"""The benchmarks run and save their records; no test asserts a speed."""

import importlib
import importlib.util
import itertools
import math
import platform
import sys
from pathlib import Path

import pytest

import benchmarks
from benchmarks import archive, growth, peers, record
from benchmarks.ports import line_row, trip_rows
from benchmarks.scale import bare_row, episode_row, world_row
from benchmarks.swarm import swarm_rows
from benchmarks.table import COST, Row, RunTimes, Table, measure, text, timed
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen

FOLDER = Path(benchmarks.__file__).parent


def steady(name: str, work: float, wall: float, cpu: float = math.nan) -> Row:
    return Row(name, work, lambda: RunTimes(wall, cpu), lambda rate: f"{rate:g} per s")


def trivial() -> Table:
    rows = [steady("floor", 10, 1, 0.5), steady("half as fast", 5, 1, 1), steady("elsewhere", 10, 0.5)]
    return measure("scene", rows, 3, remarks=["a remark"])


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_benchmark_can_be_imported(path: Path) -> None:
    importlib.import_module(f"benchmarks.{path.stem}")


def test_ratios_are_speeds_beside_the_first_row() -> None:
    floor, half, elsewhere = trivial().results
    assert (floor.median, floor.best, floor.cpu, floor.ratio, floor.cpu_ratio) == (10, 10, 20, 1, 1)
    assert (half.median, half.cpu, half.ratio, half.cpu_ratio) == (5, 5, 0.5, 0.25)
    assert (elsewhere.ratio, elsewhere.note) == (2, "20 per s")
    assert math.isnan(elsewhere.cpu)
    assert math.isnan(elsewhere.cpu_ratio)


def test_costs_are_times_beside_the_first_row() -> None:
    _, dear = measure("size", [steady("1", 10, 1, 1), steady("2", 10, 4, 3)], 3, unit=COST, cost=True).results
    assert (dear.median, dear.cpu, dear.ratio, dear.cpu_ratio) == (400, 300, 4, 3)


def test_a_ratio_is_of_the_same_round() -> None:
    # Whatever makes a round slow makes all of it slow.
    walls = [iter([9.0, *slow]) for slow in ([1, 5, 20], [2, 10, 40])]
    rows = [
        Row("floor", 1, lambda: RunTimes(next(walls[0]))),
        Row("half as fast", 1, lambda: RunTimes(next(walls[1]))),
    ]
    _, half = measure("scene", rows, 3).results
    assert (half.ratio, half.median, half.best) == (0.5, 0.1, 0.5)


def test_rows_take_turns_and_the_first_round_does_not_count() -> None:
    lines: list[str] = []
    times = itertools.chain([100.0, 100.0], itertools.repeat(1.0))

    def run(name: str) -> RunTimes:
        lines.append(name)
        return RunTimes(next(times))

    table = measure("scene", [Row(name, 1, lambda name=name: run(name)) for name in "ab"], 2)
    assert lines == ["a", "b"] * 3
    assert [row.best for row in table.results] == [row.median for row in table.results] == [1, 1]


def test_the_printed_table_is_aligned_and_fits_a_screen() -> None:
    title, head, *rows, remark = text([trivial()]).splitlines()
    assert title == "scene [simulated s per s]"
    assert remark.strip() == "a remark"
    ends = {
        line.index(word) + len(word)
        for line, word in zip([head, *rows], ["median", "10.0", "5.00", "20.0"], strict=True)
    }
    assert len(ends) == 1
    assert all(len(line) <= 100 for line in [title, head, *rows])


def test_results_survive_their_file_and_tell_nothing_of_where_they_were_made(tmp_path: Path) -> None:
    saved = record.Record(
        "2001-02-03", record.load(), record.machine(), record.versions({"peer": "1"}), (trivial(),)
    )
    path = record.save(saved, tmp_path)
    assert path.name.startswith("2001-02-03-")
    loaded = record.read(path)
    assert repr(loaded) == repr(saved)
    assert text(loaded.tables) == text(saved.tables)
    written = path.read_text()
    assert not [word for word in (platform.node(), str(Path.home())) if len(word) > 1 and word in written]


def test_the_results_that_are_kept_can_be_read() -> None:
    paths = sorted(record.FOLDER.rglob("*.toml"))
    assert paths
    for path in paths:
        loaded = record.read(path)
        assert loaded.name == path.name
        assert text(loaded.tables)


def test_what_is_no_record_is_an_error_of_one_line(tmp_path: Path) -> None:
    for text_of_it in ("date = ", 'date = "today"', "\n".join(["[[table]]", 'title = "a"', "load = []"])):
        (tmp_path / "other.toml").write_text(text_of_it)
        with pytest.raises(KhepTwinError, match="expected a file of --save"):
            record.read(tmp_path / "other.toml")
    with pytest.raises(KhepTwinError, match="cannot be read"):
        record.read(tmp_path / "none.toml")


def test_fields_grow_around_the_same_blocks() -> None:
    small, large = growth.field(20), growth.field(100)
    assert (len(small.blocks), len(large.blocks)) == (20, 100)
    assert large.blocks[:20] == small.blocks
    assert len(growth.field(20, 8).robots) == 8
    with pytest.raises(ValueError, match="expected 4 in all"):
        growth.field(4, 1, cells=2)


def test_rows_run_what_they_name() -> None:
    scene = Playpen.load("default")
    setup = EpisodeSetup(scene)
    rows = [
        episode_row("plain", setup, 0.1, compiled=False),
        world_row("world", scene, 0.1),
        line_row("line", "default", 0.1),
    ]
    if importlib.util.find_spec("numba"):
        rows.append(bare_row("bare", setup, 0.1))
    results = measure("all", rows, 1).results
    assert all(row.median > 0 and row.cpu > 0 and row.ratio > 0 for row in results)
    assert timed(lambda: None)().wall >= 0


def test_round_trips_go_over_two_pseudo_terminals() -> None:
    with trip_rows(5) as rows:
        floor, twin = measure("B", rows, 1).results
    assert floor.median > 0
    assert twin.note.startswith("p50 ")


@pytest.mark.long
def test_many_lines_are_polled_and_their_delays_measured() -> None:
    with swarm_rows("default", 0.3) as rows:
        table = measure("default", rows, 1, unit="s of each line per s")
    assert [row.name for row in table.results] == [
        "bare paced echoes (floor)",
        "default served",
        "default served, logged",
    ]
    for row in table.results:
        assert row.median > 0
        assert "ms p99" in row.note


def test_an_archive_is_a_row_of_cost_coverage_and_score() -> None:
    row = archive.Archive("Kheperax", 1, 3.0, [1.0, 0.5] * 25, compiling=10.0).row(6000)
    assert row.split() == "Kheperax 1 3 s 0.50 ms 10 s 2.0 % 38".split()


@pytest.mark.skipif(importlib.util.find_spec("jax") is not None, reason="jax is installed")
def test_an_archive_in_kheperax_without_kheperax_is_one_line() -> None:
    with pytest.raises(KhepTwinError, match=r"^Kheperax failed: .*No module named 'jax'$"):
        archive.run_kheperax(sys.executable, 0, 1, 1, 0.2)


def test_kheperax_gets_every_wall_of_a_playpen() -> None:
    maze = Playpen.load("looping-maze")
    peer_scene = peers.scene(maze)
    assert len(peer_scene["walls_mm"]) == len(maze.arena.outline_mm) + len(maze.walls[0].points_mm)
    assert peer_scene["walls_mm"][-1] == (*maze.walls[0].points_mm[-1], *maze.walls[0].points_mm[0])
    assert peers.scene(Playpen.load("default"))["walls_mm"] == []


def test_kheperax_gets_the_sides_of_all_that_stands_around() -> None:
    blocks = growth.twenty_blocks()
    walls_mm = peers.scene(blocks)["walls_mm"]
    assert len(walls_mm) == 4 * len(blocks.blocks)
    for block, first in zip(blocks.blocks, walls_mm[::4], strict=True):
        assert math.dist(first[:2], first[2:]) == pytest.approx(block.length_mm)
    round_one = Playpen.load("obstacles")
    sides = peers.corners(round_one.cylinders[0].footprint)
    place, radius = round_one.cylinders[0], round_one.cylinders[0].radius_mm
    assert len(sides) == peers.N_SIDES
    assert [math.dist(corner, (place.x_mm, place.y_mm)) for corner in sides] == pytest.approx([radius] * 12)


def test_a_python_without_kheperax_is_an_error_of_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(peers.VARIABLE, raising=False)
    if importlib.util.find_spec("kheperax"):
        pytest.skip("Kheperax is installed here")
    assert peers.kheperax_python(None) is None
    with pytest.raises(KhepTwinError, match="expected one that can import it"):
        peers.kheperax_python(sys.executable)
    with pytest.raises(KhepTwinError, match="no Python with Kheperax"):
        peers.kheperax_python("/nowhere/python")
    with pytest.raises(KhepTwinError, match="Kheperax failed: ModuleNotFoundError"):
        peers.Kheperax(sys.executable, Playpen.load("default"))
