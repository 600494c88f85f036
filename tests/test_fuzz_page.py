"""A share of `make fuzz-page`: requests to the designer's page end in answers, and strangers are refused."""

import random
from pathlib import Path

import pytest
from fuzz_page import check, check_answers, seeds
from fuzzing import run_libfuzzer
from page_recipes import BASES, HOST, ORIGIN, TOKEN, requests_of

SHARE = 2_000


def test_a_share_of_the_fuzzing_finds_nothing(tmp_path: Path) -> None:
    run_libfuzzer("fuzz_page.py", SHARE, tmp_path)
