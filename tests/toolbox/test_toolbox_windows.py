"""Windows that stay open after the end of their program, without a screen."""

import sys

import pytest

from khep_twin.toolbox import serial_commands as host
from khep_twin.toolbox import windows


class Window:
    """A window that is closed after a number of updates."""

    def __init__(self, updates_left: int) -> None:
        self.looks = updates_left
        self.canvas = self

    def flush_events(self) -> None:
        """Count an update, and close the window after the last one."""
        self.looks -= 1
        if self.looks == 0:
            windows._windows.remove(self)
        if self.looks < -5:
            raise KeyboardInterrupt


@pytest.fixture(autouse=True)
def reset_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "_windows", [])
    monkeypatch.delattr(sys, "last_type", raising=False)


def test_a_program_that_has_ended_waits_for_its_windows_with_its_robot_at_rest(
    capsys: pytest.CaptureFixture[str],
) -> None:
    robot = host.robot_at("khep://default")
    robot.set_speed(5, 5)
    windows._windows[:] = [Window(3), Window(2)]
    windows.wait_until_closed()
    assert windows._windows == []
    assert not robot.port.is_open
    assert "close its windows, or press Ctrl-C" in capsys.readouterr().err


def test_ctrl_c_ends_the_wait() -> None:
    windows._windows[:] = [Window(0)]
    windows.wait_until_closed()
    assert windows._windows == []


@pytest.mark.parametrize("name", ["last_type", "ps1"])
def test_nothing_is_waited_for_after_an_error_or_at_a_prompt(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, name, ValueError, raising=False)
    windows._windows[:] = [Window(0)]
    windows.wait_until_closed()
    assert windows._windows[0].looks == 0
