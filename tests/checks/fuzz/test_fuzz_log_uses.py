"""A share of fuzz-log-uses: viewing, repeating, branching and checking a changed log ends in one line."""

import random
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from checks.fuzz.libfuzzer import run_libfuzzer
from checks.fuzz.log_mutations import Record
from checks.fuzz.log_uses import IN_TEXT, USES, WORDS, changed_text, check, log_of, records
from checks.fuzz.logs import KHEPERA4, STEP, error_text

SHARE = 1_500


@pytest.mark.long
def test_a_share_of_the_fuzzing_finds_nothing(tmp_path: Path) -> None:
    run_libfuzzer("fuzz-log-uses", SHARE, tmp_path)


def test_random_changes_end_in_a_result_or_a_line() -> None:
    rng = random.Random(1)
    for _ in range(50):
        check(bytes([rng.randrange(128)]) + rng.randbytes(STEP * rng.randrange(4)))


@pytest.mark.parametrize("use", USES)
def test_each_use_of_the_log_to_begin_with_has_a_result(use: object, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(log_of(bytes([USES.index(use)])))  # pyright: ignore
    assert error_text(use, path) == ""  # pyright: ignore


@pytest.mark.parametrize("use", USES)
def test_each_use_of_a_log_of_a_khepera_iv_has_a_result_or_refuses_the_model(
    use: object, tmp_path: Path
) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(log_of(bytes([KHEPERA4 | USES.index(use)])))  # pyright: ignore
    message = error_text(use, path)  # pyright: ignore
    assert not message or "model = 'khepera4'; expected a Khepera or Khepera II" in message


@pytest.mark.parametrize("use", range(len(USES)))
def test_several_problems_of_an_attachment_are_one_line(use: int) -> None:
    check(bytes([IN_TEXT | KHEPERA4 | use, 0, 0, 0, 0, 0, 0]))


def test_a_word_of_an_attachment_is_replaced() -> None:
    def text(log: tuple[Record, ...]) -> bytes:
        return next(record.content for record in log if record.opcode == Opcode.ATTACHMENT)

    changed = changed_text(records()[1], 1, WORDS[0])
    assert b"version = 1\n" in text(records())
    assert b"version = 0\n" in text((changed,))
    step = bytes([IN_TEXT, 0, 1, 0, 0, 0, 0])
    assert log_of(step) != log_of(b"\0")
