"""Compiled code is used when it is ready, and otherwise compiled in the background of a run."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba_marks import with_numba

from khep_twin.cli.compile import compile_all
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Function
from khep_twin.episodes.episode import SlowerWarning
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError, MissingNumbaError
from khep_twin.playpen import Playpen
from khep_twin.process.machine import lock
from khep_twin.shadow.planes import Twins
from khep_twin.simulation import ready
from khep_twin.step import Reason
from khep_twin.world import World

pytestmark = with_numba


@pytest.fixture(autouse=True)
def usual_change_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let worlds change over to compiled code when users' worlds do."""
    monkeypatch.setattr("khep_twin.simulation.stepping_code._MIN_STEPS", 30_000)


def function(folder: Path) -> SimpleNamespace:
    """Return a function whose code numba caches in a folder."""
    named = SimpleNamespace(__qualname__="_advance_0123")
    return SimpleNamespace(signatures=[], stats=SimpleNamespace(cache_path=str(folder)), py_func=named)


def test_code_is_cached_where_numba_has_its_file(tmp_path: Path) -> None:
    uncached = function(tmp_path)
    assert not ready.is_cached(uncached)
    (tmp_path / "compiled._advance_0123-85.py311.nbi").touch()  # the index alone is not the code
    assert not ready.is_cached(uncached)
    (tmp_path / "compiled._advance_0123-85.py311.1.nbc").touch()
    assert ready.is_cached(uncached)


def test_a_compilation_beside_the_run_is_announced_once_and_so_is_its_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    dispatcher = function(tmp_path)
    monkeypatch.setattr(ready, "function_of", lambda part: dispatcher)
    monkeypatch.setattr(ready, "_PROCESSES", {})
    commands: list[list[str]] = []

    def start(words: list[str], **options: object) -> "subprocess.Popen[bytes]":
        commands.append(words)
        return subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"])

    monkeypatch.setattr(ready, "subprocess", SimpleNamespace(Popen=start, DEVNULL=subprocess.DEVNULL))
    assert ready.when_ready("world") is None
    assert capfd.readouterr().err == f"{ready.BACKGROUND_NOTICE}\n"
    assert commands == [[sys.executable, "-m", "khep_twin", "compile", "world"]]
    ready._PROCESSES["world"].wait()
    for _ in range(3):
        assert ready.when_ready("world") is None
    messages = capfd.readouterr().err
    assert messages.count("the compilation failed") == 1
    assert messages.endswith("-m khep_twin compile world\n")
    assert len(commands) == 1
    (tmp_path / "compiled._advance_0123-85.py311.1.nbc").touch()
    assert ready.when_ready("world") is dispatcher


def test_one_process_at_a_time_compiles_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ready, "function_of", lambda part: function(tmp_path))
    with ready.compile_lock("world"), (tmp_path / "compile-world.lock").open("ab") as file:
        with pytest.raises(BlockingIOError):
            lock(file)
        with ready.compile_lock("plane"):  # another part
            pass
    with (tmp_path / "compile-world.lock").open("ab") as file:
        lock(file)


def test_where_no_code_can_be_kept_nothing_is_compiled_in_advance_and_users_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from numba.core import caching

    from khep_twin.simulation.compiled import compiled

    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    dispatcher = compiled(lambda x: 2 * x, ())
    monkeypatch.setattr(ready, "function_of", lambda part: dispatcher)
    monkeypatch.setattr(ready, "_PROCESSES", {})
    ready._print_once.cache_clear()
    for _ in range(2):
        assert ready.when_ready("world") is None
    messages = capsys.readouterr().err
    assert messages.count("this run stays uncompiled") == 1
    assert messages.endswith("expected one that can be in NUMBA_CACHE_DIR\n")
    assert not ready._PROCESSES
    monkeypatch.setattr(ready, "functions_of", lambda part: [dispatcher])
    with pytest.raises(KhepTwinError, match=r"^nothing is compiled, as numba can keep no code: neither"):
        compile_all(parts=["world"])
    assert dispatcher(3) == 6
    assert ready.when_ready("world") is dispatcher


def test_a_world_looks_for_compiled_code_only_in_a_long_run(monkeypatch: pytest.MonkeyPatch) -> None:
    requests: list[str] = []
    monkeypatch.setattr("khep_twin.simulation.stepping_code.when_ready", requests.append)
    world = World(Playpen.load("default"))
    assert world.code.switch_step == 30_000
    world.code.switch_step = 100
    world.advance_to(99 * world.timing.step_ns)
    assert not requests
    world.advance_to(200 * world.timing.step_ns)
    assert requests == ["world"]
    assert world.code.switch_step == 3200
    world.code.switch_step = None
    world.advance_to(300 * world.timing.step_ns)
    assert requests == ["world"]


def test_compiled_code_is_loaded_when_a_world_changes_over_not_at_its_next_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[int] = []

    def advance(*arguments: object) -> int:
        *_, end_step, _ = arguments
        calls.append(int(str(end_step)))
        return Reason.DONE

    monkeypatch.setattr("khep_twin.simulation.stepping_code.when_ready", lambda part: advance)
    world = World(Playpen.load("default"))
    world.advance_to(3 * world.timing.step_ns)
    world.code.switch_if_ready()
    assert calls == [3]
    assert world.time_ns == 3 * world.timing.step_ns


def test_a_playpen_without_robots_has_nothing_to_compile() -> None:
    empty = Playpen.load("default").model_copy(update={"robots": ()})
    world = World(empty, compiled=True)
    world.advance_to(10**8)
    assert not world.simulation.is_compiled


def test_what_cannot_be_compiled_is_refused_in_one_line() -> None:
    process = subprocess.run(
        [sys.executable, "-m", "khep_twin", "compile", "wrold"], capture_output=True, text=True, check=False
    )
    assert (process.returncode, process.stdout) == (2, "")
    assert process.stderr == (
        "khep-twin: part 'wrold': unknown; did you mean 'world'? (choices: world, episodes, plane, vision, "
        "shadow, world.khepera, world.khepera3, world.khepera4)\n"
    )


def test_where_numba_is_switched_off_runs_are_plain_and_what_must_be_compiled_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("numba.config.DISABLE_JIT", 1)
    setup = EpisodeSetup("obstacles", planar=True)
    with pytest.warns(SlowerWarning, match=r"^NUMBA_DISABLE_JIT switches numba off: episodes run uncompiled"):
        results = rollout(setup, Function(lambda *readings: (5.0, 5.0)), [1, 2], 0.2, threads=2)
    assert results.metrics["distance_m"][0] > 0
    for part in ready.CODE:
        assert ready.when_ready(part) is None
    for call in (
        lambda: compile_all(parts=["shadow"]),
        lambda: World("obstacles", compiled=True),
        lambda: rollout(setup, Function(max), [1], 0.2, compiled=True),
        lambda: Twins(setup, 1),
    ):
        with pytest.raises(MissingNumbaError, match=r"^NUMBA_DISABLE_JIT switches numba off; expected"):
            call()
