"""Programs compiled for a robot's computer: device nodes, clock, threads, networks, and errors."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from khep_twin.episodes.controllers import Network
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError
from khep_twin.programs.computer import Machine
from khep_twin.programs.robot_program import RobotProgram, run_programs
from khep_twin.robots.khepera4.computer import CHARGER_PIN
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.world import World

pytestmark = [
    pytest.mark.skipif(
        sys.platform != "linux" or shutil.which("cc") is None, reason="there is no Linux with a C compiler"
    ),
    pytest.mark.usefixtures("separate_cache"),
]


def run_program(
    arguments: Sequence[str], machine: Machine, *, simulated: bool = True, robot_id: int = 1
) -> int:
    """Run one program; return its exit code."""
    return run_programs([RobotProgram(arguments, machine, robot_id)], simulated=simulated)[0]


def machine() -> Machine:
    return machine_of(World("arena4"))


Kind = TypeVar("Kind", bound=Machine)


def machine_of(world: World, kind: type[Kind] = Machine) -> Kind:
    return kind(world.robots[0], world)


def python(source: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run Python code beside this file, in a separate session."""
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    return subprocess.run(
        [sys.executable, "-c", source, *words],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=60,
        start_new_session=True,
    )


def output_of(path: Path, capfd: pytest.CaptureFixture[str], *words: str, code: int = 0) -> list[str]:
    """Return the lines that a program prints in simulated time."""
    assert run_program([str(path), *words], machine()) == code
    output = capfd.readouterr()
    assert output.err == ""
    return output.out.splitlines()


