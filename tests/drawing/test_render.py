"""Playpens as seen by a camera, if OpenGL is available."""

from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from khep_twin import playpen as playpens
from khep_twin.drawing import render as render_module
from khep_twin.drawing.render import HEIGHT, WIDTH, render
from khep_twin.errors import KhepTwinError

ARENA = 'version = 1\nname = "seen"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'


@cache
def render_pixels(text: str) -> NDArray[np.int64]:
    """Return the pixels of an arena with these tables (HEIGHT, WIDTH, 3)."""
    try:
        picture = render(playpens.parse(ARENA + text, "seen"), Path("seen.png"))
    except KhepTwinError as error:
        if "no OpenGL" in str(error):
            pytest.skip(str(error))
        raise
    return np.asarray(Image.open(BytesIO(picture)).convert("RGB"), np.int64)


def test_blocks_differ_from_the_floor_and_their_tops_from_their_sides() -> None:
    # A square in the middle; the picture's centre, away from the lines, is on its top or on the floor.
    centre = HEIGHT // 2 - 20, WIDTH // 2 + 20
    floor = render_pixels("")
    for surface in ("white", "grey"):
        block = "[[block]]\nx_mm = 300\ny_mm = 250\nlength_mm = 200\nwidth_mm = 200\nheight_mm = 50\n"
        pixels = render_pixels(f'{block}surface = "{surface}"\n')
        top = pixels[centre]
        assert np.abs(top - floor[centre]).max() > 25, surface
        column = pixels[:, centre[1]]
        side = column[np.flatnonzero(np.abs(column - top).max(axis=1) < 2)[-1] + 20]
        assert top.sum() > side.sum() + 15, surface


def test_the_floor_has_a_shadow_beside_a_block_and_lines() -> None:
    floor = render_pixels("")
    block = "[[block]]\nx_mm = 300\ny_mm = 250\nlength_mm = 50\nwidth_mm = 50\nheight_mm = 80\n"
    darker = (floor - render_pixels(block)).min(axis=2) > 30
    assert darker.sum() > 500
    inside = floor[HEIGHT // 2 - 100 : HEIGHT // 2 + 100, WIDTH // 2 - 200 : WIDTH // 2 + 200]
    colours = {tuple(colour) for colour in inside.reshape(-1, 3)}
    assert len(colours) > 1
    assert max(max(colour) for colour in colours) < 250


@pytest.mark.long
def test_where_a_library_does_not_render_the_next_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    floor = render_pixels("")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("khep_twin.drawing.render._libraries", lambda: ["glfw", "egl"])
    np.testing.assert_array_equal(render_pixels.__wrapped__(""), floor)
    monkeypatch.setattr("khep_twin.drawing.render._libraries", lambda: ["glfw"])
    with pytest.raises(KhepTwinError, match=r"there is no OpenGL to render with \(glfw: \w+\); expected"):
        render(playpens.parse(ARENA, "seen"), Path("seen.png"))


@pytest.mark.parametrize(
    ("platform", "display", "requested", "libraries"),
    [
        ("linux", "", "", ["egl", "osmesa"]),
        ("linux", ":0", "", ["glfw"]),
        ("darwin", "", "", ["glfw"]),
        ("win32", "", "", ["glfw"]),
        ("linux", ":0", "EGL", ["egl"]),
        ("darwin", "", "unknown", ["glfw"]),
    ],
)
def test_a_picture_is_drawn_by_the_library_of_the_system_or_the_requested_one(
    monkeypatch: pytest.MonkeyPatch, platform: str, display: str, requested: str, libraries: list[str]
) -> None:
    monkeypatch.setattr(render_module.sys, "platform", platform)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setenv("MUJOCO_GL", requested)
    assert render_module._libraries() == libraries
