"""The image of a line camera: what a horizontal line of sight sees, and its light.

The camera looks ahead with a flat field, so that equal ways along a wall face to face are equal numbers of
pixels. Faces and cylinders that reach the camera's height are drawn on 4 rays for each pixel, the nearest one
on each. Their luminance is reflectance / pi times the light on them (`line_light`); a lamp that is on glows,
one that is off is clear glass. The lens spreads each ray's light over the width of its blur,
aperture |1 / depth - 1 / focus|, and weakens it towards the edges by the fourth power of the cosine. A pixel
is luminance times exposure, with noise.

This source runs interpreted and compiled, and takes square roots as its only functions, for the same bits.
"""

import math

from khep_twin.board.k213 import LIGHT_LIMIT, LONGEST_MS, SHORTEST_MS
from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.line_light import illuminance, in_shadow, light_on
from khep_twin.sensing.line_scene import (
    BOTTOM,
    END_X,
    END_Y,
    GLOW,
    HALF,
    HALF_FIELD,
    MARGIN,
    N_RAYS,
    RADIUS,
    RAYS_PER_PIXEL,
    REFLECTANCE,
    ROLE,
    SEEN,
    TOP,
    Eye,
    LineScene,
    X,
    Y,
    place_of_ray,
    slope_of_ray,
)
from khep_twin.sensing.noise import Tables, draws
from khep_twin.units import K213_PIXELS, ROOM_LUX

BEYOND = 0.3
"""Reflectance of the room around the arena (assumed)."""

FOCUS = 1 / 11
"""Distance of the sharpest image [m]: as sharp at 50 as at 500 mm, the range of the K213 manual 1.2."""

APERTURE = 2 * HALF_FIELD / K213_PIXELS / 9
"""Diameter of the lens's aperture [m]: the image is blurred by just a pixel at 50 and at 500 mm."""

WHITE_GREY, WHITE, LIGHT_AT_ROOM = 200, 0.9, 200
"""Grey in the middle of the image of a white surface, of this reflectance, in the light that the exposure is
set by; and the reading of the light sensor in the room's own light (simulators: 175 to 225)."""

NOISE = 0.1 * 255 / math.sqrt(12)
"""Standard deviation of a pixel [greys]: that of 10 % of a grey drawn evenly (simulators)."""

LIGHT_NOISE = 0.01
"""Standard deviation of the light sensor, relative to its reading (assumed)."""

_NEAREST = 1e-3
_PER_LUMINANCE = WHITE_GREY / (WHITE * ROOM_LUX / math.pi) / LIGHT_AT_ROOM


