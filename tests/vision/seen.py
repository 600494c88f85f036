"""Images of a K213 in a playpen of 600 x 500 mm, and the positions of objects in them."""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen as playpens
from khep_twin.board.k213 import PIXELS, K213Register
from khep_twin.sensing.line_image import WHITE, WHITE_GREY
from khep_twin.sensing.line_scene import HALF_FIELD
from khep_twin.world import World

EYE_MM = 12.0
"""Distance of the camera in front of the robot's centre [mm] (assets/k213.xml)."""

WHITE_SURFACE, BLACK_SURFACE = 0.8951, 0.0196
"""Relative luminance of the colours (244, 243, 238) and (38, 38, 42) in sRGB, by the standard's formula."""


def world(
    parts: str = "",
    *,
    arena: str = "",
    pose: str = "x_mm = 300\ny_mm = 250\nheading_deg = 0\n",
    noise=False,
    **options,
) -> World:
    text = f"""
version = 1
name = "seen"
[arena]
width_mm = 600
height_mm = 500
{arena}
{parts}
[[robot]]
{pose}
turrets = ["k213"]
"""
    return World(playpens.parse(text, "seen.toml"), noise=noise, **options)


def registers(world: World, robot: int = 0) -> NDArray[np.int64]:
    return next(iter(world.robots[robot].firmware.turrets.values())).registers


def image(world: World, robot: int = 0, scans: int = 1) -> NDArray[np.int64]:
    """Return the image of a later scan."""
    state = registers(world, robot)
    last_scan = state[K213Register.SCANS] + scans
    while state[K213Register.SCANS] < last_scan:
        world.advance_to(world.time_ns + 10_000_000)
    return state[PIXELS].copy()


def slopes(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return tangents to the left at positions in the image, in pixels from its left end."""
    return HALF_FIELD * (1 - places / 32)


def place(ahead_mm: float, left_mm: float) -> float:
    """Return the position of a point in the image, in pixels from its left end; distances from the camera."""
    return 32 * (1 - left_mm / ahead_mm / HALF_FIELD)


def greys(reflectance: float | NDArray[np.float64], light: float = 1.0) -> NDArray[np.float64]:
    """Return the greys of a uniform surface, in a multiple of the light for which the exposure is set."""
    cosine_square = 1 / (1 + slopes(np.arange(64) + 0.5) ** 2)
    return reflectance / WHITE * WHITE_GREY * light * cosine_square**2


def within_a_grey(pixels: NDArray[np.int64], expected: NDArray[np.float64]) -> bool:
    return bool((np.abs(pixels - np.minimum(expected, 255)) <= 1).all())


def luminance(rgb: tuple[int, int, int]) -> float:
    parts = [part / 255 for part in rgb]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return math.fsum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def block(x_mm: float, y_mm: float, width_mm: float, *, height_mm: float = 60, surface: str = "black") -> str:
    """Return a board of 10 mm across the line of sight."""
    size = f"length_mm = 10\nwidth_mm = {width_mm}\nheight_mm = {height_mm}\n"
    return f'[[block]]\nx_mm = {x_mm}\ny_mm = {y_mm}\n{size}surface = "{surface}"\n'


def cylinder(x_mm: float, y_mm: float, radius_mm: float) -> str:
    size = f"radius_mm = {radius_mm}\nheight_mm = 60\n"
    return f'[[cylinder]]\nx_mm = {x_mm}\ny_mm = {y_mm}\n{size}surface = "black"\n'


def lamp(x_mm: float, y_mm: float, power_w: float, *, z_mm: float = 40) -> str:
    return f"[[lamp]]\nx_mm = {x_mm}\ny_mm = {y_mm}\nz_mm = {z_mm}\npower_w = {power_w}\n"
