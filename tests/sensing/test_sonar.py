"""Ultrasonic sensors of any model: places, echoes of one burst, and readings."""

import math
from typing import Any

import pytest

from khep_twin.playpen import Playpen
from khep_twin.playpen.parts import Block
from khep_twin.robots.body import SonarRing
from khep_twin.sensing.noise import plain_tables
from khep_twin.sensing.scene import Beams
from khep_twin.sensing.sonar import Sonar, cast, next_echo, reading_of
from khep_twin.world import World

RING = SonarRing(
    *(("left", "front"), (90, 0), 0.0, 0.04, (0, 999)),
    positions=((0.0048, 0.0596), (0.0564, 0.0)),
    **{"reach": 4.0, "nearest": 0.2, "exponent": 3.47},
)
LEFT, FRONT = 0, 1
SONAR = Sonar.of(RING, noise_cm=0.4)
SILENT = plain_tables(0.0)


def blocks(*places: tuple[float, float, float]) -> Any:
    """Return a scene with a robot at (0.5, 1.0) m towards +x, and blocks: near face, y, and width [mm]."""
    parts = tuple(
        Block(x_mm=x + 10, y_mm=y, angle_deg=0, length_mm=20, width_mm=width, height_mm=200)
        for x, y, width in places
    )
    world = World(Playpen.load("arena4-line").model_copy(update={"patches": (), "blocks": parts}))
    world.reset(noise=False, starts=[(500, 1000, 0)])
    return world.simulation.plain


def echoes(simulated: Any, sensor: int) -> list[tuple[float, float]]:
    """Return distance [m] and loudness of all echoes."""
    robot, beams = simulated.groups[0][0], Beams.of(len(SONAR.gains))
    first = cast(simulated.scene, robot.sensors, robot.pose, SONAR, beams, sensor, 0)
    distance, loudness = next_echo(SONAR, beams, -1.0)
    assert distance == first
    echoes: list[tuple[float, float]] = []
    while math.isfinite(distance):
        echoes.append((distance, loudness))
        distance, loudness = next_echo(SONAR, beams, distance)
    return echoes


def test_a_post_before_a_wall_and_the_wall_are_two_echoes_of_one_burst() -> None:
    (post, post_loudness), (wall, wall_loudness) = echoes(blocks((1056, 1000, 60), (1556, 1000, 900)), FRONT)
    assert post == pytest.approx(0.4996, abs=1e-3)
    assert wall == pytest.approx(0.9996, abs=0.01)
    # The middle of the wall is behind the post, and its edges are met at an angle.
    assert post_loudness == pytest.approx(4 / post + 0.03 * (4 / post) ** 2, rel=0.01)
    assert 1 < wall_loudness < 4 / wall


def test_all_rays_of_a_wall_are_one_echo() -> None:
    ((distance, _),) = echoes(blocks((1556, 1000, 2000)), FRONT)
    assert distance == pytest.approx(0.9996, abs=1e-3)


def test_sensors_measure_from_their_places_and_by_their_range() -> None:
    simulated = blocks()
    distances = [echoes(simulated, sensor)[0][0] for sensor in (LEFT, FRONT)]
    key: Any = simulated.groups[0][0].noise
    # The walls of the arena are 1 m to the left and 1.5 m ahead of the centre.
    readings = [reading_of(SONAR, distance, SILENT, key, 0) for distance in (*distances, 0.19, 4.01)]
    assert readings == [94, 144, 0, 999]


def test_places_without_positions_lie_on_a_circle() -> None:
    circle = SonarRing(("left", "front"), (90, 0), 0.06, 0.04, (0, 999))
    assert circle.places[FRONT] == (0.06, 0.0, 0.04, 0.0)
    assert RING.places == [(0.0048, 0.0596, 0.04, math.radians(90)), (0.0564, 0.0, 0.04, 0.0)]
