"""Images of a line camera: projection, occlusion, light, exposure, blur and noise, by closed forms."""

import math

import numpy as np
import pytest

from khep_twin.board.k213 import PIXELS, K213Register
from khep_twin.sensing.line_faces import luminous_reflectance
from khep_twin.sensing.line_image import NOISE
from khep_twin.sensing.line_light import EFFICACY
from khep_twin.units import ROOM_LUX
from tests.vision.seen import (
    BLACK_SURFACE,
    EYE_MM,
    WHITE_SURFACE,
    block,
    cylinder,
    greys,
    image,
    lamp,
    luminance,
    place,
    registers,
    slopes,
    within_a_grey,
    world,
)


def test_a_colour_reflects_its_luminance_in_srgb() -> None:
    assert luminous_reflectance((0.0, 0.0, 0.0)) == 0
    assert luminous_reflectance((1.0, 1.0, 1.0)) == pytest.approx(1)
    assert luminance((244, 243, 238)) == pytest.approx(WHITE_SURFACE, abs=1e-4)
    assert luminance((38, 38, 42)) == pytest.approx(BLACK_SURFACE, abs=1e-4)
    assert luminous_reflectance((38 / 255, 38 / 255, 42 / 255)) == pytest.approx(BLACK_SURFACE, abs=1e-4)


def test_a_white_wall_has_the_grey_of_white_in_the_light_of_the_room() -> None:
    assert within_a_grey(image(world()), greys(WHITE_SURFACE))


@pytest.mark.parametrize("heading_deg", [0, 10, -20, 35])
@pytest.mark.parametrize("x_mm", [120, 300, 500])
def test_a_striped_wall_is_projected_as_by_a_pinhole(x_mm: float, heading_deg: float) -> None:
    arena = 'stripes = [[31, "black"], [47, "white"]]'
    pixels = image(world(arena=arena, pose=f"x_mm = {x_mm}\ny_mm = 250\nheading_deg = {heading_deg}\n"))
    heading = math.radians(heading_deg)
    eye = x_mm + EYE_MM * math.cos(heading), 250 + EYE_MM * math.sin(heading)
    # Where rays through the pixels' ends, and one pixel beyond as for blur, meet the right wall at x = 600.
    directions = heading + np.arctan(slopes(np.arange(-1, 66).astype(np.float64)))
    y = eye[1] + (600 - eye[0]) * np.tan(directions)
    along = 500 - y  # from the wall's left end, as seen from inside
    black = along % 78 < 31
    number = along // 78
    unblurred = [
        pixel
        for pixel in range(64)
        if len(set(black[pixel : pixel + 4])) == 1
        and len(set(number[pixel : pixel + 4])) == 1
        and 0 < y[pixel + 3]
        and y[pixel] < 500
    ]
    assert len(unblurred) > 10
    expected = greys(np.where(black[1:-2], BLACK_SURFACE, WHITE_SURFACE))
    assert within_a_grey(pixels[unblurred], expected[unblurred])
    assert {bool(black[pixel + 1]) for pixel in unblurred} == {True, False}


def test_an_edge_is_where_geometry_says() -> None:
    pixels = image(world(block(405, 200, 101)))
    edge = place(400 - 300 - EYE_MM, 0.5)
    bright, dark = greys(WHITE_SURFACE), greys(BLACK_SURFACE)
    # The sum over the image gives the position of the edge between two pixels.
    covered = float(((bright - pixels) / (bright - dark)).sum())
    assert covered == pytest.approx(64 - edge, abs=0.1)


def test_a_cylinder_hides_what_its_tangents_say() -> None:
    pixels = image(world(cylinder(432, 265, 12)))
    distance, left, radius = 132 - EYE_MM, 15.0, 12.0
    middle, half = math.atan2(left, distance), math.asin(radius / math.hypot(distance, left))
    first, last = (place(1, math.tan(middle + sign * half)) for sign in (1, -1))
    bright, dark = greys(WHITE_SURFACE), greys(BLACK_SURFACE)
    share = (bright - pixels) / (bright - dark)
    assert share.sum() == pytest.approx(last - first, abs=0.15)
    assert (share * (np.arange(64) + 0.5)).sum() / share.sum() == pytest.approx((first + last) / 2, abs=0.1)


