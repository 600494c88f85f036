"""The likelihood of replies to O, and the learning of sensor parameters from them."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from twins import planes_at

from khep_twin.shadow.light_model import LightModel

Floats = NDArray[np.float64]
POSE = (110.0, 130.0, -135.0)
"""Pose that faces the lamp in the open, 40 mm from it."""


def light_at(pose: tuple[float, float, float], model: LightModel) -> Floats:
    """The light at a pose, with its slope."""
    planes = planes_at(pose, name="two-lamps")
    planes.advance(1)
    straight, turned = (planes.lamplight(0.0, turns).sum(axis=2) for turns in model.turns)
    return model.light(straight, turned)


def model_of() -> LightModel:
    return LightModel(planes_at(POSE, name="two-lamps"))


def test_light_that_explains_a_reply_is_more_likely_than_none() -> None:
    model = model_of()
    light = light_at((150, 170, -135), model)
    lights = np.stack([light, np.zeros_like(light)], axis=3)
    readings = np.rint(model.expected(light[0, 0])).astype(np.int64)
    ((bright, dark),) = model.log_likelihoods(readings, lights, np.ones(8)).tolist()
    assert bright > dark + 10
    ((bright, dark),) = model.log_likelihoods(np.full(8, 485), lights, np.ones(8)).tolist()
    assert dark > bright + 5


def test_a_place_that_is_vague_tells_less() -> None:
    model = model_of()
    light = light_at((150, 170, -135), model)[..., None]
    off = np.full(8, 485)
    exact, vague = (
        model.log_likelihoods(off, light, np.ones(8), variance * light[0] ** 2).item()
        for variance in (0.0, 1.0)
    )
    assert vague > exact + 5


def test_a_turned_and_a_weak_sensor_are_learned() -> None:
    model = model_of()
    turn = math.radians(5)
    for angle in range(0, 360, 5):
        pose = (200.0, 200.0, float(angle))
        planes = planes_at(pose, name="two-lamps")
        planes.advance(1)
        turned_light = planes.lamplight(0.0, np.where(np.arange(8) == 2, turn, 0.0)).sum(axis=2)[0]
        turned_light[4] *= 0.9
        readings = np.rint(model.expected(turned_light)).astype(np.int64)
        model.learn(readings, light_at(pose, model), 1.0, 1.0)
    turns = np.degrees(model.traits[:, 1])
    assert turns[2] == pytest.approx(5, abs=1)
    assert np.abs(np.delete(turns, 2)).max() < 1.5
    assert model.traits[4, 0] == pytest.approx(math.log(0.9), abs=0.04)


def test_where_the_pose_is_vague_less_is_new() -> None:
    model = model_of()
    near, far = (light_at((x, 130.0, -135.0), model) for x in (120.0, 160.0))
    assert model.novelty(near) == pytest.approx(1)
    assert model.novelty(np.concatenate([near, far], axis=1)).min() < 0.5
