"""The examples run as they stand."""

import importlib.util
import runpy
import sys
from pathlib import Path

import pytest
from forked import run_python

from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.recorded import read_recorded_run

# The ten ways to begin of 00 are run by test_front_door.
EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("0[1-9]*.py"))

NEEDS = {"03_learn_to_avoid": "stable_baselines3", "04_evolve": "cmaes", "05_map_elites": "ribs"}
"""Packages that an example alone needs."""

SHORTER = {
    "03_learn_to_avoid": "ppo.png --seconds 2".split(),
    "04_evolve": "--generations 2 --population 4 --seconds 0.4 --check-seconds 1".split(),
    "05_map_elites": "--iterations 2 --batch 8 --seconds 1 --judge 2 --picture archive.png".split(),
}
"""What makes a long one short."""


ENDS = {
    "02_pick_and_carry": "carried 96 mm back and put down\nto watch it: python",
    "07_baton": "mm; the porter says 'lifted'\nporter: lifted it ",
    "08_landmark": "before the striped mast after ",
}
"""What an example says at its end."""


def ended(example: Path, folder: Path, *words: str) -> str:
    """Return the output of an example that runs to its end."""
    process = run_python([sys.executable, example, *words], cwd=folder, timeout=600)
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.mark.parametrize(
    "example",
    [
        example for example in EXAMPLES if example.stem not in ("06_aggregation", "07_baton")
    ],  # which run below
    ids=lambda path: path.stem,
)
def test_an_example_runs_on_a_twin_in_its_own_process(example: Path, tmp_path: Path) -> None:
    package = NEEDS.get(example.stem)
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    options = SHORTER.get(example.stem, [])
    assert ENDS.get(example.stem, "") in ended(example, tmp_path, *options)


def test_an_archive_of_the_same_seed_has_the_same_bits(tmp_path: Path) -> None:
    if importlib.util.find_spec("ribs") is None:
        pytest.skip("ribs is not installed")
    [example] = [path for path in EXAMPLES if path.stem == "05_map_elites"]
    for name in "ab":
        words = f"--iterations 2 --batch 8 --seconds 1 --judge 0 --elites {name}.npz".split()
        ended(example, tmp_path, *words)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.long
def test_the_baton_is_passed_and_the_run_repeats(tmp_path: Path) -> None:
    [example] = [path for path in EXAMPLES if path.stem == "07_baton"]
    assert ENDS["07_baton"] in ended(example, tmp_path, "a.mcap")
    assert repeat(read_recorded_run(tmp_path / "a.mcap")) is None


@pytest.mark.long
def test_a_swarm_of_the_same_seed_gathers_in_the_same_way(tmp_path: Path) -> None:
    [example] = [path for path in EXAMPLES if path.stem == "06_aggregation"]
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        ended(example, tmp_path, *f"--seconds 2 --robots 3 --seed {seed} --picture {name}.png".split())
    same, again, other = ((tmp_path / f"{name}.png").read_bytes() for name in "abc")
    assert same == again
    assert same != other


@pytest.mark.parametrize("name", NEEDS)
def test_an_example_without_its_package_is_one_line_with_the_command_that_installs_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    [example] = [path for path in EXAMPLES if path.stem == name]
    monkeypatch.setitem(sys.modules, NEEDS[name], None)
    package = NEEDS[name].replace("_", "-")
    with pytest.raises(SystemExit, match=rf"is not installed; .* -m pip install .*{package}$"):
        runpy.run_path(str(example))
