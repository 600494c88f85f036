"""Exchanges from the bytes of a line: the reply to each command, on good and on bad lines."""

import numpy as np
import pytest

from khep_twin.log.exchanges import REPLY_TIMEOUT_NS, Dialogue, Exchange

MS = 1_000_000


def command_replies(*lines: tuple[float, str, bytes]) -> list[tuple[bytes, bytes | None]]:
    """Commands and replies of a dialogue of (time [ms], host or robot, bytes)."""
    return [(exchange.command, exchange.reply) for exchange in exchanges(*lines)]


def exchanges(*lines: tuple[float, str, bytes]) -> list[Exchange]:
    dialogue, completed = Dialogue(), []
    for time_ms, who, data in lines:
        completed += dialogue.feed(round(time_ms * MS), who == "host", data)
    return completed + dialogue.close()


def test_a_reply_belongs_to_its_command_with_both_times() -> None:
    (exchange,) = exchanges(
        (0, "host", b"H"), (1, "host", b"\n"), (9, "robot", b"h,1"), (12, "robot", b"2,-5\r\n")
    )
    assert exchange == Exchange(b"H", 1 * MS, b"h,12,-5", 12 * MS)
    assert (exchange.letter, exchange.values) == ("H", (12, -5))


@pytest.mark.parametrize("end", [b"\n", b"\r", b"\r\n"])
def test_any_line_end_and_empty_lines_will_do(end: bytes) -> None:
    assert command_replies((0, "host", b"N" + end + end + b"B" + end), (9, "robot", b"n,1\r\nb,2\r\n")) == [
        (b"N", b"n,1"),
        (b"B", b"b,2"),
    ]


def test_a_burst_of_commands_is_answered_in_order() -> None:
    burst = command_replies(
        (0, "host", b"E\nH\nE\n"), (9, "robot", b"e,1,1\r\nh,2,2\r\n"), (12, "robot", b"e,3,3\r\n")
    )
    assert burst == [(b"E", b"e,1,1"), (b"H", b"h,2,2"), (b"E", b"e,3,3")]


def test_a_command_whose_reply_is_lost_is_unanswered() -> None:
    assert command_replies((0, "host", b"E\nH\n"), (9, "robot", b"h,2,2\r\n")) == [
        (b"E", None),
        (b"H", b"h,2,2"),
    ]


def test_a_host_that_asks_again_gets_the_reply_to_its_last_question() -> None:
    again = exchanges((0, "host", b"N\n"), (500, "host", b"N\n"), (540, "robot", b"n,1\r\n"))
    assert [(exchange.sent_ns, exchange.reply) for exchange in again] == [(0, None), (500 * MS, b"n,1")]


def test_a_late_reply_to_the_only_command_is_its_reply() -> None:
    assert command_replies((0, "host", b"N\n"), (600, "robot", b"n,1\r\n")) == [(b"N", b"n,1")]


def test_late_replies_to_a_burst_stay_in_order() -> None:
    late = exchanges((0, "host", b"N\nN\n"), (150, "robot", b"n,1\r\n"), (190, "robot", b"n,2\r\n"))
    assert [exchange.reply for exchange in late] == [b"n,1", b"n,2"]


def test_a_command_that_nothing_answers_is_given_up_after_a_while() -> None:
    dialogue = Dialogue()
    assert dialogue.feed(0, True, b"N\n") == []
    assert dialogue.expire(REPLY_TIMEOUT_NS) == []
    assert dialogue.expire(REPLY_TIMEOUT_NS + 1) == [Exchange(b"N", 0, None, REPLY_TIMEOUT_NS + 1)]


def test_a_wrong_letter_is_still_the_reply_to_the_command() -> None:
    wrong = command_replies(
        (0, "host", b"O\n"), (40, "robot", b"n,1\r\n"), (41, "host", b"E\n"), (50, "robot", b"e,1,1\r\n")
    )
    assert wrong == [(b"O", b"n,1"), (b"E", b"e,1,1")]


