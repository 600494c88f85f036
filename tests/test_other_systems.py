"""Systems without pseudo-terminals, inotify and Unix's locks: all code that needs none of them runs."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial
from forked import run_python

HIDING = """
import builtins, runpy, sys

HIDDEN = {"fcntl", "termios", "tty", "pty", "resource", "curses", "grp", "pwd"}
importing = builtins.__import__


def hidden(name, globals=None, *rest, **named):
    # The modules that others need, such as pyserial on this system, stay.
    if name.split(".")[0] in HIDDEN and str((globals or {}).get("__name__", "")).startswith("khep_twin"):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    return importing(name, globals, *rest, **named)


builtins.__import__ = hidden
"""

COMMAND = "sys.argv[0] = 'khep-twin'\nrunpy.run_module('khep_twin', run_name='__main__')"

ALONE = {"khep_twin.ports.pty", "khep_twin.ports.terminal_hosts", "khep_twin.__main__"}
"""Modules that are for terminals alone, and the one that runs the command."""


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program without those modules."""
    command = [sys.executable, "-c", HIDING + program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@contextmanager
def served(*arguments: str) -> Iterator[str]:
    """Serve a twin without those modules; return the line that names what hosts open."""
    command = [sys.executable, "-c", HIDING + COMMAND, "serve", "default", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.terminate()
            process.wait(timeout=60)
    assert process.returncode == 0


def test_every_module_but_those_of_terminals_is_imported() -> None:
    process = run(
        "import pkgutil, khep_twin\n"
        "names = [each.name for each in pkgutil.walk_packages(khep_twin.__path__, 'khep_twin.')]\n"
        f"for name in sorted(set(names) - {ALONE!r}):\n"
        # Not for numba's simulator, which tests have in place of a card.
        "    if not name.startswith('khep_twin.assets') and name != 'khep_twin.episodes.cuda.lowering':\n"
        "        __import__(name)\n"
        "print(len(names))"
    )
    assert process.returncode == 0, process.stderr
    assert int(process.stdout) > 200


def test_a_twin_is_driven_in_lock_step_and_its_log_is_read_recovered_and_repeated(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    process = run(
        "from pathlib import Path\n"
        "from khep_twin.host import Khepera\n"
        "from khep_twin.lab.experiment.repeat import repeat\n"
        "from khep_twin import read_log\n"
        "from khep_twin.log.recorded import read_recorded_run\n"
        "from khep_twin.log.recover import recover\n"
        "log = Path(sys.argv[1])\n"
        "with Khepera(f'khep://default?seed=1&log={log}') as robot:\n"
        "    robot.set_speed(5, 5)\n"
        "    robot.sleep(3.0)\n"
        "    print(robot.proximity())\n"
        "part = log.with_suffix('.mcap.part')\n"
        "part.write_bytes(log.read_bytes()[:-200])\n"
        "print(recover(part).path.name, len(read_log(log).robots), repeat(read_recorded_run(log)))",
        str(log),
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines()[1] == "run.recovered.mcap 1 None"


@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
@pytest.mark.parametrize("kind", ["rfc2217", pytest.param("tcp", marks=pytest.mark.long)])
def test_hosts_on_the_network_are_served(kind: str) -> None:
    with (
        served(f"--{kind}", "127.0.0.1:0") as url,
        serial.serial_for_url(url, 9600, stopbits=2, timeout=20) as port,
    ):
        port.write(b"B\n")
        assert port.readline() == b"b,5.02,5.01\r\n"


def test_a_terminal_is_refused_in_one_line_that_names_the_network() -> None:
    process = run(COMMAND, "serve", "default")
    assert process.returncode == 1
    assert process.stderr.splitlines()[-1].endswith("or --rfc2217 127.0.0.1:5000")
    assert "no pseudo-terminals; expected --tcp 127.0.0.1:5000" in process.stderr
    assert "Traceback" not in process.stderr


def test_the_page_offers_a_network_port_for_its_robot() -> None:
    process = run("from khep_twin.ports.endpoints import open_any_port\nprint(open_any_port(9600).path)")
    assert process.stdout.startswith("socket://127.0.0.1:"), process.stderr


@pytest.mark.parametrize(
    ("package", "words"),
    [
        ("matplotlib", ["playpen", "draw", "default", "-o", "map.png"]),
        ("scipy", ["fit", "nothing.csv"]),
    ],
)
def test_a_command_without_its_package_names_what_installs_it(
    package: str, words: list[str], tmp_path: Path
) -> None:
    program = f"import runpy, sys\nsys.modules[{package!r}] = None\n{COMMAND}"
    command = [sys.executable, "-c", program, *words]
    process = run_python(command, timeout=300, cwd=tmp_path)
    assert process.returncode == 1
    assert process.stderr.startswith(f"khep-twin: {package} is not installed; to install it: "), (
        process.stderr
    )
    assert f"pip install '{package}<" in process.stderr
    assert len(process.stderr.splitlines()) == 1