@compilable
def take_image(
    scene: LineScene,
    eye: Eye,
    exposure_ms: int,
    tables: Tables,
    key: Vector[int],
    number: int,
    pixels: Vector[int],
) -> int:
    """Fill in the greys of an image; return the reading of the light sensor.

    Args:
        scene: Surroundings of the camera.
        eye: Place of the camera.
        exposure_ms: Duration of the scan [ms]; 0 for that by the light of now.
        tables: Quantiles of the random draws.
        key: Words of the key of the random draws (2,).
        number: Number of the image.
        pixels: Greys, 0 to 255, from the left to the right (64,).
    """
    look(scene, eye)
    shade(scene, eye)
    blur(scene)
    first, half = number * (K213_PIXELS // 2 + 1), K213_PIXELS // 2
    reading = LIGHT_AT_ROOM * ROOM_LUX / max(illuminance(scene, eye), 1e-9)
    reading = min(reading, 1e6) * (1 + LIGHT_NOISE * draws(tables, key, first + half)[0])
    light = max(1, min(LIGHT_LIMIT, round(reading)))
    if exposure_ms == 0:
        exposure_ms = max(SHORTEST_MS, min(LONGEST_MS, light))
    gain = _PER_LUMINANCE * exposure_ms
    for pair in range(half):
        drawn = draws(tables, key, first + pair)
        for side in range(2):
            pixel = 2 * pair + side
            slope = HALF_FIELD * (1 - (pixel + 0.5) / HALF)
            falloff = 1 / ((1 + slope * slope) * (1 + slope * slope))
            grey = gain * falloff * scene.sums[0, pixel] / scene.sums[1, pixel]
            pixels[pixel] = round(max(0.0, min(255.0, grey + NOISE * (drawn[1] if side else drawn[0]))))
    return light


@compilable
def look(scene: LineScene, eye: Eye) -> None:
    """Fill in the depth and the nearest face on each ray; the depth is infinite where there is none."""
    for ray in range(N_RAYS):
        scene.depths[ray] = math.inf
        scene.owners[ray] = -1
    faces = scene.faces
    for face in range(scene.n_faces[0]):
        if int(faces[face, ROLE]) & SEEN == 0:
            continue
        if faces[face, BOTTOM] > eye.height or faces[face, TOP] < eye.height:
            continue
        if faces[face, RADIUS] > 0:
            _draw_cylinder(scene, eye, face)
        else:
            _draw_face(scene, eye, face)


@compilable
def shade(scene: LineScene, eye: Eye) -> None:
    """Fill in the luminance on each ray whose light comes into the image."""
    faces, before, pixel = scene.faces, -2, -1
    for ray in range(N_RAYS):
        face, depth = scene.owners[ray], scene.depths[ray]
        at, half = place_of_ray(ray), _half_blur(depth)
        if at + half <= 0 or at - half >= K213_PIXELS:
            continue  # none of its light comes into the image
        if face < 0:
            scene.lights[ray] = BEYOND * scene.room[0] / math.pi
            continue
        if faces[face, GLOW] > 0:
            scene.lights[ray] = faces[face, GLOW]
            continue
        aside = depth * slope_of_ray(ray)
        x, y = eye.x + depth * eye.ahead - aside * eye.left, eye.y + depth * eye.left + aside * eye.ahead
        if face != before or ray // RAYS_PER_PIXEL != pixel:
            # One point of a face in each pixel decides on its shadows.
            before, pixel = face, ray // RAYS_PER_PIXEL
            for lamp in range(len(scene.lamps)):
                scene.lit[lamp] = 0
                if scene.lamps[lamp, 3] > 0 and not in_shadow(scene, lamp, x, y, eye.height, 0):
                    scene.lit[lamp] = 1
        scene.lights[ray] = faces[face, REFLECTANCE] / math.pi * light_on(scene, face, x, y, eye.height)


@compilable
def blur(scene: LineScene) -> None:
    """Fill in the sums of light and weights of each pixel, as the lens spreads them."""
    sums = scene.sums
    for pixel in range(K213_PIXELS):
        sums[0, pixel] = sums[1, pixel] = 0.0
    for ray in range(N_RAYS):
        at, half = place_of_ray(ray), _half_blur(scene.depths[ray])
        low, high = at - half, at + half
        first, last = max(int(low + MARGIN) - MARGIN, 0), min(int(high + MARGIN) - MARGIN, K213_PIXELS - 1)
        for pixel in range(first, last + 1):
            part = (min(high, pixel + 1.0) - max(low, float(pixel))) / (2 * half)
            if part > 0:
                sums[0, pixel] += part * scene.lights[ray]
                sums[1, pixel] += part


@compilable
def _draw_face(scene: LineScene, eye: Eye, face: int) -> None:
    """Draw a flat face, which is seen from outside only."""
    faces = scene.faces
    dx, dy = faces[face, X] - eye.x, faces[face, Y] - eye.y
    z0, x0 = dx * eye.ahead + dy * eye.left, dy * eye.ahead - dx * eye.left
    dx, dy = faces[face, END_X] - eye.x, faces[face, END_Y] - eye.y
    z1, x1 = dx * eye.ahead + dy * eye.left, dy * eye.ahead - dx * eye.left
    cross, dz, dx = z0 * x1 - x0 * z1, z1 - z0, x1 - x0
    if cross >= 0 or (z0 <= _NEAREST and z1 <= _NEAREST):
        return
    low, high = 0, N_RAYS - 1
    if z0 > _NEAREST:
        low = _first_ray(x0 / z0)
    if z1 > _NEAREST:
        high = _first_ray(x1 / z1) - 1
    for ray in range(max(low, 0), min(high, N_RAYS - 1) + 1):
        divisor = dx - slope_of_ray(ray) * dz
        if divisor < 0:
            _put(scene, ray, face, cross / divisor)


@compilable
def _draw_cylinder(scene: LineScene, eye: Eye, face: int) -> None:
    """Draw a cylinder."""
    faces, radius = scene.faces, scene.faces[face, RADIUS]
    dx, dy = faces[face, X] - eye.x, faces[face, Y] - eye.y
    z, x = dx * eye.ahead + dy * eye.left, dy * eye.ahead - dx * eye.left
    free = z * z + x * x - radius * radius
    if free <= 0 or z <= -radius:
        return
    low, high = 0, N_RAYS - 1
    if z > radius:
        scale, spread = z * z - radius * radius, radius * math.sqrt(free)
        low, high = _first_ray((z * x + spread) / scale), _first_ray((z * x - spread) / scale) - 1
    for ray in range(max(low, 0), min(high, N_RAYS - 1) + 1):
        slope = slope_of_ray(ray)
        square, ahead = 1 + slope * slope, z + slope * x
        rest = ahead * ahead - square * free
        if rest >= 0:
            _put(scene, ray, face, (ahead - math.sqrt(rest)) / square)


@compilable
def _put(scene: LineScene, ray: int, face: int, depth: float) -> None:
    """Put a face on a ray if it is nearer than what is there."""
    if _NEAREST < depth < scene.depths[ray]:
        scene.depths[ray] = depth
        scene.owners[ray] = face


@compilable
def _half_blur(depth: float) -> float:
    """Return half of the width over which the lens spreads a point at a depth [pixels]."""
    half = APERTURE / 2 * abs(1 / depth - 1 / FOCUS) * (HALF / HALF_FIELD)
    return max(0.5 / RAYS_PER_PIXEL, min(half, float(MARGIN)))


@compilable
def _first_ray(slope: float) -> int:
    """Return the first ray to the right of a slope."""
    place = (HALF * (1 - slope / HALF_FIELD) + MARGIN) * RAYS_PER_PIXEL - 0.5
    return math.ceil(max(-1.0, min(place, float(N_RAYS))))