def test_an_echo_is_a_line_that_nobody_asked_for() -> None:
    assert command_replies((0, "host", b"N\n"), (3, "robot", b"N\r\n"), (40, "robot", b"n,1\r\n")) == [
        (b"", b"N"),
        (b"N", b"n,1"),
    ]


def test_an_error_answers_the_oldest_command() -> None:
    errors = command_replies(
        (0, "host", b"D,5\nhello\nN\n"), (9, "robot", b"z,Protocol error\r\nCommand not found\r\nn,1\r\n")
    )
    assert errors == [(b"D,5", b"z,Protocol error"), (b"hello", b"Command not found"), (b"N", b"n,1")]


def test_a_restart_is_answered_by_its_banner_and_the_next_command_by_its_reply() -> None:
    banner = b"ROM of minirobot KHEPERA\r\nK-Team S.A.\r\n"
    pairs = exchanges((0, "host", b"restart\nB\n"), (70, "robot", banner), (80, "robot", b"b,5.02,5.01\r\n"))
    assert [(exchange.command, exchange.reply, exchange.output_of) for exchange in pairs] == [
        (b"restart", b"ROM of minirobot KHEPERA", b""),
        (b"", b"K-Team S.A.", b"restart"),
        (b"B", b"b,5.02,5.01", b""),
    ]


def test_a_banner_in_between_is_no_reply() -> None:
    banner = b"ROM of minirobot KHEPERA\r\nK-Team S.A.\r\n"
    pairs = command_replies((0, "host", b"N\n"), (70, "robot", banner), (110, "robot", b"n,1\r\n"))
    assert pairs == [(b"", b"ROM of minirobot KHEPERA"), (b"", b"K-Team S.A."), (b"N", b"n,1")]


def test_a_host_that_leaves_abandons_its_commands_and_its_unfinished_line() -> None:
    dialogue = Dialogue()
    dialogue.feed(0, True, b"N\nD,5")
    dialogue.disconnect()
    pairs = dialogue.feed(9 * MS, True, b"B\n") + dialogue.feed(60 * MS, False, b"b,5.02,5.01\r\n")
    assert [(exchange.command, exchange.reply, exchange.abandoned) for exchange in pairs] == [
        (b"N", None, True),
        (b"B", b"b,5.02,5.01", False),
    ]


def test_values_are_those_of_a_reply_of_the_right_letter() -> None:
    wrong = exchanges((0, "host", b"N\n"), (40, "robot", b"n,1,x\r\n"))
    assert wrong[0].reply == b"n,1,x"
    assert wrong[0].values is None


def test_no_bytes_break_it_and_none_is_told_twice() -> None:
    rng = np.random.default_rng(7)
    words = [b"N\n", b"n,1,2\r\n", b"restart\n", b"ROM of minirobot\r\n", b"z,x\r\n", b"\xff", b"D,5", b"\r"]
    for _ in range(200):
        dialogue, completed, time_ns, host_bytes, robot_bytes = (
            Dialogue(int(rng.integers(2)) * MS),
            [],
            0,
            b"\n",
            b"\n",
        )
        for _ in range(60):
            time_ns += int(rng.exponential(40 * MS))
            to_robot, data = bool(rng.integers(2)), words[rng.integers(len(words))]
            host_bytes, robot_bytes = (
                (host_bytes + data, robot_bytes) if to_robot else (host_bytes, robot_bytes + data)
            )
            completed += dialogue.feed(time_ns, to_robot, data)
        completed += dialogue.close()
        commands, replies = (
            [line for line in text.replace(b"\r", b"\n").split(b"\n")[:-1] if line]
            for text in (host_bytes, robot_bytes)
        )
        assert sorted(exchange.command for exchange in completed if exchange.command) == sorted(commands)
        assert sorted(exchange.reply for exchange in completed if exchange.reply is not None) == sorted(
            replies
        )
