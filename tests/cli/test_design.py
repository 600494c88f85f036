"""`khep-twin design`, as a user types it."""

import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from command_line import khep_twin

COMMAND = [sys.executable, "-m", "khep_twin", "design"]


def test_it_prints_its_address_in_one_line_and_ends_when_asked(tmp_path: Path) -> None:
    with subprocess.Popen(
        [*COMMAND, "mine.toml", "--no-browser"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stderr.readline().endswith("; open this page in a browser; Ctrl-C ends it\n")
        url = process.stdout.readline().strip()
        with urllib.request.urlopen(url) as answer:
            assert b"Khepera designer" in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        assert process.stdout.read() == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["../mine.toml"], "expected a file below"),
        (["mine.txt"], "ends in .toml"),
        (["--listen", "0.0.0.0:0"], "--allow-remote"),
        (["--listen", "nowhere"], "nowhere"),
        (["--listen", "127.0.0.1:{taken}"], "cannot listen there: Address already in use"),
        (["broken.toml"], "broken.toml:1: nonsense"),
        (["nowhere/mine.toml"], "nowhere/mine.toml: cannot be made: there is no directory"),
        (["folder.toml"], "folder.toml"),
    ],
)
def test_a_mistake_is_reported_in_one_line(tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "broken.toml").write_text("nonsense = 1\n")
    (tmp_path / "folder.toml").mkdir()
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        options = [argument.format(taken=occupied.getsockname()[1]) for argument in arguments]
        process = khep_twin("design", *options, "--no-browser", folder=tmp_path)
    assert process.returncode in (1, 2)
    assert message in " ".join(process.stderr.split())
    assert "Traceback" not in process.stderr
    assert process.stdout == ""
