"""Registry of models: packages whose model cannot be loaded."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from khep_twin import playpen as playpens
from khep_twin.errors import RobotModelError
from khep_twin.log.robot_models import models_of
from khep_twin.ports.twin import TwinOptions
from khep_twin.robots import registry

REASON = "robot lost: nowhere.model:LOST cannot be loaded: No module named 'nowhere'"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return the environment of a process in which a package registers a model that does not exist."""
    folder = tmp_path / "lost-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: lost\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[khep_twin.robots]\nlost = nowhere.model:LOST\n")
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}


def test_a_model_that_cannot_be_loaded_is_one_warning_of_a_command_without_it(
    environment: dict[str, str],
) -> None:
    command = [sys.executable, "-m", "khep_twin", "playpen", "check", "obstacles"]
    process = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (process.returncode, process.stderr) == (
        0,
        f"khep-twin: {REASON}; continuing without this model\n",
    )
    assert "obstacles" in process.stdout


def test_a_model_that_cannot_be_loaded_leaves_gymnasium_the_tasks_of_the_others(
    environment: dict[str, str],
) -> None:
    pytest.importorskip("gymnasium")
    program = "import khep_twin, gymnasium; gymnasium.spec('khep_twin/KheperaIVObstacleAvoidance-v0')"
    process = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert process.returncode == 0
    assert REASON in process.stderr


@pytest.fixture
def offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], list[str]]]:
    """Return a function that offers a module as that of the model "lost", and returns the warnings."""

    def offer(source: str) -> list[str]:
        (tmp_path / "lost_robot.py").write_text(source)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "lost_robot", raising=False)
        entry = EntryPoint("lost", "lost_robot:LOST", registry.GROUP)
        monkeypatch.setattr(registry, "entry_points", lambda group: [entry])
        registry.installed_models.cache_clear()
        with pytest.warns(UserWarning, match="robot lost: ") as caught:
            registry.installed_models()
        return [str(warning.message) for warning in caught]

    yield offer
    registry.installed_models.cache_clear()


SHIPPED = "from khep_twin.robots.khepera.model import KHEPERA_1\nfrom dataclasses import replace\n"


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("LOST = (", "cannot be loaded: SyntaxError: '(' was never closed (lost_robot.py, line 1)"),
        ("import nowhere", "cannot be loaded: No module named 'nowhere'"),
        ("LOST = dict(a=1)['b']", "cannot be loaded: KeyError: 'b'"),
        ("LOST = 5", "is 5; expected a RobotModel"),
        (f"{SHIPPED}LOST = KHEPERA_1", "has name = 'khepera1'; expected 'lost', the name of its entry point"),
    ],
)
def test_a_broken_package_is_refused_in_one_line_where_its_model_is_needed(
    source: str, reason: str, offered: Callable[[str], list[str]]
) -> None:
    expected = f"robot lost: lost_robot:LOST {reason}"
    assert offered(source) == [f"{expected}; continuing without this model"]
    assert registry.find_model("khepera1").title == "Khepera"
    text = 'version = 1\nname = "a"\n[arena]\nwidth_mm = 600\nheight_mm = 400\n[[robot]]\nmodel = "lost"\n'
    for use in (
        lambda: registry.find_model("lost"),
        lambda: registry.find_family("lost"),
        lambda: TwinOptions(model="lost"),
        lambda: playpens.parse(f"{text}x_mm = 200\ny_mm = 200\nheading_deg = 0\n", "a"),
        lambda: models_of({"playpen.toml": text}, ["khepera0"]),
    ):
        with pytest.raises(RobotModelError) as caught:
            use()
        assert str(caught.value) == expected


def test_a_name_of_a_shipped_model_is_not_taken_by_another_package(
    offered: Callable[[str], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    offered("LOST = 5")
    entry = EntryPoint("khepera4", "khep_twin.robots.khepera4.model:KHEPERA_4", registry.GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry])
    registry.installed_models.cache_clear()
    with pytest.warns(UserWarning, match="the name is taken by another package"):
        assert registry.find_model("khepera4") is registry.shipped_models()["khepera4"]
