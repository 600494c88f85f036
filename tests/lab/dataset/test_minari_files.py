"""Datasets of Minari: `minari.load_dataset` returns them as written, completely or not at all."""

import builtins
import importlib
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import good, refusal

from khep_twin.envs.tasks import find_task
from khep_twin.errors import MissingExtraError
from khep_twin.lab.dataset.episodes import episodes_of
from khep_twin.ports.twin import TwinOptions, open_twin

MS = 1_000_000
DATASET = "khepera/avoid-v0"
PAGE = Path(__file__).parents[3] / "docs/datasets.md"


@pytest.fixture
def minari(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Minari with its datasets in `tmp_path`."""
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    pytest.importorskip("h5py", reason="h5py, of the extra [minari], is not installed")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return pytest.importorskip("minari", reason="minari, the extra [minari], is not installed")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a second of one robot, whose host sends speeds every 50 ms."""
    path = tmp_path_factory.mktemp("minari") / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        for number in range(20):
            twin.robot.send(f"D,{number - 10},5\n".encode())
            twin.advance_to((number + 1) * 50 * MS)
    return path


export, refused = partial(good, "export"), partial(refusal, "export")


def minari_options(folder: Path, *options: object) -> list[object]:
    return ["--minari", DATASET, "--task", "ObstacleAvoidance", "-o", folder, *options]


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_dataset_comes_back_through_minari(minari: Any, log: Path, tmp_path: Path) -> None:
    output = export(log, log, *minari_options(tmp_path))
    assert output == f"dataset     {tmp_path / DATASET}: 2 episodes, 40 steps, 2.0 of the logs' 2.0 s\n"
    dataset = minari.load_dataset(DATASET)
    (episode,) = episodes_of(log, find_task("ObstacleAvoidance"), 50 * MS)
    assert (dataset.total_episodes, dataset.total_steps) == (2, 40)
    for loaded in dataset:
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            expected = getattr(episode, name)
            assert getattr(loaded, name).dtype == expected.dtype
            assert np.array_equal(getattr(loaded, name), expected)
        assert {name: values.tolist() for name, values in loaded.infos.items()} == {
            name: values.tolist() for name, values in episode.infos.items()
        }
    (source, _) = dataset.storage.get_episode_metadata([0, 1])
    assert (source["log"], source["robot"]) == ("run.mcap", "khepera0")
    assert list(minari.list_local_datasets()) == [DATASET]


def test_a_dataset_names_the_environment_of_its_task_and_period(
    minari: Any, log: Path, tmp_path: Path
) -> None:
    import gymnasium

    export(log, *minari_options(tmp_path, "--period", "100"))
    dataset = minari.load_dataset(DATASET)
    environment = dataset.recover_environment(compiled=False)
    assert environment.spec.kwargs["period_ns"] == 100 * MS
    assert gymnasium.spec(environment.spec.id).kwargs == {"task": "ObstacleAvoidance"}
    assert environment.observation_space == dataset.observation_space
    assert environment.action_space == dataset.action_space


def test_the_same_logs_give_the_same_bytes(minari: Any, log: Path, tmp_path: Path) -> None:
    for name in ("one", "other"):
        export(log, *minari_options(tmp_path / name))
    assert content(tmp_path / "one") == content(tmp_path / "other")


def test_a_dataset_is_replaced_by_force_alone_and_stays_if_that_fails(
    minari: Any, log: Path, tmp_path: Path
) -> None:
    export(log, *minari_options(tmp_path))
    before = content(tmp_path)
    assert refused(log, *minari_options(tmp_path)) == (
        f"{tmp_path / DATASET}: is there already; expected another id, or --force to replace it"
    )
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(log.read_bytes()[:-1000])
    assert "torn.mcap: no whole log" in refused(log, torn, *minari_options(tmp_path, "--force"))
    torn.unlink()
    assert content(tmp_path) == before
    export(log, log, *minari_options(tmp_path, "--force"))
    assert minari.load_dataset(DATASET).total_episodes == 2
    (tmp_path / "mine" / "data-v0").mkdir(parents=True)
    assert "data-v0: is there already, no dataset; expected another id" in refused(
        log, "--minari", "mine/data-v0", "--task", "Homing", "-o", tmp_path, "--force"
    )


def test_what_cannot_be_written_leaves_nothing(minari: Any, log: Path, tmp_path: Path) -> None:
    folder = tmp_path / "new"
    missing = log.with_name("missing.mcap")
    assert "missing.mcap: cannot be read" in refused(log, missing, *minari_options(folder))
    assert "the goal of Homing" in refused(log, "--minari", DATASET, "--task", "Homing", "-o", folder)
    assert "task 'Homeing': unknown; did you mean 'Homing'?" in refused(
        log, "--minari", DATASET, "--task", "Homeing", "-o", folder
    )
    assert "dataset '../avoid': expected an id such as khepera/avoid-v0" in refused(
        log, "--minari", "../avoid", "--task", "Homing", "-o", folder
    )
    assert "--period nan: expected a time in ms" in refused(log, *minari_options(folder, "--period", "nan"))
    file = tmp_path / "file"
    file.touch()
    assert "cannot be written: Not a directory" in refused(log, *minari_options(file))
    assert sorted(tmp_path.iterdir()) == [file]


def test_options_of_tables_and_datasets_do_not_mix(log: Path, tmp_path: Path) -> None:
    assert (
        refused(log, "--task", "Homing", "-o", tmp_path) == "--task Homing: expected it with --minari alone"
    )
    assert refused(log, log, "-o", tmp_path / "run.csv").startswith("2 logs; expected one for a table")
    assert "expected -o FOLDER and --task NAME with it" in refused(log, "--minari", DATASET)
    assert "expected a dataset alone" in refused(log, *minari_options(tmp_path, "--channels", "pose"))


def test_without_its_packages_the_extra_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    real = builtins.__import__

    def hidden(name: str, *args: Any) -> Any:
        if name.split(".")[0] in ("h5py", "minari"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *args)

    monkeypatch.delitem(sys.modules, "khep_twin.lab.dataset.minari_files", raising=False)
    monkeypatch.setattr(builtins, "__import__", hidden)
    with pytest.raises(MissingExtraError, match=r"^h5py is not installed; to install it: .* pip install"):
        importlib.import_module("khep_twin.lab.dataset.minari_files")


PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


# Minari recommends an author and more.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_the_programs_of_the_page_of_datasets_run(
    number: int, minari: Any, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "DataCollector" in PROGRAMS[number]:
        pytest.importorskip("jax", reason="jax, which minari.DataCollector needs, is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out" / "datasets"))
    export(log, *minari_options(Path("out/datasets")))
    Path("out/first.mcap").write_bytes(log.read_bytes())
    exec(compile(PROGRAMS[number], str(PAGE), "exec"), {})
