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
    ("arguments", "told"),
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
def test_a_mistake_is_reported_in_one_line(tmp_path: Path, arguments: list[str], told: str) -> None:
    (tmp_path / "broken.toml").write_text("nonsense = 1\n")
    (tmp_path / "folder.toml").mkdir()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        given = [each.format(taken=taken.getsockname()[1]) for each in arguments]
        done = khep_twin("design", *given, "--no-browser", folder=tmp_path)
    assert done.returncode in (1, 2)
    assert told in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
