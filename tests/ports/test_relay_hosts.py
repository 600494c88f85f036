"""A relay between hosts that leave and a slow robot."""

import re
import time
from typing import cast

import pytest

from khep_twin.board.uart import LineSettings
from khep_twin.ports.host_port import Received
from khep_twin.ports.relay import Device, relay


class SlowRobot:
    """A robot at a port that accepts 100 bytes at a time, stores them and never answers."""

    url, baud, descriptor, unsent = "robot", 9600, None, 0

    def __init__(self) -> None:
        self.received = b""

    def apply_settings(self, host: LineSettings) -> str:
        return ""

    def read(self) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        self.received += data[:100]
        return len(data[:100])


class Hosts:
    """A host port with a list of results."""

    path, dropped, occupied = "hosts", 0, True

    def __init__(self, *news: Received) -> None:
        self.news = list(news)
        self.answered: list[bool] = []

    def descriptors(self, has_room: bool) -> list[int]:
        return []

    def set_baud(self, baud: int) -> None:
        """Do nothing: its hosts set no baud rate."""

    def settings(self) -> None:
        return None

    def receive(self, limit: int, is_answered: bool = False) -> Received:
        self.answered.append(is_answered)
        ready = self.news and (limit or not self.news[0].data)
        return self.news.pop(0) if ready else Received()

    def write(self, data: bytes, is_end: bool = False) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize(
    "news",
    [
        (Received(b"B\n", hosts_left=True, last_data=b"D,10,1\n" * 2000),),
        (Received(hosts_left=True, last_data=b"D,10,1\n" * 2000), Received(b"B\n")),
    ],
    ids=["at that moment", "later"],
)
def test_the_next_host_waits_for_no_more_than_a_second_of_one_that_has_left(
    monkeypatch: pytest.MonkeyPatch, news: tuple[Received, ...]
) -> None:
    monkeypatch.setattr("khep_twin.ports.relay._PAUSE_S", -1.0)
    monkeypatch.setattr("khep_twin.ports.relay._SILENCE_S", 0.01)
    monkeypatch.setattr("khep_twin.ports.relay.BITS_PER_BYTE", 0)
    robot, notices = SlowRobot(), list[str]()
    hosts = Hosts(Received(b"D,10,1\n" * 20), *news)
    end = time.monotonic() + 20
    relay(
        cast(Device, robot),
        hosts,
        stop=lambda: robot.received.endswith(b"B\n") or time.monotonic() > end,
        notify=notices.append,
    )
    commands = robot.received.removesuffix(b"B\n")
    complete = commands.removesuffix(b"?\n")
    assert complete == (b"D,10,1\n" * 300)[: len(complete)]
    assert complete != commands or commands.endswith(b"\n")
    assert 1000 < len(commands) <= 240 + 1024
    (line,) = notices
    assert re.fullmatch(r"hosts: \d+ bytes of a host that has left were dropped: the next one waits", line)


def test_a_relay_reports_to_its_cable_when_all_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("khep_twin.ports.relay._PAUSE_S", -1.0)
    monkeypatch.setattr("khep_twin.ports.relay._SILENCE_S", 0.05)
    robot, hosts = SlowRobot(), Hosts(Received(b"D,1,1\n" * 20))
    end = time.monotonic() + 20

    def stop() -> bool:
        return (len(robot.received) == 120 and hosts.answered[-1]) or time.monotonic() > end

    relay(cast(Device, robot), hosts, stop=stop, notify=lambda text: None)
    # It was so before, and was not while the robot had something to answer.
    assert hosts.answered[0]
    assert not all(hosts.answered)
    assert hosts.answered[-1]
