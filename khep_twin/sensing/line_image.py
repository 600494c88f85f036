"""The image of a line camera: luminance along a horizontal line, with blur, exposure and noise.

The camera has the rectilinear projection of a pinhole camera. Faces and cylinders at the camera's height are
ray-cast with 4 rays per pixel. Their luminance is reflectance / pi times their illuminance (`line_light`). A
lamp that is on glows; one that is off is clear glass. The lens blurs each ray's light over the width
aperture |1 / depth - 1 / focus|, and weakens it towards the edges by the fourth power of the cosine. The grey
of a pixel is luminance times exposure, with noise.

The only mathematical function is the square root, so that plain and compiled code give the same values.
"""

import math

from khep_twin.board.k213 import LIGHT_LIMIT, LONGEST_MS, SHORTEST_MS
from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.line_light import face_illuminance, illuminance, in_shadow
from khep_twin.sensing.line_scene import (
    BOTTOM,
    END_X,
    END_Y,
    GLOW,
    HALF_FIELD,
    HALF_PIXELS,
    MARGIN,
    N_RAYS,
    RADIUS,
    RAYS_PER_PIXEL,
    REFLECTANCE,
    ROLE,
    TOP,
    VISIBLE,
    Eye,
    LineScene,
    X,
    Y,
    ray_position,
    ray_slope,
)
from khep_twin.sensing.noise import Tables, draws
from khep_twin.units import K213_PIXELS, ROOM_LUX

BACKGROUND = 0.3
"""Reflectance of the room around the arena (assumed)."""

FOCUS = 1 / 11
"""Distance of the sharpest image [m]: as sharp at 50 as at 500 mm, the range of the K213 manual 1.2."""

APERTURE = 2 * HALF_FIELD / K213_PIXELS / 9
"""Diameter of the lens's aperture [m]: the image is blurred by just a pixel at 50 and at 500 mm."""

WHITE_GREY, WHITE, LIGHT_AT_ROOM = 200, 0.9, 200
"""Grey of a white surface in the middle of an image whose exposure is set by the light sensor; reflectance of
that surface; reading of the light sensor in the room's lighting (simulators: 175 to 225)."""

NOISE = 0.1 * 255 / math.sqrt(12)
"""Standard deviation of a pixel [greys]: uniform noise of 10 % of the range (simulators)."""

LIGHT_NOISE = 0.01
"""Standard deviation of the light sensor, relative to its reading (assumed)."""

_MIN_DEPTH = 1e-3
_GAIN_PER_MS = WHITE_GREY / (WHITE * ROOM_LUX / math.pi) / LIGHT_AT_ROOM


