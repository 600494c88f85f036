"""Polls of a relay: asked in silence alone, and kept from the host."""

import pytest

from khep_twin.ports import idle_polls
from khep_twin.ports.idle_polls import HOLD_S, IDLE_S, IdlePolls

BAUD = 9600


class Clock:
    """A clock that stands."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(idle_polls, "time", clock)
    return clock


def asking(clock: Clock) -> tuple[IdlePolls, bytes]:
    """Polls that have just asked, and their question."""
    polls = IdlePolls()
    clock.now += IDLE_S
    return polls, polls.due(BAUD)


def test_it_asks_after_a_silence_one_question_at_a_time(clock: Clock) -> None:
    polls = IdlePolls()
    assert polls.due(BAUD) == b""
    clock.now += IDLE_S
    assert polls.due(BAUD) == b"N\n"
    clock.now += 0.2
    assert polls.due(BAUD) == b""
    assert polls.passed(b"n,1,2,3,4,5,6,7,8\r\n") == b""
    assert polls.due(BAUD) == b"H\n"


def test_a_line_too_slow_for_the_longest_wait_is_not_asked(clock: Clock) -> None:
    polls = IdlePolls()
    clock.now += IDLE_S
    assert polls.due(4800) == b""


def test_a_host_that_speaks_puts_the_next_question_off(clock: Clock) -> None:
    polls = IdlePolls()
    clock.now += IDLE_S
    assert polls.hold_s(b"D,1,1\n") == 0
    assert polls.due(BAUD) == b""
    assert polls.passed(b"d\r\n") == b"d\r\n"
    clock.now += IDLE_S
    assert polls.due(BAUD) == b"N\n"


@pytest.mark.parametrize("size", [1, 2, 7, 100])
def test_replies_to_polls_are_kept_from_the_host_in_any_pieces(clock: Clock, size: int) -> None:
    polls, _ = asking(clock)
    said = b"n,1,2,3,4,5,6,7,8\r\nd\r\nn,8,7,6,5,4,3,2,1\r\n"
    passed = b"".join(polls.passed(said[begin : begin + size]) for begin in range(0, len(said), size))
    assert passed == b"d\r\nn,8,7,6,5,4,3,2,1\r\n"


def test_a_line_end_in_two_halves_keeps_the_next_reply_from_the_host_too(clock: Clock) -> None:
    polls, _ = asking(clock)
    assert polls.passed(b"n,1,2,3,4,5,6,7,8\r") == b""
    clock.now += IDLE_S
    assert polls.due(BAUD) == b"H\n"
    assert polls.passed(b"\nh,1,2\r\n") == b""
    assert polls.passed(b"d\r\n") == b"d\r\n"


def test_a_hosts_bytes_wait_for_the_reply_and_no_longer_than_they_may(clock: Clock) -> None:
    polls, _ = asking(clock)
    clock.now += 0.01
    assert polls.hold_s(b"D,1,1\n") == pytest.approx(HOLD_S)
    clock.now += 0.02
    assert polls.hold_s(b"D,1,1\n") == pytest.approx(HOLD_S - 0.02)
    assert polls.passed(b"n,1,2,3,4,5,6,7,8\r\n") == b""
    assert polls.hold_s(b"D,1,1\n") == 0
    polls, _ = asking(clock)
    assert polls.hold_s(b"D,1,1\n") == pytest.approx(HOLD_S)
    clock.now += HOLD_S
    assert polls.hold_s(b"D,1,1\n") == 0
    assert polls.passed(b"n,1,2,3,4,5,6,7,8\r\nd\r\n") == b"d\r\n"


def test_a_question_that_was_lost_takes_no_reply_from_the_host(clock: Clock) -> None:
    polls, _ = asking(clock)
    polls.hold_s(b"N\n")
    clock.now += HOLD_S
    assert polls.hold_s(b"N\n") == 0
    assert polls.passed(b"n,1,2,3,4,5,6,7,8\r\n") == b"n,1,2,3,4,5,6,7,8\r\n"


def test_banners_and_replies_that_lost_their_end_are_passed_on(clock: Clock) -> None:
    polls, _ = asking(clock)
    assert polls.passed(b"ROM of minirobot\r\n") == b"ROM of minirobot\r\n"
    assert polls.passed(b"n,1,2,3,4\rd\r\n") == b"d\r\n"
