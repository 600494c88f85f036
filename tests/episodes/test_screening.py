"""Screening: all in a plane, the best again in MuJoCo."""

import importlib.util

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Network
from khep_twin.episodes.screening import best_first, screen

COMPILED = importlib.util.find_spec("numba") is not None
NETWORK = Network()
GENES = np.random.default_rng(1).normal(size=(6, NETWORK.n_genes))
SCENE = playpen.load("looping-maze")


def test_the_elite_of_the_plane_is_ranked_anew_in_mujoco() -> None:
    found = screen(SCENE, NETWORK, GENES, range(2), 1.0, elite=3, compiled=COMPILED)
    assert sorted(found.ranked.tolist()) == list(range(6))
    assert (np.diff(found.planar[found.ranked]) <= 0).all()
    assert set(found.elite.tolist()) == set(found.ranked[:3].tolist())
    again = rollout(
        SCENE, NETWORK, [0, 1] * 3, 1.0, genes=np.repeat(GENES[found.elite], 2, axis=0), compiled=COMPILED
    )
    judged = again.metrics["obstacle_avoidance"].reshape(3, 2).mean(axis=1)
    assert found.judged.tolist() == judged.tolist() == sorted(judged.tolist(), reverse=True)


def test_what_is_no_number_comes_last() -> None:
    assert best_first(np.array([0.1, np.nan, 0.3, 0.1])).tolist() == [2, 0, 3, 1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"number": "speed"}, "expected one of obstacle_avoidance, "),
        ({"elite": 0}, "expected 1 or more"),
        ({"number": "homing"}, "without a home; expected home="),
        ({"starts": [(60, 250, 90)] * 2}, "2 starts for 1 seeds; expected 1"),
    ],
)
def test_a_mistake_is_an_error_of_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        screen(SCENE, NETWORK, GENES, [0], 1.0, **options)  # type: ignore[arg-type]
