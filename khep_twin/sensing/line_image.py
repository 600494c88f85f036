"""The image of a line camera: what a horizontal line of sight sees, and its light.

The camera looks ahead with a flat field, so that equal ways along a wall face to face are equal numbers of
pixels. Faces and cylinders that reach the camera's height are drawn on 4 rays for each pixel, the nearest one
on each. Their light is

    luminance = reflectance / pi (room + sum over lamps of v intensity cos / distance^2)

with v = 0 in the shadow of anything of any height, else 1; a lamp that is on glows, one that is off is clear
glass. The lens spreads each ray's light over the width of its blur, aperture |1 / depth - 1 / focus|, and
weakens it towards the edges by the fourth power of the cosine. A pixel is luminance times exposure, with
noise.

This source runs interpreted and compiled, and takes square roots as its only functions, for the same bits.
"""

import math
from typing import NamedTuple

from khep_twin.board.k213 import LIGHT_LIMIT, LONGEST_MS, SHORTEST_MS
from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Matrix, Vector
from khep_twin.sensing.noise import Tables, draws
from khep_twin.units import BULB_RADIUS, K213_PIXELS, ROOM_LUX

X, Y, END_X, END_Y, RADIUS, BOTTOM, TOP, REFLECTANCE, GLOW, ROLE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9
"""Columns of a face: its left and its right end as seen from outside, or the centre of a cylinder, whose
radius is above 0 [m]; the heights of its lower and upper edge [m]; the part of the light that it reflects;
its own luminance [cd/m^2]; and the sum of its roles."""
N_COLUMNS = 10

SEEN, CASTS, OWN = 1, 2, 4
"""Roles of a face: it is seen, it casts shadows, and it is of the robot that carries the camera."""

EFFICACY = 12.0
"""Light of a lamp per power [lm/W] (assumed: a light bulb)."""

INTENSITY = EFFICACY / (4 * math.pi)
"""Luminous intensity of a lamp per power, the same in all directions [cd/W]."""

BULB_LUMINANCE = INTENSITY / (math.pi * BULB_RADIUS * BULB_RADIUS)
"""Luminance of a lamp per power [cd/(m^2 W)]."""

BEYOND = 0.3
"""Reflectance of the room around the arena (assumed)."""

HALF_FIELD = math.tan(math.radians(18))
"""Tangent of half the field of view of 36 degrees (K213 manual 1.2)."""

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

RAYS_PER_PIXEL = 4
MARGIN = 10
"""Pixels beside the image from which blurred light comes, and largest half of the blur [pixels]."""

N_RAYS = (K213_PIXELS + 2 * MARGIN) * RAYS_PER_PIXEL
"""Number of rays."""

_HALF, _NEAREST, _TOUCHING = K213_PIXELS / 2, 1e-3, 1e-4
_PER_LUMINANCE = WHITE_GREY / (WHITE * ROOM_LUX / math.pi) / LIGHT_AT_ROOM


class Eye(NamedTuple):
    """Place of a line camera.

    Attributes:
        x: Position [m].
        y: Position [m].
        height: Height above the floor [m].
        ahead: Cosine of its direction.
        left: Sine of its direction.
    """

    x: float
    y: float
    height: float
    ahead: float
    left: float


class LineScene(NamedTuple):
    """Surroundings of a line camera.

    Attributes:
        faces: Faces and cylinders, of which some count (n, N_COLUMNS).
        n_faces: Number of those that count (1,).
        lamps: Lamps: x, y, z [m] and power [W] (n_lamps, 4).
        room: Illuminance by the room's own light (1,) [lx].
        depths: Buffer for the depth on each ray (N_RAYS,) [m].
        lights: Buffer for the luminance on each ray (N_RAYS,) [cd/m^2].
        owners: Buffer for the face on each ray (N_RAYS,).
        lit: Buffer for the lamps that shine on a point (n_lamps,).
        sums: Buffer for the sums of light and of weights of each pixel (2, 64).
    """

    faces: Matrix
    n_faces: Vector[int]
    lamps: Matrix
    room: Vector[float]
    depths: Vector[float]
    lights: Vector[float]
    owners: Vector[int]
    lit: Vector[int]
    sums: Matrix


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
            slope = HALF_FIELD * (1 - (pixel + 0.5) / _HALF)
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
        at, half = _place(ray), _half_blur(depth)
        if at + half <= 0 or at - half >= K213_PIXELS:
            continue  # none of its light comes into the image
        if face < 0:
            scene.lights[ray] = BEYOND * scene.room[0] / math.pi
            continue
        if faces[face, GLOW] > 0:
            scene.lights[ray] = faces[face, GLOW]
            continue
        aside = depth * _slope(ray)
        x, y = eye.x + depth * eye.ahead - aside * eye.left, eye.y + depth * eye.left + aside * eye.ahead
        if face != before or ray // RAYS_PER_PIXEL != pixel:
            # One point of a face in each pixel decides on its shadows.
            before, pixel = face, ray // RAYS_PER_PIXEL
            for lamp in range(len(scene.lamps)):
                scene.lit[lamp] = 0
                if scene.lamps[lamp, 3] > 0 and not in_shadow(scene, lamp, x, y, eye.height, 0):
                    scene.lit[lamp] = 1
        scene.lights[ray] = faces[face, REFLECTANCE] / math.pi * _light_on(scene, face, x, y, eye.height)


