"""Pictures of episodes: they show the current state."""

from typing import Any

import numpy as np
import pytest

from khep_twin import ConstantSpeed, Episode, EpisodeOptions, EpisodeSetup, Playpen
from khep_twin.envs.renderer import Renderer
from khep_twin.playpen import Block


def test_in_the_plane_a_scene_has_the_robot_and_the_objects_where_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames: list[Any] = []

    class Camera:
        def __init__(self, model: Any, height: int, width: int) -> None:
            self.render, self.close = (lambda: np.zeros((height, width, 3), np.uint8)), (lambda: None)

        def update_scene(self, data: Any, camera: Any) -> None:
            frames.append([data.body(name).xpos.copy() for name in ("khepera0/base", "block0")])

    monkeypatch.setattr("mujoco.Renderer", Camera)
    block = Block(x_mm=300, y_mm=250, length_mm=40, width_mm=40, height_mm=40, movable=True)
    robot = Playpen.load("default").robots[0].model_copy(update={"x_mm": 220.0, "y_mm": 250.0})
    update = {"blocks": (block,), "robots": (robot.model_copy(update={"heading_deg": 0.0}),)}
    setup = EpisodeSetup(Playpen.load("default").model_copy(update=update), planar=True)
    episode, renderer = Episode(setup, ConstantSpeed(8, 8), compiled=False), Renderer("scene")
    for _ in range(2):
        episode.begin(1)
        episode.run(1.0)
        renderer.picture(episode)
    (x, y, _), ((object_x, _, _),) = episode.pose, episode.objects
    assert object_x > 0.31
    (base, pushed), again = frames
    assert (base[0], base[1], pushed[0]) == pytest.approx((x, y, object_x))
    assert np.array_equal(again, [base, pushed])


def test_a_map_has_the_lamps_of_its_episode() -> None:
    episode = Episode(EpisodeSetup("light-seeking", planar=True), compiled=False)
    pictures: list[Any] = []
    renderer = Renderer("map")
    for lamps in (None, ()):
        episode.begin(1, EpisodeOptions(lamps=lamps))
        pictures.append(renderer.picture(episode))
    assert (pictures[0][:, :, 2] < pictures[1][:, :, 2]).mean() > 0.1  # glow is yellow
