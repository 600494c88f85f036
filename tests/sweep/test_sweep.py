"""Sweeps: each result once, whatever happens; the check worker-kills is harder on Ray's workers."""

import builtins
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest
from forked import Forked
from test_study import STUDY, loaded
from typer.testing import CliRunner

from checks.worker_kills import trial
from khep_twin.cli.app import app
from khep_twin.errors import KhepTwinError, MissingExtraError, StudyError
from khep_twin.process.invocation import command
from khep_twin.sweep import ray_workers
from khep_twin.sweep.shards import Shard, Work, work_of
from khep_twin.sweep.study import COLUMNS
from khep_twin.sweep.sweep import run_locally, run_sweep

pytestmark = pytest.mark.filterwarnings("ignore::khep_twin.episodes.episode.SlowerWarning")

HAS_RAY = importlib.util.find_spec("ray") is not None

EXTRA = """
[grid]
noise = [true, false]

[[network]]
name = "drawn"
drawn = 2

[[program]]
name = "mine"
file = "mine.py:steer"
"""

STEER = """
def steer(proximity, ambient, memory, genes):
    return 5.0, 5.0 - proximity[0] * 0.01
"""


def swept(folder: Path, text: str = STUDY + EXTRA, **options: Any) -> Path:
    (folder / "mine.py").write_text(STEER)
    return run_sweep(loaded(folder, text), **options)


WAITS = """
[[measure]]
name = "waited"
file = "waits.py:waited"
"""


def waiting(folder: Path, n_episodes: int) -> str:
    """Return a measure at which a sweep waits after so many episodes, until there is a file `go`."""
    # The function is read anew for each task, so what it remembers is a file.
    (folder / "waits.py").write_text(
        "import pathlib, time\n\n\n"
        "def waited(numbers, registers, pose):\n"
        f"    folder = pathlib.Path({str(folder)!r})\n"
        "    with (folder / 'measured').open('a') as file:\n"
        "        file.write('.')\n"
        f"    while (folder / 'measured').stat().st_size > {n_episodes} and not (folder / 'go').exists():\n"
        "        time.sleep(0.01)\n"
        "    return 0.0\n"
    )
    return WAITS


class Counted:
    """Threads that note which tasks they do, and stop before one, as if the power had gone."""

    def __init__(self, stop_before: int = -1) -> None:
        self.finished: list[int] = []
        self._stop = stop_before

    @contextmanager
    def __call__(self, work: Work, tasks: Sequence[Shard]) -> Iterator[Iterator[tuple[Shard, bytes]]]:
        def coming() -> Iterator[tuple[Shard, bytes]]:
            with run_locally(1)(work, tasks) as results:
                for task, data in results:
                    if task.index == self._stop:
                        raise KhepTwinError("stopped")
                    self.finished.append(task.index)
                    yield task, data

        yield coming()


def test_every_episode_is_in_the_table_once_with_what_it_was(tmp_path: Path) -> None:
    rows = pq.read_table(swept(tmp_path)).to_pylist()
    assert {*rows[0]} == {*COLUMNS, "obstacle_avoidance", "distance_m"}
    assert [row["episode"] for row in rows] == list(range(24))
    kinds = [(row["controller"], row["noise"], row["genome"], row["seed"]) for row in rows]
    assert kinds == [
        (name, noise, genome, seed)
        for name, genomes in (("braitenberg", 1), ("drawn", 2), ("mine", 1))
        for noise in (True, False)
        for genome in range(genomes)
        for seed in range(3)
    ]
    assert all(row["distance_m"] > 0 and row["failure"] is None for row in rows)
    assert not (tmp_path / "out" / "parts").exists()


