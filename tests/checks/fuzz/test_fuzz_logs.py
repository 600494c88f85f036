"""A share of fuzz-logs: a changed log ends in a result or in one line."""

import random
from pathlib import Path

import pytest

from checks.fuzz.libfuzzer import run_libfuzzer
from checks.fuzz.logs import KHEPERA4, STEP, base, check, cooked, seeds
from khep_twin.log.reader import read_log, read_series

SHARE = 2_000


@pytest.mark.long
def test_a_share_of_the_fuzzing_finds_nothing(tmp_path: Path) -> None:
    run_libfuzzer("fuzz-logs", SHARE, tmp_path)


def test_random_changes_end_in_a_result_or_a_line() -> None:
    rng = random.Random(1)
    for _ in range(150):
        check(bytes([rng.randrange(256)]) + rng.randbytes(STEP * rng.randrange(1, 7)))


def test_the_seeds_do_not_fail(tmp_path: Path) -> None:
    seeds(tmp_path)
    inputs = [path.read_bytes() for path in tmp_path.iterdir()]
    assert len(inputs) > 80
    for data in inputs:
        check(data)


def test_the_log_to_begin_with_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "base.mcap"
    path.write_bytes(cooked(b""))
    assert len(base()) > 5
    assert len(read_log(path).robots["khepera0"].proximity) == 2
    assert read_series(path).lines["/events"][0].text == "x"


def test_the_log_of_a_khepera_iv_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "base.mcap"
    path.write_bytes(cooked(bytes([KHEPERA4])))
    assert "/khepera0/battery" in read_series(path).series