def test_a_program_finds_the_dspic_on_its_bus_and_drives(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lines = output_of(programs / "drive", capfd, code=3)
    assert lines[:4] == ["slave 0", "probe 1", "other ENXIO", "revision B 0"]
    speeds = [int(line) for line in lines[4:]]
    assert speeds[0] == 0
    assert 600 < max(speeds) < 750
    assert speeds[-1] == pytest.approx(500, abs=3)


class ObservedMachine(Machine):
    """Machine that keeps the speeds that its program sets, as they are on the bus."""

    speeds: tuple[bytes, ...] = ()

    def transfer(self, bus: int, messages: Sequence[tuple[int, int, bytes]], byte_ns: int) -> bytes:
        content = messages[0][2]
        if content[0] == DspicRegister.SPEED_ORDER_LEFT:
            self.speeds += (content[1:],)
        return super().transfer(bus, messages, byte_ns)


def test_a_networks_program_drives_at_the_speeds_of_its_rollout(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    terms, n_cycles, setup = ("gyroscope", "ground", "ultrasonic"), 12, EpisodeSetup("arena4")
    network = Network(hidden=(4, 3), recurrent=True, ambient=True, terms=terms, model="khepera4")
    genes = np.random.default_rng(1).normal(size=network.n_genes)
    network.save(tmp_path / "best.c", genes, setup=setup)
    build = ["cc", "-Wall", "-Werror", "-o", tmp_path / "best", tmp_path / "best.c", "-lm"]
    subprocess.run(build, check=True)
    machine = machine_of(World("arena4", seed=1), ObservedMachine)
    program = RobotProgram([str(tmp_path / "best")], machine)
    assert run_programs([program], until_ns=n_cycles * setup.period_ns) == [0]
    assert capfd.readouterr() == ("", "")
    episode, expected = Episode(setup, network, compiled=False), []
    episode.begin(1, EpisodeOptions(genes=genes))
    robot = episode.world.robots[0]
    assert isinstance(robot, Khepera4Robot)
    for _ in range(n_cycles):
        episode.step(setup.steps_per_period)
        expected.append(robot.dspic.read(DspicRegister.SPEED_ORDER_LEFT, 4))
    assert machine.speeds == (bytes(4), *expected, bytes(4))
    assert len(set(expected)) == n_cycles


def test_time_passes_while_all_threads_and_children_wait_and_a_run_repeats(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first = output_of(programs / "threads", capfd)
    words = [line.split() for line in first]
    assert [(name, float(seconds)) for name, _, seconds in words] == sorted(
        [(name, float(seconds)) for name, _, seconds in words], key=lambda entry: entry[1]
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
        assert output_of(programs / "threads", capfd) == first


def test_timers_of_all_kinds_follow_simulated_time_and_interrupt_waits(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert output_of(programs / "timers", capfd) == [
        "pause 2.000",
        "sleep leaves 3 at 2.000",
        "nanosleep -1 1 leaves 0.700",
        "interval 5 0.500",
        "timer 3 0.090",
        "value 77, next in 0.020",
        "called 5 0.070",
        "after 0.200",
        "read 8, 1 at 0.050",
        "select 1 at 0.070",
        "read 8, 3 at 0.120",
        "epoll 0 at 0.125",
        "epoll 1 at 0.130",
        "poll 0 at 0.380",
    ]


@pytest.mark.parametrize("name", ["limits", "limits-strict"])
def test_waits_for_threads_and_descriptors_end_at_a_wake_or_a_time_out(
    programs: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    lines = [line.rpartition(" ") for line in output_of(programs / name, capfd)]
    assert [(text, round(float(seconds), 2)) for text, _, seconds in lines] == [
        ("begin 0", 0.0),
        ("condition in vain 1", 0.25),
        ("and by the other clock 1", 0.25),
        ("semaphore in vain 1", 0.25),
        ("select in vain 0", 0.25),
        ("poll in vain 0", 0.25),
        ("condition 0", 0.55),
        ("semaphore 0", 0.5),
        ("poll 1", 0.5),
        ("mutex in vain 1", 0.1),
        ("mutex 0", 0.4),
    ]


def test_the_date_starts_with_2026_and_other_clocks_at_0(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert output_of(programs / "clocks", capfd) == ["2026-01-01 00:00:00", "10 10 10", "10 10", "0.0101"]


def test_threads_and_children_take_turns(programs: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert output_of(programs / "turns", capfd) == [
        *["ask 0.000", "answer 0.000"] * 5,
        "system 0.010",
        "after 0.010",
        "meanwhile 0.010",
        "spawned 0.020",
        "vforked 0.030",
        "opened 0.040",
        "end 0.040",
        "flag",
    ]


def test_the_order_of_lock_owners_is_deterministic(programs: Path, capfd: pytest.CaptureFixture[str]) -> None:
    first = output_of(programs / "order", capfd)
    assert len(first[0]) == 80 + 80 + 4 + 40
    for _ in range(5):
        assert output_of(programs / "order", capfd) == first


@pytest.mark.parametrize("name", ["paths", "paths-strict"])
def test_nodes_and_files_of_the_robot_are_found_by_path(
    programs: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    assert run_program([str(programs / name)], machine(), robot_id=42) == 0
    assert capfd.readouterr().out.splitlines() == [
        "bus 0 0",
        "pins 0 0",
        "camera -1",
        "stream 0",
        "write 1",
        "robot 42",
        "entries 3",
        "none -1",
    ]


@pytest.mark.parametrize(("how", "line"), [("jump", "jumped"), ("close", "closed")])
def test_a_program_may_leave_a_handler_by_longjmp_and_close_all_descriptors(
    programs: Path, capfd: pytest.CaptureFixture[str], how: str, line: str
) -> None:
    assert output_of(programs / "ends", capfd, how) == [line]


@pytest.mark.share(2)
@pytest.mark.parametrize(("how", "code", "left"), [("outlive", 4, 1), ("kill", -signal.SIGKILL, 3)])
def test_a_run_ends_with_the_program_and_its_surviving_children(
    programs: Path, tmp_path: Path, how: str, code: int, left: int
) -> None:
    message = "khep-twin: the twin has ended, and this program with it\n"
    source = (
        "from test_compiled_programs import machine, run_program\nimport sys\n"
        "print(run_program(sys.argv[1:], machine()))\n"
    )
    result = python(source, programs / "ends", how)  # which waits for the end of all that have its stderr
    assert (result.stdout, result.stderr) == (f"{code}\n", message * left)


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("how", "number", "output"),
    [
        ("stop", signal.SIGINT, f"up\n{100 + signal.SIGINT}\n"),
        ("stop", signal.SIGTERM, f"up\n{100 + signal.SIGTERM}\n"),
        ("long", signal.SIGTERM, f"{-signal.SIGTERM}\n"),  # a sleep of days
    ],
)
def test_a_signal_that_ends_the_twin_is_forwarded_to_the_program(
    programs: Path, how: str, number: signal.Signals, output: str
) -> None:
    source = (
        "from test_compiled_programs import machine, run_program\nimport os, signal, sys, threading, time\n"
        f"number = {int(number)}\nsend = os.kill if number == signal.SIGTERM else os.killpg\n"
        "own = machine()\n"
        "def end():\n"
        "    while own.time_ns < 20_000_000:\n"
        "        time.sleep(0.01)\n"
        "    send(os.getpid(), number)\n"
        "threading.Thread(target=end).start()\n"
        "print(run_program(sys.argv[1:], own))\n"
    )
    assert python(source, programs / "ends", how).stdout == output


def test_a_program_that_is_still_running_at_the_end_is_stopped_and_has_time_to_clean_up(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    program = RobotProgram([str(programs / "ends"), "stop"], machine())
    assert run_programs([program], until_ns=20_000_000) == [100 + signal.SIGTERM]
    assert capfd.readouterr().out == "up\n"


def test_pins_reset_the_dspic_and_report_the_charger(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    world = World("arena4")
    twin_machine, dspic = machine_of(world), world.robots[0].dspic
    twin_machine.set_pin(CHARGER_PIN, 0)
    dspic.write(bytes([DspicRegister.KP, 99]))
    assert run_program([str(programs / "pins")], twin_machine) == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines == ["charger 0", "held ENXIO", "kp 10", "100 levels 1010 us"]


def test_many_descriptors_and_long_writes_get_a_reply_or_an_error(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert output_of(programs / "much", capfd) == [
        "opened 1000",
        "long 8192",
        "bad ENOTTY",
        "copy 1",
        "closed",
    ]


def test_exit_codes_and_signals_pass_through(programs: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_program(["/bin/sh", "-c", "exit 7"], machine()) == 7
    assert run_program(["/bin/sh", "-c", "kill -9 $$"], machine()) == -signal.SIGKILL
    with pytest.raises(KhepTwinError, match=r"none: cannot be started: No such file or directory"):
        run_program([str(programs / "none")], machine())


def test_all_processes_and_files_of_a_run_end_with_a_killed_twin(programs: Path, tmp_path: Path) -> None:
    code = (
        "from test_compiled_programs import Machine, machine, run_program\nimport sys, os, signal\n"
        "def transfer(*_):\n"
        "    if os.path.exists('child') and os.path.getsize('child'):\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return b''\n"
        "Machine.transfer = transfer\n"
        "run_program(['/bin/sh', '-c', sys.argv[1]], machine(), simulated=False)\n"
    )
    folder = tmp_path / "temporary"
    folder.mkdir()
    computation = "echo $$ > child; while :; do :; done"
    program = f"/bin/sh -c '{computation}' > /dev/null 2>&1 & exec {programs / 'forever'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folder))
        patch.chdir(tmp_path)
        result = python(code, program)
    assert result.returncode == -signal.SIGKILL
    assert result.stderr == "khep-twin: the twin has ended, and this program with it\n"
    computing, end_s = Path("/proc", (tmp_path / "child").read_text().strip()), time.monotonic() + 30
    while (computing.exists() or [*folder.iterdir()]) and time.monotonic() < end_s:
        time.sleep(0.02)
    leftovers = [computing] * computing.exists() + [*folder.iterdir()]
    if computing.exists():
        os.kill(int(computing.name), signal.SIGKILL)
    assert leftovers == []


def test_a_missing_compiler_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(KhepTwinError, match="no C compiler is installed; expected cc, gcc or clang"):
        run_program(["/bin/true"], machine())