def test_a_sweep_ends_with_its_means_and_where_they_are_from(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(STEER)
    (tmp_path / "study.toml").write_text(STUDY + EXTRA)
    ended = CliRunner().invoke(app, ["sweep", str(tmp_path / "study.toml")])
    assert ended.exit_code == 0, ended.output
    _, n_episodes, *means, results = ended.stdout.splitlines()
    assert n_episodes == "24 episodes, 0 failed; means:"
    assert [line.split()[:2] for line in means] == [
        ["default", name] for name in ("braitenberg", "drawn", "mine")
    ]
    table = tmp_path / "out" / "results.parquet"
    assert results.startswith(f"results  {table}      read it: ")
    rows = [row for row in pq.read_table(table).to_pylist() if row["controller"] == "mine"]
    mean = sum(row["distance_m"] for row in rows) / len(rows)
    assert means[2].endswith(f"distance_m {mean:.4g}")


def test_tasks_of_any_size_and_any_number_of_threads_give_the_same_episodes(tmp_path: Path) -> None:
    undisturbed = pq.read_table(swept(tmp_path, executor=run_locally(2)))
    small = STUDY.replace("rollouts_per_task = 4", "rollouts_per_task = 1") + EXTRA
    assert pq.read_table(swept(tmp_path, small, executor=run_locally(1), output=tmp_path / "b")).equals(
        undisturbed
    )


def test_a_sweep_that_stopped_goes_on_with_only_what_is_missing_to_the_same_bytes(tmp_path: Path) -> None:
    expected = swept(tmp_path, output=tmp_path / "whole").read_bytes()
    with pytest.raises(KhepTwinError, match="stopped"):
        swept(tmp_path, executor=Counted(stop_before=3))
    # One part is damaged, as by a disk, and one is of another study.
    parts = tmp_path / "out" / "parts"
    assert sorted(path.name for path in parts.iterdir()) == [f"task-00000{i}.parquet" for i in range(3)]
    (parts / "task-000001.parquet").write_bytes(b"PAR1")
    following = Counted()
    assert swept(tmp_path, executor=following, resume=True).read_bytes() == expected
    assert following.finished == [1, 3, 4, 5, 6, 7]
    again = Counted()
    assert swept(tmp_path, executor=again, resume=True).read_bytes() == expected
    assert again.finished == []


def test_a_killed_sweep_keeps_whole_parts_and_goes_on(tmp_path: Path) -> None:
    text = STUDY.replace("seeds = 3", "seeds = 40") + waiting(tmp_path, n_episodes=18)
    file = loaded(tmp_path, text)
    parts = tmp_path / "out" / "parts"
    words = [sys.executable, "-m", "khep_twin", "sweep", str(tmp_path / "study.toml")]
    with Forked(words, stdout=subprocess.DEVNULL) as sweep:
        start = time.monotonic()
        while len(list(parts.glob("task-*.parquet"))) < 4 and time.monotonic() - start < 300:
            time.sleep(0.01)
        os.kill(sweep.pid, signal.SIGKILL)
    assert sweep.returncode == -signal.SIGKILL
    assert len(list(parts.glob("task-*.parquet"))) == 4
    (tmp_path / "go").touch()
    following = Counted()
    table = run_sweep(file, resume=True, executor=following)
    assert following.finished == list(range(4, 10))
    expected = run_sweep(file, output=tmp_path / "whole")
    assert table.read_bytes() == expected.read_bytes()
    assert pq.read_table(table)["episode"].to_pylist() == list(range(40))


def test_a_folder_with_anything_else_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("dear diary")
    with pytest.raises(StudyError, match=r"mine: holds notes.txt and no study.json; expected a new folder"):
        swept(tmp_path, output=tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]
    swept(tmp_path)
    with pytest.raises(StudyError, match=r"out: holds results of this study already; expected --resume"):
        swept(tmp_path)
    with pytest.raises(StudyError, match=r"out: holds results of another study"):
        swept(tmp_path, STUDY, resume=True)


def test_a_sweep_that_came_to_nothing_is_begun_anew_as_it_is_or_mended(tmp_path: Path) -> None:
    for text in (STUDY, STUDY, STUDY + EXTRA):
        with pytest.raises(KhepTwinError, match="stopped"):
            swept(tmp_path, text, executor=Counted(stop_before=0))
    assert pq.read_table(swept(tmp_path)).num_rows == 24


def test_an_interrupted_sweep_says_how_to_go_on_and_only_what_is_missing_is_done_then(tmp_path: Path) -> None:
    text = STUDY.replace("seeds = 3", "seeds = 40") + waiting(tmp_path, n_episodes=10)
    file = loaded(tmp_path, text)
    output = tmp_path / "another one"
    words = [sys.executable, "-m", "khep_twin", "sweep", str(tmp_path / "study.toml"), "-o", str(output)]
    with Forked(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as sweep:
        start = time.monotonic()
        while len(list(output.glob("parts/task-*.parquet"))) < 2 and time.monotonic() - start < 300:
            time.sleep(0.01)
        sweep.send_signal(signal.SIGINT)
        errors = sweep.communicate()[1]
    assert sweep.returncode == 130, errors
    again = command("sweep", tmp_path / "study.toml", "--resume", "--output", output)
    assert errors.endswith(f"stopped; resume: {again}\n")
    assert len(list(output.glob("parts/task-*.parquet"))) == 2
    (tmp_path / "go").touch()
    following = Counted()
    table = run_sweep(file, output=output, resume=True, executor=following)
    assert following.finished == list(range(2, 10))
    assert pq.read_table(table)["episode"].to_pylist() == list(range(40))


def test_what_is_damaged_is_reported_by_file(tmp_path: Path) -> None:
    text = STUDY.replace("seeds = 3", "seeds = 12")
    with pytest.raises(KhepTwinError, match="stopped"):
        swept(tmp_path, text, executor=Counted(stop_before=2))
    # Its end is whole, but not what comes before.
    part = tmp_path / "out" / "parts" / "task-000001.parquet"
    data = part.read_bytes()
    part.write_bytes(data[:4] + bytes(100) + data[104:])
    with pytest.raises(
        StudyError, match=r"task-000001.parquet: does not hold episodes 4 to 7, each once; delete it"
    ):
        swept(tmp_path, text, resume=True)
    part.unlink()
    table = swept(tmp_path, text, resume=True)
    table.write_bytes(table.read_bytes()[:-100])
    with pytest.raises(StudyError, match=r"results.parquet: damaged; delete it, and use --resume"):
        swept(tmp_path, text, resume=True)
    (tmp_path / "out" / "study.json").write_text("{")
    with pytest.raises(StudyError, match=r"study.json: cannot be read, so the study of these results"):
        swept(tmp_path, text, resume=True)


def test_a_folder_may_have_any_name_but_must_be_one(tmp_path: Path) -> None:
    rows = pq.ParquetFile(swept(tmp_path, STUDY, output=tmp_path / "noise=1, 2 'ä'")).read()
    assert "noise" in rows.column_names
    assert len(rows) == 3
    (tmp_path / "file").write_text("")
    with pytest.raises(StudyError, match=r"file: cannot be created: File exists"):
        swept(tmp_path, STUDY, output=tmp_path / "file")


def test_a_sweep_that_was_killed_at_its_very_beginning_can_be_begun_again(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".study.json.part").write_text("{")
    assert len(pq.read_table(swept(tmp_path, STUDY, resume=True))) == 3
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["results.parquet", "study.json"]


def test_two_sweeps_cannot_write_into_one_folder(tmp_path: Path) -> None:
    @contextmanager
    def meanwhile(work: Work, tasks: Sequence[Shard]) -> Iterator[Iterator[tuple[Shard, bytes]]]:
        with pytest.raises(StudyError, match=r"out: in use by another sweep"):
            swept(tmp_path, STUDY, resume=True)
        with run_locally(1)(work, tasks) as results:
            yield iter(results)

    swept(tmp_path, STUDY, executor=meanwhile)


def test_an_episode_that_fails_is_reported_in_its_row_and_the_others_go_on(tmp_path: Path) -> None:
    (tmp_path / "wild.py").write_text(
        "def steer(proximity, ambient, memory, genes):\n    return genes[0] * 1e308 * 10, 1.0\n"
    )
    (tmp_path / "genes.csv").write_text("0\n1\n")
    text = STUDY + '[[program]]\nname = "wild"\nfile = "wild.py:steer"\ngenomes = "genes.csv"\n'
    rows = pq.read_table(run_sweep(loaded(tmp_path, text))).to_pylist()
    failed = [row for row in rows if row["failure"] is not None]
    assert [(row["controller"], row["genome"], row["seed"]) for row in failed] == [
        ("wild", 1, i) for i in range(3)
    ]
    assert failed[2]["failed_step"] == 0
    assert "seed 2 failed at 0.0000 s" in failed[2]["failure"]
    assert failed[2]["distance_m"] is None


def test_episodes_are_measured_by_functions_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "score.py").write_text(
        "def twice(numbers, registers, pose):\n    return 2 * numbers['forward_m']\n\n\n"
        "def place(numbers, registers, pose):\n    return pose[0] + registers[0]\n\n\n"
        "def none(numbers, registers, pose):\n    return 'much'\n"
    )
    measure = '[[measure]]\nname = "{0}"\nfile = "score.py:{0}"\n'
    text = STUDY + 'fitness = ["forward_m"]\n' + measure.format("twice") + measure.format("place")
    rows = pq.read_table(run_sweep(loaded(tmp_path, text))).to_pylist()
    assert [row["twice"] for row in rows] == [2 * row["forward_m"] for row in rows]
    assert all(row["place"] >= row["end_x_m"] for row in rows)
    with pytest.raises(KhepTwinError, match=r"^score.py:none: ValueError: could not convert string to float"):
        swept(tmp_path, STUDY + measure.format("none"), output=tmp_path / "none")
    with pytest.raises(
        StudyError, match=r"study.toml:11: measure 1: name = \"seed\": taken; expected a unique name"
    ):
        swept(tmp_path, STUDY + measure.format("seed"))
    with pytest.raises(
        StudyError, match=r"study.toml:12: measure 1: file = .*no function 'twise'; did you mean"
    ):
        swept(tmp_path, STUDY + measure.format("twise"))


def test_without_ray_asking_for_it_is_one_line_that_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    original_import = builtins.__import__

    def refuse(name: str, *rest: Any, **options: Any) -> Any:
        if name == "ray":
            raise ImportError(name)
        return original_import(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", refuse)
    before = dict(os.environ)
    with pytest.raises(MissingExtraError, match=r"^ray is not installed; .* -m pip install 'ray<3,>=2.60'$"):
        ray_workers.on_ray()
    assert dict(os.environ) == before


def test_a_cluster_is_given_by_host_and_port() -> None:
    assert ray_workers.host_and_port("10.0.0.1:6379") == ("10.0.0.1", 6379)
    assert ray_workers.host_and_port("[::1]:6379") == ("::1", 6379)
    for wrong in ("10.0.0.1", ":6379", "host:", "host:0", "host:65536", "ray://host:10001"):
        with pytest.raises(ValueError, match=rf"^{wrong}: expected HOST:PORT, such as .*, or auto$"):
            ray_workers.host_and_port(wrong)


def test_ray_here_has_a_token_and_no_dashboard_and_is_refused_where_others_reach_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "__init__.py").write_text("")
    (tmp_path / "ray" / "exceptions.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("ray", "ray.exceptions"):
        # Set first, so that what was there is put back.
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
        del sys.modules[name]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("RAY_")}
    monkeypatch.setattr(os, "environ", environment)
    ray_workers.on_ray()
    assert environment["RAY_AUTH_MODE"] == "token"
    assert len(environment["RAY_AUTH_TOKEN"]) == 64

    class Ray(ModuleType):
        def __init__(self, address: str) -> None:
            super().__init__("ray")
            self.address, self.arguments = address, dict[str, object]()

        def init(self, **arguments: object) -> SimpleNamespace:
            self.arguments = arguments
            return SimpleNamespace(address_info={"node_ip_address": self.address})

    ray = Ray("127.0.0.1")
    ray_workers._connect(ray, None, 1)
    assert ray.arguments["address"] == "local"
    assert ray.arguments["include_dashboard"] is False
    with pytest.raises(KhepTwinError, match=r"listens at 10\.0\.0\.1; expected 127\.0\.0\.1 alone"):
        ray_workers._connect(Ray("10.0.0.1"), None, 1)


def test_a_worker_with_other_versions_does_nothing(tmp_path: Path) -> None:
    work = work_of(loaded(tmp_path, STUDY))
    data, trouble = ray_workers._run_task(replace(work, versions="khep_twin 9.9"), work.tasks[0])
    assert data == b""
    assert re.search(r"a worker has khep_twin .* with mujoco .*; expected khep_twin 9.9, as here", trouble)


@pytest.mark.skipif(not HAS_RAY, reason="ray, the extra [ray], is not installed")
@pytest.mark.long
def test_rays_workers_may_be_killed_and_each_result_is_there_once(tmp_path: Path) -> None:
    # A quick machine may be done before the second one.
    assert trial(tmp_path, tasks=8, kills=2, seconds=40, seed=0) >= 1


def test_each_parameter_of_the_grid_has_a_column_and_gives_the_episodes_of_a_study_with_that_key(
    tmp_path: Path,
) -> None:
    study = (
        STUDY.replace('"default"', '"obstacles"')
        .replace("seeds = 3", "seeds = 1")
        .replace("seconds = 0.2", "")
    )
    grid = "[grid]\nplanar = [false, true]\nline_baud = [0, 9600]\nseconds = [0.2, 0.4]\n"
    grid += "noise = [true, 0.0, 4.0]\n"
    rows = pq.read_table(swept(tmp_path, study + grid, output=tmp_path / "grid")).to_pylist()
    assert len(rows) == 3 * 2 * 2 * 2
    names = "noise", "planar", "line_baud", "seconds"
    assert len({tuple(row[name] for name in names) for row in rows}) == len(rows)
    assert {(row["step_ms"], row["period_ms"], row["vary"], row["lighting"]) for row in rows} == {
        (10.0, 20, False, "all")
    }
    ends = {tuple(row[name] for name in names): row["end_x_m"] for row in rows}
    for other in ((1.0, False, 0, 0.4), (1.0, True, 0, 0.2), (1.0, False, 9600, 0.2), (4.0, False, 0, 0.2)):
        assert ends[other] != ends[1.0, False, 0, 0.2]
    for noise, planar, line_baud, seconds in ((1.0, True, 9600, 0.4), (0.0, False, 0, 0.2)):
        keys = f"planar = {str(planar).lower()}\nline_baud = {line_baud}\nseconds = {seconds}\n"
        single = f"{study}{keys}[grid]\nnoise = [{str(noise > 0).lower()}]\n"
        (row,) = pq.read_table(swept(tmp_path, single, output=tmp_path / f"single {noise}")).to_pylist()
        assert row["end_x_m"] == ends[noise, planar, line_baud, seconds]
        assert row["noise"] is (noise > 0)


def test_results_with_other_columns_are_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as earlier:
        earlier.setattr("khep_twin.sweep.shards.COLUMNS", COLUMNS - {"planar"})
        with pytest.raises(KhepTwinError, match="stopped"):
            swept(tmp_path, executor=Counted(stop_before=3))
    with pytest.raises(
        StudyError, match=r"out: holds results of another study, of another version, or"
    ) as error:
        swept(tmp_path, resume=True)
    assert "\n" not in str(error.value)
