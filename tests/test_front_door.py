"""The front door: the names that `khep_twin` and its packages give, and ten programs as users guess them."""

import runpy
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

import khep_twin

PACKAGE = Path(khep_twin.__file__).parent

NAMES = {
    *("Playpen", "Lamp", "World", "Start", "Sensor"),
    *("Khepera", "Khepera3", "Khepera4", "Gripper", "Radio", "Vision"),
    *("Controller", "NetworkController", "TaskController"),
    *("Twin", "TwinOptions", "open_twin", "serve", "Shadow"),
    *("rollout", "RolloutResult", "Episode", "EpisodeOptions", "EpisodeSetup", "MeasuredCycle"),
    *("Braitenberg", "ConstantSpeed", "Function", "Network", "Policy"),
    *("draw", "make", "make_vec", "read_log", "LoggedRun", "RunPage"),
    *("KhepTwinError", "MoveError", "PlaypenError", "PortError", "PortTimeout"),
    *("board", "drawing", "envs", "episodes", "errors", "host", "lab", "log", "playpen", "ports"),
    *("sensing", "shadow", "sweep", "toolbox", "units"),
}

ROOTS = sorted(
    ".".join(("khep_twin", *path.parent.relative_to(PACKAGE).parts))
    for path in PACKAGE.rglob("__init__.py")
    if "lazy.names" in path.read_text()
)


def loaded_by(program: str) -> set[str]:
    """Return the modules that a program loads in a process of its own."""
    words = [sys.executable, "-c", f"import sys\n{program}\nprint(*sys.modules)"]
    return set(subprocess.run(words, capture_output=True, text=True, check=True).stdout.split())


def test_the_public_names_are_these() -> None:
    assert set(khep_twin.__all__) == NAMES
    assert set(dir(khep_twin)) >= NAMES


@pytest.mark.parametrize("package", ROOTS)
def test_every_name_of_a_package_is_there(package: str) -> None:
    root = import_module(package)
    for name in root.__all__:
        assert getattr(root, name) is not None, name


def test_a_name_that_is_not_there_is_told_as_by_any_module() -> None:
    with pytest.raises(AttributeError, match="module 'khep_twin' has no attribute 'Kephera'"):
        _ = khep_twin.Kephera  # type: ignore[attr-defined]
    with pytest.raises(ImportError, match="cannot import name 'Kephera' from 'khep_twin'"):
        exec("from khep_twin import Kephera")


def test_importing_the_package_loads_nothing_but_the_port_and_names_for_gymnasium() -> None:
    loaded = loaded_by("import khep_twin")
    assert {name for name in loaded if name.startswith("khep_twin")} == {
        *("khep_twin", "khep_twin.lazy", "khep_twin.envs", "khep_twin.envs.registration")
    }
    assert not loaded & {"gymnasium", "numpy"}


def test_a_robot_on_a_cable_needs_no_simulator() -> None:
    loaded = loaded_by("from khep_twin import Gripper, Khepera, Khepera4, Radio, Vision")
    assert not loaded & {"mujoco", "numpy", "numba", "rerun", "mcap", "matplotlib", "pydantic"}


FIRST_LINES = runpy.run_path(str(PACKAGE.parent / "examples" / "00_first_lines.py"))


@pytest.mark.share(2)
@pytest.mark.parametrize("beginning", FIRST_LINES["EXAMPLES"], ids=lambda function: function.__name__)
def test_each_way_to_begin_runs_as_it_stands(
    beginning: Callable[[], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if beginning.__name__ == "learn":
        pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    monkeypatch.chdir(tmp_path)
    beginning()
    assert capsys.readouterr().out.strip()


def test_there_are_ten_ways_to_begin() -> None:
    assert len(FIRST_LINES["EXAMPLES"]) == 10
