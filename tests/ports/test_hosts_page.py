"""The commands in docs/hosts.md serve as described."""

import re
from pathlib import Path

import pytest
from served_twin import served

from khep_twin.host import Khepera

PAGE = (Path(__file__).parents[2] / "docs" / "hosts.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"^\| .*`khep-twin serve ([^`]*--link khepera)`", PAGE, re.MULTILINE)))


def test_the_page_has_commands() -> None:
    assert len(COMMANDS) >= 4


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_of_the_page_serves_at_a_link(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    speed = 38400 if "--mode 3" in command else 9600
    with served(*command.split()) as (process, path):
        assert path == str(tmp_path / "khep_twin" / "khepera")
        with Khepera(path, baudrate=speed) as robot:
            assert robot.versions().bios == ("6.01" if "khepera2" in command else "5.02")
        process.terminate()
        assert process.stderr is not None
        assert "baud" not in process.stderr.read()
