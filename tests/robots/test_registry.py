"""Registry of models: packages whose model cannot be loaded."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REASON = "robot lost: nowhere.model:LOST cannot be loaded: No module named 'nowhere'"


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Return the environment of a process in which a package registers a model that does not exist."""
    folder = tmp_path / "lost-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: lost\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[khep_twin.robots]\nlost = nowhere.model:LOST\n")
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}


def test_a_model_that_cannot_be_loaded_ends_a_command_in_one_line(environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "khep_twin", "playpen", "list"]
    process = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (process.returncode, process.stderr) == (1, f"khep-twin: {REASON}\n")


def test_a_model_that_cannot_be_loaded_leaves_gymnasium_the_tasks_of_the_others(
    environment: dict[str, str],
) -> None:
    pytest.importorskip("gymnasium")
    program = "import khep_twin, gymnasium; gymnasium.spec('khep_twin/KheperaIVObstacleAvoidance-v0')"
    process = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert process.returncode == 0
    assert REASON in process.stderr
