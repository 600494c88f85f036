"""The classic experiments run, shortened."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "examples" / "classics"

SHORTER = {
    "vehicles": "--starts 2 --seconds 0.4",
}
"""Options that make an experiment short; each also draws."""

NEEDS_CMAES = {"phototaxis"}


@pytest.mark.parametrize("name", SHORTER)
def test_a_classic_experiment_runs_and_draws(name: str, tmp_path: Path) -> None:
    if name in NEEDS_CMAES and importlib.util.find_spec("cmaes") is None:
        pytest.skip("cmaes is not installed")
    subprocess.run(
        [sys.executable, str(FOLDER / f"{name}.py"), *SHORTER[name].split(), "--picture", "classic.png"],
        check=True,
        timeout=600,
        cwd=tmp_path,
    )
    assert list(tmp_path.glob("classic*.png"))
