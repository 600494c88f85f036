"""Windows, simulated: code without terminals runs, except the features that docs/install.md excludes."""

import os
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath
from typing import Any

import pytest
import serial
from forked import run_python

from khep_twin.web import documents as documents_module
from khep_twin.web.documents import Documents

SIMULATION = (
    f"import runpy, sys\nsys.path.insert(0, {str(Path(__file__).parent)!r})\nimport windows_simulation\n"
)
"""Start of a program on the simulated system."""

COMMAND = "sys.argv[0] = 'khep-twin'\nrunpy.run_module('khep_twin', run_name='__main__')"

ALONE = {*(f"khep_twin.ports.{name}" for name in ("link", "pty", "terminal_hosts")), "khep_twin.__main__"}
"""Modules that are for terminals alone, and the one that runs the command."""


STUDY = """version = 1
name = "small"
playpens = ["default"]
controllers = ["braitenberg"]
seeds = 3
seconds = 0.2
rollouts_per_task = 2
output = "out"
"""

RUNS = """
import threading
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
from mcap.writer import MCAP0_MAGIC

from khep_twin.process import machine
from khep_twin.errors import KhepTwinError
from khep_twin.files.atomic import write_atomic
from khep_twin.log.tail import GrowingLog
from khep_twin.ports.relay import _wait_for_bytes
from khep_twin.ports.service_registry import registered_ports, served_ports
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sweep import study
from khep_twin.sweep.sweep import run_sweep
from khep_twin.web.paced_twin import PacedTwin

log = Path("run.mcap")
# A second log replaces the first one, beside the remains of a crash.
for _ in range(2):
    Path("run.mcap.part").write_bytes(MCAP0_MAGIC)
    with open_twin("default", TwinOptions(log=str(log))) as twin, GrowingLog(log) as growing:
        PacedTwin(twin, [], lambda: None).advance_to(60_000_000)
        twin.recorder.flush()
        n_entries = len(growing.read_new())
        twin.close()
        while not growing.is_finished:
            n_entries += len(growing.read_new())
        assert n_entries > 30
with open_twin("default", TwinOptions(log="stopped.mcap")) as twin:
    twin.recorder.discard()
print(*sorted(path.name for path in Path().glob("*.mcap*")))

Path("study.toml").write_text(Path("study.txt").read_text())
print(pq.read_metadata(run_sweep(study.load(Path("study.toml")))).num_rows)

device, port = SimpleNamespace(descriptor=None), SimpleNamespace(descriptors=lambda has_room: ())
_wait_for_bytes(device, port, True, False, 0)
with registered_ports(["socket://127.0.0.1:1"], "default"):
    print(*served_ports()[0][:2])

first, second = (Path("lock").open("wb") for _ in range(2))
machine.lock(first)
threading.Timer(0.1, first.close).start()
machine.lock(second, waits=True)

# A file that another program reads for a moment is replaced; after a while the error is one line.
reader = Path("study.toml").open()
threading.Timer(0.1, reader.close).start()
write_atomic(Path("study.toml"), b"new")
machine._READERS_S = 0.0
with Path("study.toml").open():
    try:
        write_atomic(Path("study.toml"), b"newer")
    except KhepTwinError as error:
        print(error)
print(Path("study.toml").read_text(), *Path().glob(".study*"))
"""


def run(
    program: str, *arguments: str, folder: Path | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program on the simulated system."""
    command = [sys.executable, "-c", SIMULATION + program, *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, cwd=folder, **options
    )


@contextmanager
def served(*arguments: str) -> Generator[str]:
    """Serve a twin without terminals; return the line that names the port for hosts."""
    command = [sys.executable, "-c", SIMULATION + COMMAND, "serve", "default", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.terminate()
            process.wait(timeout=60)
    assert process.returncode == 0


@pytest.mark.long
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


def test_open_files_are_not_renamed_or_removed_and_only_sockets_are_waited_for(tmp_path: Path) -> None:
    (tmp_path / "study.txt").write_text(STUDY)
    process = run(RUNS, folder=tmp_path, env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)})
    assert process.stdout.splitlines() == [
        "run.mcap run.mcap.part.1 run.mcap.part.2",
        "3",
        "socket://127.0.0.1:1 default",
        "study.toml: cannot be written: The process cannot access the file, as it is open",
        "new",
    ], process.stderr


def test_a_prompt_reads_a_line_of_an_input_that_cannot_be_waited_for() -> None:
    program = (
        "from khep_twin.cli.options import ask_line\n"
        "print([ask_line('?', lambda: False) for _ in range(3)], ask_line('?', lambda: True))"
    )
    assert "[b'one\\n', b'two', b''] None" in run(program, input="one\ntwo").stdout


def test_a_console_without_a_character_shows_its_code() -> None:
    program = f"import os\n{COMMAND}"
    process = run(
        program, "playpen", "check", "\u03c0.toml", env={**os.environ, "PYTHONIOENCODING": "cp1252"}
    )
    assert (process.returncode, "Traceback" in process.stderr) == (1, False)
    assert "\\u03c0.toml: " in process.stderr


def test_the_page_names_files_with_slashes(monkeypatch: pytest.MonkeyPatch) -> None:
    documents = Documents(Path())
    documents.root = PureWindowsPath("C:/pens")  # type: ignore[assignment]
    folders: list[tuple[str, list[str], list[str]]] = [("C:/pens/a", [], ["b.toml"])]
    monkeypatch.setattr(documents_module, "Path", PureWindowsPath)
    monkeypatch.setattr("os.walk", {documents.root: folders}.__getitem__)
    assert documents.names() == ["a/b.toml"]


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
    command: list[object] = [sys.executable, "-c", program, *words]
    process = run_python(command, timeout=300, cwd=tmp_path)
    assert process.returncode == 1
    assert process.stderr.startswith(f"khep-twin: {package} is not installed; to install it: "), (
        process.stderr
    )
    assert f"pip install '{package}<" in process.stderr
    assert len(process.stderr.splitlines()) == 1