@compilable
def blur(scene: LineScene) -> None:
    """Fill in the sums of light and weights of each pixel, as the lens spreads them."""
    sums = scene.sums
    for pixel in range(K213_PIXELS):
        sums[0, pixel] = sums[1, pixel] = 0.0
    for ray in range(N_RAYS):
        at, half = _place(ray), _half_blur(scene.depths[ray])
        low, high = at - half, at + half
        first, last = max(int(low + MARGIN) - MARGIN, 0), min(int(high + MARGIN) - MARGIN, K213_PIXELS - 1)
        for pixel in range(first, last + 1):
            part = (min(high, pixel + 1.0) - max(low, float(pixel))) / (2 * half)
            if part > 0:
                sums[0, pixel] += part * scene.lights[ray]
                sums[1, pixel] += part


@compilable
def illuminance(scene: LineScene, eye: Eye) -> float:
    """Return the light at the camera, from all directions alike [lx]."""
    total, lamps = scene.room[0], scene.lamps
    for lamp in range(len(lamps)):
        if lamps[lamp, 3] > 0 and not in_shadow(scene, lamp, eye.x, eye.y, eye.height, OWN):
            dx, dy, dz = lamps[lamp, 0] - eye.x, lamps[lamp, 1] - eye.y, lamps[lamp, 2] - eye.height
            total += INTENSITY * lamps[lamp, 3] / max(dx * dx + dy * dy + dz * dz, BULB_RADIUS * BULB_RADIUS)
    return total


@compilable
def in_shadow(scene: LineScene, lamp: int, x: float, y: float, height: float, without: int) -> bool:
    """Return whether a face without any of some roles stops the light of a lamp on its way to a point [m]."""
    faces, lamps = scene.faces, scene.lamps
    dx, dy, dz = lamps[lamp, 0] - x, lamps[lamp, 1] - y, lamps[lamp, 2] - height
    length = math.sqrt(dx * dx + dy * dy)
    if length <= _TOUCHING:
        return False
    first, last = _TOUCHING / length, 1.0
    for face in range(scene.n_faces[0]):
        role = int(faces[face, ROLE])
        if role & CASTS == 0 or role & without:
            continue
        ox, oy = faces[face, X] - x, faces[face, Y] - y
        radius = faces[face, RADIUS]
        if radius > 0:
            along, across = (ox * dx + oy * dy) / length, (oy * dx - ox * dy) / length
            if abs(across) >= radius:
                continue
            half = math.sqrt(radius * radius - across * across)
            hits = (along - half) / length, (along + half) / length
        else:
            sx, sy = faces[face, END_X] - faces[face, X], faces[face, END_Y] - faces[face, Y]
            turn = dx * sy - dy * sx
            if turn == 0:
                continue
            place = (ox * dy - oy * dx) / turn
            if place < 0 or place > 1:
                continue
            hits = (ox * sy - oy * sx) / turn, -1.0
        for hit in hits:
            if first < hit < last and faces[face, BOTTOM] <= height + hit * dz <= faces[face, TOP]:
                return True
    return False


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
        divisor = dx - _slope(ray) * dz
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
        slope = _slope(ray)
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
def _place(ray: int) -> float:
    """Return the place of a ray in the image [pixels]."""
    return (ray + 0.5) / RAYS_PER_PIXEL - MARGIN


@compilable
def _slope(ray: int) -> float:
    """Return the tangent of a ray's direction, to the left."""
    return HALF_FIELD * (1 - _place(ray) / _HALF)


@compilable
def _half_blur(depth: float) -> float:
    """Return half of the width over which the lens spreads a point at a depth [pixels]."""
    half = APERTURE / 2 * abs(1 / depth - 1 / FOCUS) * (_HALF / HALF_FIELD)
    return max(0.5 / RAYS_PER_PIXEL, min(half, float(MARGIN)))


@compilable
def _first_ray(slope: float) -> int:
    """Return the first ray to the right of a slope."""
    place = (_HALF * (1 - slope / HALF_FIELD) + MARGIN) * RAYS_PER_PIXEL - 0.5
    return math.ceil(max(-1.0, min(place, float(N_RAYS))))


@compilable
def _light_on(scene: LineScene, face: int, x: float, y: float, height: float) -> float:
    """Return the light on a point of a face, by the lamps in `lit` [lx]."""
    faces, lamps, total = scene.faces, scene.lamps, scene.room[0]
    if faces[face, RADIUS] > 0:
        normal_x, normal_y = x - faces[face, X], y - faces[face, Y]
    else:
        normal_x, normal_y = faces[face, END_Y] - faces[face, Y], faces[face, X] - faces[face, END_X]
    length = math.sqrt(normal_x * normal_x + normal_y * normal_y)
    for lamp in range(len(lamps)):
        if scene.lit[lamp] == 0:
            continue
        dx, dy, dz = lamps[lamp, 0] - x, lamps[lamp, 1] - y, lamps[lamp, 2] - height
        facing = (normal_x * dx + normal_y * dy) / length
        if facing > 0:
            square = max(dx * dx + dy * dy + dz * dz, BULB_RADIUS * BULB_RADIUS)
            total += INTENSITY * lamps[lamp, 3] * facing / (square * math.sqrt(square))
    return total
