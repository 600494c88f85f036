"""Which ports are found."""

import subprocess
import sys
from pathlib import Path

import pytest
from served_twin import served

from khep_twin.host.discovery import found_ports


@pytest.fixture(autouse=True)
def private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A private directory of this test's own."""
    (tmp_path / "runtime").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    return tmp_path


def twins() -> dict[str, str]:
    return {port.url: port.what for port in found_ports() if port.twin}


def test_a_served_twin_is_found_until_it_is_killed(private: Path) -> None:
    link = private / "khepera"
    with served("obstacles", "--link", str(link)) as (process, _):
        with served("two-lamps", "--tcp", ":0") as (_, url):
            assert twins() == {str(link): "twin in obstacles", url: "twin in two-lamps"}
        process.kill()
        process.wait()
        assert twins() == {}
    with served("default") as (_, path):
        assert list(twins()) == [path]
        assert len(list((private / "runtime" / "khep_twin").glob("*.served"))) == 1


def test_the_command_lists_and_asks() -> None:
    def said(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "khep_twin", "ports", *options]
        return subprocess.run(command, capture_output=True, text=True, check=True)

    with served("default", "--mode", "2", "--strict-line") as (_, path):
        assert f"{path}  twin in default\n" in said().stdout
        assert f"{path}  twin in default: BIOS 5.02, protocol 5.01 at 19200 baud\n" in said("--ask").stdout