def test_the_nearer_of_two_things_hides_the_other() -> None:
    near, far = block(400, 250, 30), block(450, 250, 30, surface="grey")
    alone = image(world(near))
    assert (image(world(near + far)) == alone).all()
    assert (image(world(far + near)) == alone).all()
    assert not (image(world(far)) == alone).all()


@pytest.mark.parametrize(("height_mm", "is_seen"), [(39, False), (41, True)])
def test_what_is_below_the_line_of_sight_is_not_seen(height_mm: float, is_seen: bool) -> None:
    pixels = image(world(block(400, 250, 30, height_mm=height_mm)))
    assert (pixels[32] < 20) == is_seen
    assert within_a_grey(pixels, greys(WHITE_SURFACE)) != is_seen


def test_beyond_walls_that_are_too_low_is_the_room() -> None:
    pixels = image(world(arena="wall_height_mm = 35\n"))
    assert within_a_grey(pixels, greys(0.3))


def test_a_robot_with_a_turret_is_seen_and_a_bare_one_is_not() -> None:
    second = "[[robot]]\nx_mm = 420\ny_mm = 250\nheading_deg = 90\n"
    bare = image(world(second), robot=1)
    assert within_a_grey(bare, greys(WHITE_SURFACE))
    pixels = image(world(second + 'turrets = ["k213"]\n'), robot=1)
    # From its side the housing, 16 mm long about 2 mm behind the centre, and the lens, up to 12 mm ahead.
    distance = 120 - EYE_MM - 10
    first, last = place(distance, 12.0), place(distance, -10.0)
    dark = np.flatnonzero(pixels < 60)
    assert dark[0] == pytest.approx(first, abs=1.5)
    assert dark[-1] + 1 == pytest.approx(last, abs=1.5)


def test_a_lamp_shines_where_geometry_says() -> None:
    pixels = image(world(lamp(500, 290, 1)))
    distance = 200 - EYE_MM
    middle, half = math.atan2(40, distance), math.asin(10 / math.hypot(distance, 40))
    first, last = (place(1, math.tan(middle + sign * half)) for sign in (1, -1))
    white = np.flatnonzero(pixels == 255)
    assert white[0] == pytest.approx(first, abs=1)
    assert white[-1] + 1 == pytest.approx(last, abs=1)


def test_a_lamp_below_the_line_of_sight_only_lights_what_is_seen() -> None:
    pixels = image(world(lamp(500, 290, 1, z_mm=15)))
    assert pixels.max() < 255
    assert (pixels > greys(WHITE_SURFACE) * 0.9).all()


def test_a_lamp_behind_a_block_is_hidden_and_one_that_is_off_is_clear() -> None:
    assert image(world(lamp(500, 290, 1) + block(480, 285, 60, surface="grey"))).max() < 255
    assert within_a_grey(image(world(lamp(500, 290, 1) + "dim = 0\n")), greys(WHITE_SURFACE))


def test_the_light_on_a_wall_falls_off_with_a_lamp_s_distance_and_angle() -> None:
    # The lamp is beside the camera's field.
    scene = world(lamp(420, 400, 3))
    image(scene)
    y = 250 + (300 - EYE_MM) * slopes(np.arange(64) + 0.5)
    intensity = EFFICACY * 3 / (4 * math.pi)
    distance = np.hypot(0.6 - 0.42, y / 1e3 - 0.4)
    on_the_wall = ROOM_LUX + intensity * 0.18 / distance**3
    at_the_eye = ROOM_LUX + intensity / ((0.42 - 0.312) ** 2 + 0.15**2)
    light = round(200 * ROOM_LUX / at_the_eye)
    assert registers(scene)[K213Register.LIGHT] == light
    scan_ms = (light + 5) // 10 * 10
    assert within_a_grey(image(scene), greys(WHITE_SURFACE, on_the_wall / ROOM_LUX * scan_ms / 200))


def test_a_block_casts_a_shadow_onto_the_wall() -> None:
    high, low = (
        image(world(lamp(400, 400, 3) + block(500, 400, 200, height_mm=height_mm))) for height_mm in (60, 20)
    )
    # The ray from the lamp past the block's nearest corner, at (495, 300), meets the wall at y = 189.5. The
    # block itself is at the left of the image.
    y = 250 + (300 - EYE_MM) * slopes(np.arange(64) + 0.5)
    in_light, in_shadow = y < 189.5 - 3, (y > 189.5 + 3) & (np.arange(64) > 7)
    assert in_light.sum() > 5
    assert in_shadow.sum() > 20
    assert (high[in_light] == low[in_light]).all()
    assert (high[in_shadow] < low[in_shadow] * 0.95).all()


