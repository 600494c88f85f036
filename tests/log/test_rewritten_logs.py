"""Logs rewritten by other tools: all forms that MCAP allows are read, with the same results."""

from pathlib import Path

import pytest
import scenes
from command_line import good, khep_twin
from log_rewriting import BARE, REWRITINGS, rewritten

from khep_twin import playpen
from khep_twin.envs.tasks import find_task
from khep_twin.errors import LogError
from khep_twin.host import Khepera
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.lab.dataset.episodes import episodes_of
from khep_twin.lab.experiment.multi_robot import run_together
from khep_twin.log.reader import (
    read_arrays,
    read_batches,
    read_end_ns,
    read_first_messages,
    read_label,
    read_log,
    read_raw,
    read_since,
)
from khep_twin.log.recorded import order_events, read_recorded_run
from khep_twin.log.viewer.replay import _check_and_copy
from khep_twin.ports.resume import run_end_ns
from khep_twin.ports.twin import TwinOptions

SECOND = 1_000_000_000
ARENA = scenes.arena() + scenes.robot(150, 250) + scenes.robot(450, 250, 180)


def _drive(robot: Khepera) -> None:
    for turn in range(5):
        robot.set_speed(3 + turn % 3, 5)
        robot.proximity()
        robot.sleep(0.09)


def _meddle(robot: Khepera) -> None:
    _drive(robot)
    world = robot.port.twin.world
    place_robot(world, 0, 200, 300, 45)
    scan(world)
    _drive(robot)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two robots with a host each, one of which also moves the other one by hand."""
    path = tmp_path_factory.mktemp("original") / "run.mcap"
    run_together(playpen.parse(ARENA, "p.toml"), [_drive, _meddle], TwinOptions(seed=5, log=str(path)))
    return path


@pytest.fixture(scope="module")
def expected(original: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    return everything(original, tmp_path_factory.mktemp("wanted"))


@pytest.mark.long
@pytest.mark.parametrize("how", REWRITINGS)
def test_each_command_gives_the_same_of_a_rewritten_log(
    how: str, original: Path, expected: dict[str, object], tmp_path: Path
) -> None:
    log = rewritten(original, tmp_path / "rewritten.mcap", **REWRITINGS[how])
    contents = everything(log, tmp_path / "found")
    assert [name for name in expected if contents[name] != expected[name]] == []


@pytest.mark.share(8)
@pytest.mark.parametrize("how", REWRITINGS)
def test_a_rewritten_log_is_read_as_the_original(how: str, original: Path, tmp_path: Path) -> None:
    log = rewritten(original, tmp_path / "run.mcap", **REWRITINGS[how])
    assert read(log) == read(original)


def test_a_log_without_chunks_or_summary_is_exported_and_repeated(original: Path, tmp_path: Path) -> None:
    log = rewritten(original, tmp_path / "bare.mcap", **REWRITINGS["no chunks and no summary"])
    good("export", original, "-o", tmp_path / "wanted.csv")
    good("export", log, "-o", tmp_path / "found.csv")
    assert (tmp_path / "found.csv").read_bytes() == (tmp_path / "wanted.csv").read_bytes()
    assert good("repeat", log).startswith("identical: ")


def test_what_is_missing_is_said(original: Path, tmp_path: Path) -> None:
    log = rewritten(original, tmp_path / "x.mcap", metadata=lambda name: name != "run", **BARE)
    with pytest.raises(LogError, match="no log of khep_twin: it has no metadata record run that names"):
        read_label(log)


def read(path: Path) -> dict[str, object]:
    """Return a log as each function reads it that the commands call."""
    recorded, resumed = read_recorded_run(path), read_since(path, "/snapshot", SECOND)
    heads, run = read_first_messages(path).series, read_log(path)
    return {
        "label": read_label(path),
        "tracks": {name: repr(track) for name, track in run.robots.items()},
        "events": run.events,
        "heads": {topic: (track.times_ns.tolist(), track.values.tolist()) for topic, track in heads.items()},
        "pieces": [repr(sorted(batch.series.items())) for batch in read_batches(path)],
        "arrays": repr(sorted(read_arrays(path)[1].items())),
        "recorded": (recorded.events, recorded.states, recorded.lines, recorded.last_ns),
        "resumed": [*order_events(path, resumed, recorded.label.robots)],
        "end": (read_end_ns(path), run_end_ns(path)),
        "messages": messages(path),
    }


def everything(path: Path, folder: Path) -> dict[str, object]:
    """Return the result of each command for a log."""
    folder.mkdir(exist_ok=True)
    log = folder / "run.mcap"
    log.write_bytes(path.read_bytes())
    (folder / "p.toml").write_text(ARENA)
    contents: dict[str, object] = {}
    contents["export"] = good("export", log.name, "-o", "t.csv", "--transcript", "lines.csv", folder=folder)
    good("export", log.name, "-o", "t.mat", folder=folder)
    good("playpen", "draw", "p.toml", "--log", log.name, "-o", "map.svg", folder=folder)
    good("report", log.name, "-o", "page.html", folder=folder)
    contents["repeat"] = good("repeat", log.name, folder=folder)
    contents["conform"] = khep_twin("conform", log.name, folder=folder).stdout
    good("branch", log.name, "--at", "1.1", "-o", "branch.mcap", folder=folder)
    contents["branch"] = messages(folder / "branch.mcap")
    contents["view"] = _check_and_copy(log, folder / "copy.mcap", None)
    contents["viewed"] = messages(folder / "copy.mcap")
    contents["recover"] = good("recover", log.name, folder=folder).partition(": ")[2]
    contents["recovered"] = messages(folder / "run.recovered.mcap")
    episodes = episodes_of(log, find_task("ObstacleAvoidance"), 50_000_000)
    contents["dataset"] = [(episode.observations.tolist(), episode.rewards.tolist()) for episode in episodes]
    contents["end"] = read_end_ns(log)
    files = ("t.csv", "lines.csv", "t.mat", "map.svg", "page.html")
    return contents | {name: (folder / name).read_bytes() for name in files}


def messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return all messages of a log by topic, in order of time."""
    _, messages, _ = read_raw(path, lambda _: True)
    return {topic: sorted(rows) for topic, rows in sorted(messages.items())}
