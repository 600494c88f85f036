"""Gymnasium knows the tasks once both packages are imported, in either order."""

import subprocess
import sys

import pytest

from khep_twin.envs.tasks import TASKS
from khep_twin.robots.khepera4.model import KHEPERA_4

PROGRAM = """
import sys
import {first}
import {then}
names = [name for name in gymnasium.registry if name.startswith("khep_twin/")]
module = sys.modules["gymnasium.envs.registration"]
print(*names)
print("mujoco" in sys.modules, type(module.__loader__).__name__, module.__loader__ is module.__spec__.loader)
print([finder for finder in sys.meta_path if type(finder).__module__.startswith("khep_twin")])
"""


@pytest.mark.parametrize(("first", "second"), [("khep_twin", "gymnasium"), ("gymnasium", "khep_twin")])
def test_gymnasium_knows_the_tasks_whichever_is_imported_first(first: str, second: str) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    words = [sys.executable, "-c", PROGRAM.format(first=first, then=second)]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines[0].split() == [f"khep_twin/{task}-v0" for task in (*TASKS, *KHEPERA_4.tasks)]
    # Its module is as if it had been imported alone, and nothing waits any longer.
    assert lines[1:] == ["False SourceFileLoader True", "[]"]


def test_an_environment_is_made_by_its_module_and_name() -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    options = {"planar": True, "compiled": False}
    environment = gymnasium.make("khep_twin:khep_twin/ObstacleAvoidance-v0", **options)
    assert environment.spec.id == "khep_twin/ObstacleAvoidance-v0"
