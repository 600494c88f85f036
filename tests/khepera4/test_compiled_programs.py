"""Programs compiled for a Khepera IV: device nodes, clock, threads, and what goes wrong."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from khep_twin.errors import KhepTwinError
from khep_twin.khepera4.machine import CHARGER_PIN, Machine
from khep_twin.khepera4.programs import run_program
from khep_twin.khepera4.registers import DspicRegister
from khep_twin.khepera4.robot import Khepera4Robot
from khep_twin.world import World

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="there is no Linux with a C compiler"
)

FOLDER = Path(__file__).parent / "programs"


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the preload library of the tests apart from the user's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the compiled programs."""
    folder = tmp_path_factory.mktemp("programs")
    for source in FOLDER.glob("*.c"):
        subprocess.run(["cc", "-o", folder / source.stem, source, "-lpthread"], check=True)
    return folder


def machine() -> Machine:
    return machine_of(World("arena4"))


def machine_of(world: World) -> Machine:
    robot = world.robots[0]
    assert isinstance(robot, Khepera4Robot)
    return Machine(robot.dspic, world)


def said(path: Path, capfd: pytest.CaptureFixture[str], *words: str, code: int = 0) -> list[str]:
    """Return the lines that a program prints in simulated time."""
    assert run_program([str(path), *words], machine()) == code
    told = capfd.readouterr()
    assert told.err == ""
    return told.out.splitlines()


def test_a_program_finds_the_dspic_on_its_bus_and_drives(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lines = said(programs / "drive", capfd, code=3)
    assert lines[:4] == ["slave 0", "probe 1", "other ENXIO", "revision B 0"]
    speeds = [int(line) for line in lines[4:]]
    assert speeds[0] == 0
    assert 600 < max(speeds) < 750
    assert speeds[-1] == pytest.approx(500, abs=3)


def test_time_passes_while_all_threads_and_children_wait_and_a_run_repeats(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first = said(programs / "threads", capfd)
    words = [line.split() for line in first]
    assert [(name, float(seconds)) for name, _, seconds in words] == sorted(
        [(name, float(seconds)) for name, _, seconds in words], key=lambda each: each[1]
    )
    assert [round(float(seconds), 3) for name, _, seconds in words if name == "slow"] == [
        0.05,
        0.1,
        0.15,
        0.2,
        0.25,
    ]
    assert [name for name, _, _ in words[-3:]] == ["main", "child", "parent"]
    for _ in range(3):
        assert said(programs / "threads", capfd) == first


def test_pins_reset_the_dspic_and_tell_of_the_charger(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    world = World("arena4")
    own, dspic = machine_of(world), world.robots[0].dspic
    own.set_pin(CHARGER_PIN, 0)
    dspic.write(bytes([DspicRegister.KP, 99]))
    assert run_program([str(programs / "pins")], own) == 0
    assert capfd.readouterr().out.splitlines() == ["charger 0", "held ENXIO", "kp 10"]


def test_many_handles_and_long_writes_get_an_answer_or_an_error(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert said(programs / "much", capfd) == ["opened 1000", "long 8192", "bad ENOTTY", "copy 1", "closed"]


def test_exit_codes_and_signals_pass_through(programs: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_program(["/bin/sh", "-c", "exit 7"], machine()) == 7
    assert run_program(["/bin/sh", "-c", "kill -9 $$"], machine()) == -signal.SIGKILL
    with pytest.raises(KhepTwinError, match=r"none: cannot be started: No such file or directory"):
        run_program([str(programs / "none")], machine())


def test_a_program_ends_with_its_twin(programs: Path) -> None:
    code = (
        "from test_compiled_programs import machine, run_program\nimport sys, os, signal, threading\n"
        "threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGKILL)).start()\n"
        "run_program([sys.argv[1]], machine(), simulated=False)\n"
    )
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code, programs / "forever"],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == -signal.SIGKILL
    assert done.stderr == "khep-twin: the twin has ended, and this program with it\n"


def test_without_a_compiler_it_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(KhepTwinError, match="no C compiler is installed; expected cc, gcc or clang"):
        run_program(["/bin/true"], machine())
