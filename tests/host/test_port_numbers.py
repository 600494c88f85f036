"""Ports by the numbers that the environment assigns to them."""

import pytest
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.host.opening import resolve_port


def test_a_number_is_the_port_that_the_environment_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KHEP_PORT_3", "khep://default?noise=off")
    with Khepera("3") as robot:
        assert robot.name == "khep://default?noise=off"
        assert robot.versions().bios == "5.02"
    assert resolve_port("/dev/ttyUSB3") == "/dev/ttyUSB3"
    assert resolve_port("5") == "5"


def test_a_number_without_a_port_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KHEP_PORT_1", raising=False)
    with pytest.raises(PortError, match=r"port 1: no port is chosen .*; expected KHEP_PORT_1=/dev/ttyUSB0"):
        Khepera("1")


@pytest.mark.parametrize(
    "words",
    [
        ("sense", "2", "--rotate", "15"),
        ("run", "--port", "2", "--cycles", "3"),
        ("conform", "2"),
    ],
)
def test_commands_take_a_number_for_a_port(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KHEP_PORT_2", "khep://default?seed=1")
    assert CliRunner().invoke(app, [*words]).exit_code == 0
