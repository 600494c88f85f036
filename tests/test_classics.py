"""The classic experiments run, shortened."""

import importlib.util
import sys
from pathlib import Path

import pytest
from forked import run_python

FOLDER = Path(__file__).parents[1] / "examples" / "classics"

SHORTER = {
    "garbage": "--trials 1 --seconds 3",
    "garbage_evolved": "--generations 2 --population 4 --episodes 1 --seconds 1 --check-starts 1",
    "homing": "--generations 2 --population 4 --check-lives 1",
    "phototaxis": "--generations 2 --population 4 --episodes 1 --seconds 0.4 --check-starts 1",
    "vehicles": "--starts 2 --seconds 0.4",
    "wall_or_cylinder": "--generations 2 --population 4 --episodes 1 --seconds 1 --check-starts 1",
}
"""Options that make an experiment short; each also draws."""

NEEDS_CMAES = {"garbage_evolved", "phototaxis", "wall_or_cylinder"}


LONG = {"garbage", "garbage_evolved", "homing", "phototaxis", "wall_or_cylinder"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in SHORTER]
)
def test_a_classic_experiment_runs_and_draws(name: str, tmp_path: Path) -> None:
    if name in NEEDS_CMAES and importlib.util.find_spec("cmaes") is None:
        pytest.skip("cmaes is not installed")
    words = [FOLDER / f"{name}.py", *SHORTER[name].split(), "--picture", "classic.png"]
    process = run_python([sys.executable, *words], cwd=tmp_path, timeout=600)
    assert process.returncode == 0, process.stderr
    assert list(tmp_path.glob("classic*.png"))
