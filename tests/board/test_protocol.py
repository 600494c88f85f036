"""The grammar: lines, commands, replies."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.board.protocol import (
    COMMAND_NOT_FOUND,
    LINE_LIMIT,
    PROTOCOL_ERROR,
    Command,
    LineReader,
    Malformed,
    Tool,
    TurretMessage,
    refusal,
    reply,
)
from khep_twin.firmware import ARGUMENT_COUNTS, parse


@pytest.mark.parametrize(
    ("stream", "lines"),
    [
        (b"N\n", [b"N"]),
        (b"N\r", [b"N"]),
        (b"N\r\n", [b"N"]),
        (b"\r\n\n\rN\n\n", [b"N"]),
        (b"H\nE\nN\n", [b"H", b"E", b"N"]),
        (b"D,1", []),
        (b" \n", [b" "]),
        (b"\xff\x00\n", [b"\xff\x00"]),
    ],
)
def test_lines_end_in_cr_lf_or_both_and_empty_ones_vanish(stream: bytes, lines: list[bytes]) -> None:
    assert list(LineReader().feed(stream)) == lines


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=8))
def test_the_chunks_that_bytes_come_in_do_not_matter(stream: bytes, cuts: list[int]) -> None:
    reader = LineReader()
    edges = [0, *sorted(cuts), len(stream)]
    pieces = [stream[a:b] for a, b in itertools.pairwise(edges)]
    assert [line for piece in pieces for line in reader.feed(piece)] == list(LineReader().feed(stream))


def test_a_reader_that_is_cleared_while_a_line_is_handled_goes_on_with_the_bytes_after_it() -> None:
    reader = LineReader()
    assert not list(reader.feed(b"res"))
    lines: list[bytes] = []
    for line in reader.feed(b"tart\nN\nD,1"):
        lines.append(line)
        reader.clear()
    assert lines == [b"restart", b"N"]
    assert list(reader.feed(b",2\n")) == [b"D,1,2"]


def test_of_a_line_that_is_too_long_only_the_beginning_is_kept() -> None:
    reader = LineReader()
    (line,) = reader.feed(b"D," + b"1" * 10_000 + b"\n")
    assert len(line) == LINE_LIMIT + 1
    assert parse(line) == Malformed(PROTOCOL_ERROR)
    (line,) = reader.feed(b"x" * 10_000 + b"\n")
    assert parse(line) == Malformed(COMMAND_NOT_FOUND)
    assert list(reader.feed(b"N\n")) == [b"N"]


@pytest.mark.parametrize(
    ("line", "request_"),
    [
        (b"B", Command("B")),
        (b"D,5,-5", Command("D", (5, -5))),
        (b"D,+5,0005", Command("D", (5, 5))),
        (b"D, 5, 5", Command("D", (5, 5))),
        (b"  D,5,5  ", Command("D", (5, 5))),
        (b"J,20,64,20,64", Command("J", (20, 64, 20, 64))),
        (b"T,1,D,0", TurretMessage(1, b"D,0")),
        (b"restart", Tool(b"restart")),
        (b"run demo", Tool(b"run", (b"demo",))),
        (b"k-team", Tool(b"k-team")),
    ],
)
def test_well_formed_lines(line: bytes, request_: object) -> None:
    assert parse(line) == request_


@pytest.mark.parametrize(
    "line", [b" ", b"d,5,5", b"Q", b"M", b"S", b"NN", b"N1", b"\xff", b"D5,5", b"5", b",", b"Restart"]
)
def test_unknown_words_are_not_found(line: bytes) -> None:
    request = parse(line)
    # A lower-case letter is a word that no tool has; who carries out tools says so.
    assert request == Malformed(COMMAND_NOT_FOUND) or isinstance(request, Tool)


@pytest.mark.parametrize(
    "line",
    [
        b"D",
        b"D,5",
        b"D,5,5,5",
        b"D,5,",
        b"D,5,x",
        b"D,5,1_0",
        b"D,5,0x1",
        b"D,5,1.0",
        b"D,5,--1",
        b"D,5,5 5",
        b"D,5,12345678901",
        "D,5,٣".encode(),
        b"N,1",
        b"J,20,64",
        b"T",
        b"T,1",
        b"T,x,B",
        b"T,1,",
        b"T,,B",
    ],
)
def test_wrong_or_missing_parameters_are_a_protocol_error(line: bytes) -> None:
    assert parse(line) == Malformed(PROTOCOL_ERROR)


def test_there_are_eighteen_commands() -> None:
    assert sorted([*ARGUMENT_COUNTS, "T"]) == list("ABCDEFGHIJKLNOPRTW")


def test_replies_are_lower_case_and_end_in_cr_lf_without_blanks() -> None:
    assert reply("H", 12, -5) == b"h,12,-5\r\n"
    assert reply("B", "5.02", "5.01") == b"b,5.02,5.01\r\n"
    assert reply("D") == b"d\r\n"
    assert refusal("Protocol error") == PROTOCOL_ERROR == b"z,Protocol error\r\n"


@given(st.binary(max_size=200))
def test_any_bytes_are_parsed_into_something(line: bytes) -> None:
    assert isinstance(parse(line), Command | TurretMessage | Tool | Malformed)