@compilable
def take_image(
    scene: LineScene,
    eye: Eye,
    exposure_ms: int,
    tables: Tables,
    noise_key: Vector[int],
    image_number: int,
    pixels: Vector[int],
) -> int:
    """Fill in the greys of an image; return the reading of the light sensor.

    Args:
        scene: Surroundings of the camera.
        eye: Pose of the camera.
        exposure_ms: Duration of the scan [ms]; 0 to choose it by the current light.
        tables: Quantiles of the random draws.
        noise_key: Words of the key of the random draws (2,).
        image_number: Number of the image.
        pixels: Buffer for the greys, 0 to 255, from left to right (64,).
    """
    cast_rays(scene, eye)
    shade(scene, eye)
    blur(scene)
    first_draw, n_pairs = image_number * (K213_PIXELS // 2 + 1), K213_PIXELS // 2
    reading = LIGHT_AT_ROOM * ROOM_LUX / max(illuminance(scene, eye), 1e-9)
    reading = min(reading, 1e6) * (1 + LIGHT_NOISE * draws(tables, noise_key, first_draw + n_pairs)[0])
    light = max(1, min(LIGHT_LIMIT, round(reading)))
    if exposure_ms == 0:
        exposure_ms = max(SHORTEST_MS, min(LONGEST_MS, light))
    gain = _GAIN_PER_MS * exposure_ms
    for pair in range(n_pairs):
        normals = draws(tables, noise_key, first_draw + pair)
        for side in range(2):
            pixel = 2 * pair + side
            slope = HALF_FIELD * (1 - (pixel + 0.5) / HALF_PIXELS)
            falloff = 1 / ((1 + slope * slope) * (1 + slope * slope))
            grey = gain * falloff * scene.weighted_sums[0, pixel] / scene.weighted_sums[1, pixel]
            pixels[pixel] = round(max(0.0, min(255.0, grey + NOISE * (normals[1] if side else normals[0]))))
    return light


@compilable
def cast_rays(scene: LineScene, eye: Eye) -> None:
    """Compute depth and index of the nearest face on each ray; infinity and -1 for none."""
    for ray in range(N_RAYS):
        scene.depths[ray] = math.inf
        scene.face_index[ray] = -1
    faces = scene.faces
    for face in range(scene.n_faces[0]):
        if int(faces[face, ROLE]) & VISIBLE == 0:
            continue
        if faces[face, BOTTOM] > eye.height or faces[face, TOP] < eye.height:
            continue
        if faces[face, RADIUS] > 0:
            _cast_to_cylinder(scene, eye, face)
        else:
            _cast_to_face(scene, eye, face)


@compilable
def shade(scene: LineScene, eye: Eye) -> None:
    """Compute the luminance on each ray whose light reaches the image."""
    faces, previous_face, previous_pixel = scene.faces, -2, -1
    for ray in range(N_RAYS):
        face, depth = scene.face_index[ray], scene.depths[ray]
        position, half_width = ray_position(ray), _half_blur_width(depth)
        if position + half_width <= 0 or position - half_width >= K213_PIXELS:
            continue  # none of its light reaches the image
        if face < 0:
            scene.luminances[ray] = BACKGROUND * scene.room_lux[0] / math.pi
            continue
        if faces[face, GLOW] > 0:
            scene.luminances[ray] = faces[face, GLOW]
            continue
        lateral = depth * ray_slope(ray)
        x = eye.x + depth * eye.cosine - lateral * eye.sine
        y = eye.y + depth * eye.sine + lateral * eye.cosine
        if face != previous_face or ray // RAYS_PER_PIXEL != previous_pixel:
            # Shadows are computed for one point of a face per pixel.
            previous_face, previous_pixel = face, ray // RAYS_PER_PIXEL
            for lamp in range(len(scene.lamps)):
                scene.visible_lamps[lamp] = 0
                if scene.lamps[lamp, 3] > 0 and not in_shadow(scene, lamp, x, y, eye.height, 0):
                    scene.visible_lamps[lamp] = 1
        lux = face_illuminance(scene, face, x, y, eye.height)
        scene.luminances[ray] = faces[face, REFLECTANCE] / math.pi * lux


@compilable
def blur(scene: LineScene) -> None:
    """Compute the sums of weighted luminances and of weights of each pixel, by the blur of the lens."""
    weighted_sums = scene.weighted_sums
    for pixel in range(K213_PIXELS):
        weighted_sums[0, pixel] = weighted_sums[1, pixel] = 0.0
    for ray in range(N_RAYS):
        position, half_width = ray_position(ray), _half_blur_width(scene.depths[ray])
        low, high = position - half_width, position + half_width
        first_pixel = max(int(low + MARGIN) - MARGIN, 0)
        last_pixel = min(int(high + MARGIN) - MARGIN, K213_PIXELS - 1)
        for pixel in range(first_pixel, last_pixel + 1):
            width = (min(high, pixel + 1.0) - max(low, float(pixel))) / (2 * half_width)
            if width > 0:
                weighted_sums[0, pixel] += width * scene.luminances[ray]
                weighted_sums[1, pixel] += width


@compilable
def _cast_to_face(scene: LineScene, eye: Eye, face: int) -> None:
    """Cast the rays to a flat face, which is visible from outside only."""
    faces = scene.faces
    dx, dy = faces[face, X] - eye.x, faces[face, Y] - eye.y
    z0, x0 = dx * eye.cosine + dy * eye.sine, dy * eye.cosine - dx * eye.sine
    dx, dy = faces[face, END_X] - eye.x, faces[face, END_Y] - eye.y
    z1, x1 = dx * eye.cosine + dy * eye.sine, dy * eye.cosine - dx * eye.sine
    cross, dz, dx = z0 * x1 - x0 * z1, z1 - z0, x1 - x0
    if cross >= 0 or (z0 <= _MIN_DEPTH and z1 <= _MIN_DEPTH):
        return
    first_ray, last_ray = 0, N_RAYS - 1
    if z0 > _MIN_DEPTH:
        first_ray = _first_ray_right_of(x0 / z0)
    if z1 > _MIN_DEPTH:
        last_ray = _first_ray_right_of(x1 / z1) - 1
    for ray in range(max(first_ray, 0), min(last_ray, N_RAYS - 1) + 1):
        divisor = dx - ray_slope(ray) * dz
        if divisor < 0:
            _set_nearest(scene, ray, face, cross / divisor)


@compilable
def _cast_to_cylinder(scene: LineScene, eye: Eye, face: int) -> None:
    """Cast the rays to a cylinder."""
    faces, radius = scene.faces, scene.faces[face, RADIUS]
    dx, dy = faces[face, X] - eye.x, faces[face, Y] - eye.y
    z, x = dx * eye.cosine + dy * eye.sine, dy * eye.cosine - dx * eye.sine
    tangent_square = z * z + x * x - radius * radius
    if tangent_square <= 0 or z <= -radius:
        return
    first_ray, last_ray = 0, N_RAYS - 1
    if z > radius:
        scale, spread = z * z - radius * radius, radius * math.sqrt(tangent_square)
        first_ray = _first_ray_right_of((z * x + spread) / scale)
        last_ray = _first_ray_right_of((z * x - spread) / scale) - 1
    for ray in range(max(first_ray, 0), min(last_ray, N_RAYS - 1) + 1):
        slope = ray_slope(ray)
        norm_square, projection = 1 + slope * slope, z + slope * x
        discriminant = projection * projection - norm_square * tangent_square
        if discriminant >= 0:
            _set_nearest(scene, ray, face, (projection - math.sqrt(discriminant)) / norm_square)


@compilable
def _set_nearest(scene: LineScene, ray: int, face: int, depth: float) -> None:
    """Set a face on a ray if it is nearer than the current one."""
    if _MIN_DEPTH < depth < scene.depths[ray]:
        scene.depths[ray] = depth
        scene.face_index[ray] = face


@compilable
def _half_blur_width(depth: float) -> float:
    """Return half of the width over which the lens spreads a point at a depth [pixels]."""
    half_width = APERTURE / 2 * abs(1 / depth - 1 / FOCUS) * (HALF_PIXELS / HALF_FIELD)
    return max(0.5 / RAYS_PER_PIXEL, min(half_width, float(MARGIN)))


@compilable
def _first_ray_right_of(slope: float) -> int:
    """Return the first ray to the right of a slope."""
    position = (HALF_PIXELS * (1 - slope / HALF_FIELD) + MARGIN) * RAYS_PER_PIXEL - 0.5
    return math.ceil(max(-1.0, min(position, float(N_RAYS))))
