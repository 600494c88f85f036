"""Streams of chance."""

import subprocess
import sys

import pytest

from khep_twin.randomness import SEED_LIMIT, stream


def test_the_same_seed_and_names_give_the_same_draws() -> None:
    first, second = (stream(1, "robot", 0, "proximity").random(5).tolist() for _ in range(2))
    assert first == second


@pytest.mark.parametrize("other", [(2, "a", 0), (1, "b", 0), (1, "a", 1), (1, "a")])
def test_another_seed_or_name_gives_other_draws(other: tuple[int, ...]) -> None:
    seed, *names = other
    assert stream(1, "a", 0).random() != stream(seed, *names).random()


def test_another_process_with_another_hash_seed_draws_the_same() -> None:
    program = "from khep_twin.randomness import stream; print(stream(7, 'x').random())"
    outputs = {
        subprocess.run(
            [sys.executable, "-c", program], env={"PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert outputs == {f"{stream(7, 'x').random()}\n".encode()}


@pytest.mark.parametrize("seed", [-1, SEED_LIMIT])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(ValueError, match=rf"seed = {seed}; expected an integer from 0 to 2\*\*63-1"):
        stream(seed, "x")
    with pytest.raises(ValueError, match="needs a name"):
        stream(0)
