"""Polls of a relay: sent only in silence, and removed from the bytes for the host."""

import pytest

from khep_twin.ports import idle_polls
from khep_twin.ports.idle_polls import HOLD_S, IDLE_S, IdlePolls

BAUD = 9600


class Clock:
    """A clock that is set by the test."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(idle_polls, "time", clock)
    return clock


def asking(clock: Clock) -> tuple[IdlePolls, bytes]:
    """Return polls that have just sent a command, and the command."""
    polls = IdlePolls([b"N\n", b"H\n"])
    clock.now += IDLE_S
    return polls, polls.next_command(BAUD)


def test_it_asks_after_a_silence_one_question_at_a_time(clock: Clock) -> None:
    polls = IdlePolls([b"N\n", b"H\n"])
    assert polls.next_command(BAUD) == b""
    clock.now += IDLE_S
    assert polls.next_command(BAUD) == b"N\n"
    clock.now += 0.2
    assert polls.next_command(BAUD) == b""
    assert polls.filter_replies(b"n,1,2,3,4,5,6,7,8\r\n") == b""
    assert polls.next_command(BAUD) == b"H\n"


def test_the_requests_of_another_model_are_sent_in_turn(clock: Clock) -> None:
    polls, commands = IdlePolls([b"N\n", b"G\n", b"R\n"]), list[bytes]()
    for _ in range(4):
        clock.now += IDLE_S
        commands.append(polls.next_command(BAUD))
        assert polls.filter_replies(commands[-1][:1].lower() + b",1,2\r\n") == b""
    assert commands == [b"N\n", b"G\n", b"R\n", b"N\n"]


def test_a_line_too_slow_for_the_longest_wait_is_not_asked(clock: Clock) -> None:
    polls = IdlePolls([b"N\n", b"H\n"])
    clock.now += IDLE_S
    assert polls.next_command(4800) == b""


def test_a_host_that_speaks_puts_the_next_question_off(clock: Clock) -> None:
    polls = IdlePolls([b"N\n", b"H\n"])
    clock.now += IDLE_S
    assert polls.remaining_hold_s(b"D,1,1\n") == 0
    assert polls.next_command(BAUD) == b""
    assert polls.filter_replies(b"d\r\n") == b"d\r\n"
    clock.now += IDLE_S
    assert polls.next_command(BAUD) == b"N\n"


@pytest.mark.parametrize("size", [1, 2, 7, 100])
def test_replies_to_polls_are_kept_from_the_host_in_any_pieces(clock: Clock, size: int) -> None:
    polls, _ = asking(clock)
    replies = b"n,1,2,3,4,5,6,7,8\r\nd\r\nn,8,7,6,5,4,3,2,1\r\n"
    output = b"".join(
        polls.filter_replies(replies[begin : begin + size]) for begin in range(0, len(replies), size)
    )
    assert output == b"d\r\nn,8,7,6,5,4,3,2,1\r\n"


def test_a_line_end_in_two_halves_keeps_the_next_reply_from_the_host_too(clock: Clock) -> None:
    polls, _ = asking(clock)
    assert polls.filter_replies(b"n,1,2,3,4,5,6,7,8\r") == b""
    clock.now += IDLE_S
    assert polls.next_command(BAUD) == b"H\n"
    assert polls.filter_replies(b"\nh,1,2\r\n") == b""
    assert polls.filter_replies(b"d\r\n") == b"d\r\n"


def test_a_hosts_bytes_wait_for_the_reply_and_no_longer_than_they_may(clock: Clock) -> None:
    polls, _ = asking(clock)
    clock.now += 0.01
    assert polls.remaining_hold_s(b"D,1,1\n") == pytest.approx(HOLD_S)
    clock.now += 0.02
    assert polls.remaining_hold_s(b"D,1,1\n") == pytest.approx(HOLD_S - 0.02)
    assert polls.filter_replies(b"n,1,2,3,4,5,6,7,8\r\n") == b""
    assert polls.remaining_hold_s(b"D,1,1\n") == 0
    polls, _ = asking(clock)
    assert polls.remaining_hold_s(b"D,1,1\n") == pytest.approx(HOLD_S)
    clock.now += HOLD_S
    assert polls.remaining_hold_s(b"D,1,1\n") == 0
    assert polls.filter_replies(b"n,1,2,3,4,5,6,7,8\r\nd\r\n") == b"d\r\n"


def test_a_question_that_was_lost_takes_no_reply_from_the_host(clock: Clock) -> None:
    polls, _ = asking(clock)
    polls.remaining_hold_s(b"N\n")
    clock.now += HOLD_S
    assert polls.remaining_hold_s(b"N\n") == 0
    assert polls.filter_replies(b"n,1,2,3,4,5,6,7,8\r\n") == b"n,1,2,3,4,5,6,7,8\r\n"


def test_banners_and_replies_that_lost_their_end_are_passed_on(clock: Clock) -> None:
    polls, _ = asking(clock)
    assert polls.filter_replies(b"ROM of minirobot\r\n") == b"ROM of minirobot\r\n"
    assert polls.filter_replies(b"n,1,2,3,4\rd\r\n") == b"d\r\n"
