"""A share of fuzz-board: arbitrary bytes never crash, hang or confuse the board."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checks.fuzz.board import KHEPERA4, check, seeds
from checks.fuzz.libfuzzer import run_libfuzzer
from khep_twin.firmware import Firmware
from khep_twin.robots.khepera4.server import Kh4Server

SHARE = 2_000


def test_a_share_of_the_fuzzing_finds_nothing(tmp_path: Path) -> None:
    run_libfuzzer("fuzz-board", SHARE, tmp_path)


@settings(max_examples=200, derandomize=True, database=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_answered(data: bytes) -> None:
    check(data)


def test_the_seeds_are_what_the_transcripts_say(tmp_path: Path) -> None:
    seeds(tmp_path)
    reports = [path.read_bytes() for path in tmp_path.iterdir()]
    assert len(reports) > 80
    for data in reports:
        check(data)


@pytest.mark.parametrize(
    "wrong", [b"", b"b,5.02,5.01\n", b"\xe9\r\n", b"\r\nb,5.02,5.01\r\n", b"b,5.02,5.01\r\nx"]
)
def test_a_board_that_answers_wrongly_is_noticed(monkeypatch: pytest.MonkeyPatch, wrong: bytes) -> None:
    monkeypatch.setattr(Firmware, "receive", lambda self, data: wrong if data else b"")
    with pytest.raises((AssertionError, UnicodeDecodeError)):
        check(b"\x00B\n")


@settings(max_examples=100, derandomize=True, database=None)
@given(st.binary(max_size=100))
def test_any_bytes_are_answered_by_a_khepera_iv(data: bytes) -> None:
    check(bytes([KHEPERA4]) + data)


@pytest.mark.parametrize("wrong", [b"", b"b,B,0\n", b"\xe9\r\n", b"b,B,0\r\nx", b"b,C,0\r\n"])
def test_a_khepera_iv_that_answers_wrongly_is_noticed(monkeypatch: pytest.MonkeyPatch, wrong: bytes) -> None:
    monkeypatch.setattr(Kh4Server, "receive", lambda self, data: wrong if data else b"")
    with pytest.raises(AssertionError):
        check(bytes([KHEPERA4]) + b"B\n")
