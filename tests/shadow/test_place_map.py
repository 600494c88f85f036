"""Map of a robot's readings at places of a playpen."""

import math

import numpy as np
import pytest
from twins import ALL, AT_THE_CRATE, metric, planes_at, readings, setup_of

from khep_twin.shadow.place_map import PlaceMap, Sighting


def test_places_are_drawn_by_what_was_seen_and_by_the_way_between() -> None:
    places, rng = PlaceMap(setup_of("workshop")), np.random.default_rng(0)
    turned = (*AT_THE_CRATE[:2], AT_THE_CRATE[2] + 40)
    sights = [
        Sighting((0, 0, 0), readings(planes_at(AT_THE_CRATE))),
        Sighting((0, 0, math.radians(40)), readings(planes_at(turned))),
    ]
    poses, logs = places.draw(4000, sights, ALL, rng)
    x, y, heading = metric(AT_THE_CRATE)
    near = np.hypot(poses[:, 0] - x, poses[:, 1] - y) < 0.03
    near &= np.abs((poses[:, 2] - heading + math.pi) % math.tau - math.pi) < math.radians(20)
    evenly, _ = places.draw(4000, [], ALL, rng)
    # Of those that are drawn evenly, every ninth there has such a heading.
    assert near.mean() > 4 * np.mean(np.hypot(evenly[:, 0] - x, evenly[:, 1] - y) < 0.03) / 9
    # By their weights they are as if drawn evenly.
    weights = np.exp(logs)
    assert weights.mean() == pytest.approx(1, abs=0.1)
    assert np.average(poses[:, 0], weights=weights) == pytest.approx(evenly[:, 0].mean(), abs=0.03)


def test_there_is_room_at_all_places() -> None:
    places = PlaceMap(setup_of("workshop"))
    planes = planes_at(*[AT_THE_CRATE] * 200)
    some = places.poses[:: len(places.poses) // 199][:200]
    assert len(some) == 200
    assert planes.are_clear(some).all()
