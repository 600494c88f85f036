"""A share of fuzz-board: arbitrary bytes never crash, hang or confuse the board."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checks.fuzz.board import check, seeds
from checks.fuzz.libfuzzer import run_libfuzzer
from khep_twin.firmware import Firmware

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