def test_the_shadow_of_what_is_lower_than_the_lamp_lies_lower() -> None:
    bare = image(world(lamp(400, 400, 3, z_mm=60)))
    low = image(world(lamp(400, 400, 3, z_mm=60) + block(500, 400, 200, height_mm=35)))
    assert (low == bare).all()
    high = image(world(lamp(400, 400, 3, z_mm=15) + block(500, 400, 200, height_mm=35)))
    assert (high[20:50] < image(world(lamp(400, 400, 3, z_mm=15)))[20:50]).all()


@pytest.mark.parametrize(
    ("room_lux", "light", "part"),
    [(300, 200, 1), (150, 400, 1), (1000, 60, 1), (3000, 20, 2.5), (30, 2000, 0.5)],
)
def test_by_the_light_a_scan_is_as_long_as_white_needs(room_lux: float, light: int, part: float) -> None:
    scene = world(f"[lighting]\nroom_lux = {room_lux}\n")
    assert within_a_grey(image(scene), greys(WHITE_SURFACE, part))
    assert within_a_grey(image(scene), greys(WHITE_SURFACE, part))
    assert registers(scene)[K213Register.LIGHT] == light


@pytest.mark.parametrize(("period", "part"), [(1, 0.25), (2, 0.5), (4, 1.25), (5, 2.5)])
def test_a_fixed_period_is_the_exposure(period: int, part: float) -> None:
    scene = world()
    scene.robots[0].send(b"T,2,U,%d\n" % period)
    assert within_a_grey(image(scene, scans=3), greys(WHITE_SURFACE, part))


@pytest.mark.parametrize("lamps", ["", lamp(100, 250, 0)])
def test_in_the_dark_all_is_black(lamps: str) -> None:
    scene = world(f"[lighting]\nroom_lux = 0\n{lamps}")
    assert image(scene).tolist() == [0] * 64
    assert registers(scene)[K213Register.LIGHT] == 65535


@pytest.mark.parametrize(("distance_mm", "low", "high"), [(60, 0, 2), (300, 0, 2), (20, 3, 5), (16, 4, 6)])
def test_an_edge_that_is_too_near_is_blurred(distance_mm: float, low: float, high: float) -> None:
    arena = 'stripes = [[250, "black"], [250, "white"]]\n'
    pose = f"x_mm = {600 - distance_mm - EYE_MM}\ny_mm = 250\nheading_deg = 0\n"
    pixels = image(world(arena=arena, pose=pose))
    bright, dark = greys(WHITE_SURFACE), greys(BLACK_SURFACE)
    part = (pixels - dark) / (bright - dark)
    assert low <= np.count_nonzero((part > 0.1) & (part < 0.9)) <= high


@pytest.mark.share(2)
@pytest.mark.parametrize(("scans", "max_correlation"), [(100, 0.45), (400, 0.25)])
def test_noise_is_even_over_pixels_and_scans_and_has_the_stated_deviation(
    scans: int, max_correlation: float
) -> None:
    wood = block(400, 250, 130, surface="wood")
    scene = world(wood, noise=True)
    scene.robots[0].send(b"T,2,U,2\n")
    images = np.array([image(scene) for _ in range(scans)][2:], np.float64)
    mean = image(world(wood)) / 2
    assert images.std(axis=0).mean() == pytest.approx(math.hypot(NOISE, 1 / math.sqrt(12)), rel=0.02)
    assert np.abs(images.mean(axis=0) - mean).max() < 5 * NOISE / math.sqrt(len(images)) + 1
    noise = images - images.mean(axis=0)
    assert np.abs(np.corrcoef(noise.T)[~np.eye(64, dtype=bool)]).max() < max_correlation
    assert abs(np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1]) < 0.03


def test_without_noise_two_images_of_the_same_are_equal() -> None:
    scene = world()
    assert (image(scene) == image(scene)).all()


def test_a_robot_that_turns_sees_a_mark_move_to_the_right() -> None:
    scene = world(cylinder(432, 250, 6))
    before = int(image(scene).argmin())
    scene.robots[0].send(b"D,-1,1\n")
    after = int(image(scene, scans=3).argmin())
    assert after > before + 3
    assert registers(scene)[PIXELS].max() <= 255
