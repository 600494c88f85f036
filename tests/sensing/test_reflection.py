"""Light from surfaces: against closed form, and against rays cast in all directions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest

from khep_twin.sensing import lobes
from khep_twin.sensing.mujoco_scene import upright_shape
from khep_twin.sensing.reflection import Lobe, reflected_light, remove_faint
from khep_twin.sensing.seen_surfaces import N_COLUMNS, N_SURFACES, SQUARE, Chip, add_upright
from khep_twin.units import SENSOR_HEIGHT


class Thing(NamedTuple):
    """A box, or a cylinder if its width is negative, in millimetres from the chip: x along its axis."""

    x: float
    y: float
    half: float
    width: float = -1.0
    angle_deg: float = 0.0
    top: float = 50.0
    bottom: float = 0.0
    reflectance: float = 1.0


def wall(distance: float, angle_deg: float = 0.0, **options: float) -> Thing:
    """Return an infinite tall wall at a distance [mm], whose normal is turned by an angle."""
    angle, tall = math.radians(angle_deg), {"top": 1e6} | options
    centre = distance + 5000
    return Thing(centre * math.cos(angle), centre * math.sin(angle), 5000, 1e6, angle_deg, **tall)


def lobe_of(exponent: float, narrowing: int = 0, mirror: float = 1.0) -> Lobe:
    integer, norm = int(exponent), lobes.norm(exponent)
    width, table = lobes.width(exponent) / norm, lobes.table(exponent)
    return Lobe(integer, exponent - integer, norm, width, table, narrowing, mirror)


def surfaces(things: Sequence[Thing], reach: float = 100.0) -> tuple[list[float], int, Chip]:
    columns, count = [0.0] * (N_SURFACES * N_COLUMNS), 0
    chip = Chip(0.0, 0.0, 1.0, 0.0, SENSOR_HEIGHT, reach)
    for x, y, half, width, angle_deg, top, bottom, reflectance in things:
        direction = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        size = half / 1e3, width / 1e3 if width > 0 else -1.0
        span = bottom / 1e3, top / 1e3
        count = add_upright(columns, count, chip, ((x / 1e3, y / 1e3), direction, size, span), reflectance)
    return columns, count, chip


def light(things: Sequence[Thing], exponent: float = 3.0, reach: float = 100.0) -> float:
    columns, count, chip = surfaces(things, reach)
    return reflected_light(columns, count, chip, lobe_of(exponent)) if count else 0.0


def cast(thing: Thing, cosines: np.ndarray, sines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [m] along horizontal rays to an object, inf for a miss, and cosines of incidence."""
    x, y, half = thing.x / 1e3, thing.y / 1e3, thing.half / 1e3
    if thing.width < 0:
        along, across = x * cosines + y * sines, x * sines - y * cosines
        depth = half * half - across**2
        hit, root = (depth > 0) & (along > 0), np.sqrt(np.maximum(depth, 0))
        return np.where(hit, along - root, np.inf), root / half
    lengths, incidences = np.full(cosines.shape, np.inf), np.zeros(cosines.shape)
    for turn, depth, wide in ((0, half, thing.width / 1e3), (90, thing.width / 1e3, half)):
        for side in (0, 180):
            angle = math.radians(thing.angle_deg + turn + side)
            c, s = math.cos(angle), math.sin(angle)
            gap, incidence = -(x * c + y * s) - depth, -(c * cosines + s * sines)
            if gap > 0:
                distance = gap / np.maximum(incidence, 1e-9)
                across = distance * (c * sines - s * cosines) - (c * y - s * x)
                hit = (incidence > 1e-9) & (np.abs(across) <= wide)
                lengths, incidences = np.where(hit, distance, lengths), np.where(hit, incidence, incidences)
    return lengths, incidences


def integral(
    things: Sequence[Thing], exponent: float = 3.0, n: int = 1600, narrowing: int = 0, mirror: float = 1.0
) -> float:
    """Return the light by rays in all directions, which the floor reflects upwards like a mirror."""
    azimuths = (np.arange(n) + 0.5) / n * math.pi - math.pi / 2
    cosines, sines, slopes = np.cos(azimuths), np.sin(azimuths), np.tan(azimuths)[:, None]
    integer = int(exponent)
    lobe = cosines**integer * (1 - (exponent - integer) * (1 - cosines))
    # The lobe in elevation, and four factors cos for an upright surface.
    elevation_weight = np.cos(azimuths)[:, None] ** (7 + 2 * narrowing)
    elevation_weight /= elevation_weight.sum()
    rays = [cast(thing, cosines, sines) for thing in things]
    order = np.argsort([lengths for lengths, _ in rays], axis=0)
    is_free, total = np.ones((n, n), bool), np.zeros((n, n))
    for rank in order:
        for index, thing in enumerate(things):
            lengths, incidences = rays[index]
            is_nearest = (rank == index) & np.isfinite(lengths)
            distances = np.where(is_nearest, lengths, 1.0)
            heights = SENSOR_HEIGHT + slopes * distances
            weights = np.where(heights < 0, mirror, 1.0) * thing.reflectance
            hit = is_free & is_nearest & (np.abs(heights) <= thing.top / 1e3)
            hit &= np.abs(heights) >= thing.bottom / 1e3
            total += hit * weights * (incidences / distances**2)
            is_free &= ~hit
    return float((total * elevation_weight * lobe).sum() * math.pi / n / lobes.norm(exponent))


@pytest.mark.parametrize("exponent", [0.0, 1.26, 3.0, 4.0])
def test_an_endless_wall_face_to_face_gives_the_inverse_square(exponent: float) -> None:
    for distance in (5, 15, 30, 60):
        assert light([wall(distance)], exponent) == pytest.approx(1e6 / distance**2, rel=1e-3)


def test_light_is_in_proportion_to_reflectance_and_falls_with_the_square_of_the_size() -> None:
    scene = [Thing(40, 5, 20, 15, 30, 1e6), Thing(30, -15, 9, top=1e6)]
    dark = [thing._replace(reflectance=0.4) for thing in scene]
    doubled = [
        thing._replace(x=2 * thing.x, y=2 * thing.y, half=2 * thing.half, width=2 * thing.width)
        for thing in scene
    ]
    assert light(dark) == pytest.approx(0.4 * light(scene))
    assert light(doubled) == pytest.approx(light(scene) / 4, rel=2e-3)


@pytest.mark.parametrize("angle_deg", [-75, -40, 20, 60, 85])
def test_an_oblique_wall_gives_the_integral_over_what_the_lobe_sees(angle_deg: float) -> None:
    # cos(phi) / d^2 is cos(phi)^3 over the square of the distance of the foot.
    azimuths = np.linspace(-math.pi / 2, math.pi / 2, 200_001)
    incidences = np.maximum(np.cos(azimuths - math.radians(angle_deg)), 0) ** 3
    expected = float((np.cos(azimuths) ** 2 * incidences).mean() * math.pi) / lobes.norm(2) / 0.02**2
    assert light([wall(20, angle_deg)], 2.0) == pytest.approx(expected, rel=2e-3)


SCENES = {
    "a cylinder ahead": [Thing(37, 0, 27)],
    "a cylinder near by": [Thing(30, 4, 27)],
    "a cylinder aside": [Thing(30, 40, 27)],
    "a rod": [Thing(10, 5, 2)],
    "a low cylinder": [Thing(30, 5, 15, top=8)],
    "a wall of 50 mm": [wall(15, top=50)],
    "a wall beside": [wall(20, 80, top=50)],
    "a corner": [wall(30, top=50), wall(40, 90, top=50)],
    "a rod before a wall": [Thing(10, 5, 2), wall(30, top=50)],
    "a dark cylinder before a white one": [Thing(25, 5, 8, reflectance=0.1), Thing(60, -5, 20)],
    "things that overlap": [Thing(40, 10, 20, 20, 25), Thing(30, -10, 20)],
}


@pytest.mark.share(4)
@pytest.mark.parametrize("exponent", [1.26, 3.4])
@pytest.mark.parametrize("name", SCENES)
def test_light_is_that_of_rays_in_all_directions(name: str, exponent: float) -> None:
    things = SCENES[name]
    assert light(things, exponent) == pytest.approx(integral(things, exponent), rel=0.01)


@pytest.mark.parametrize(("narrowing", "mirror"), [(2, 1.0), (0, 0.05), (3, 2.0)])
@pytest.mark.parametrize("name", ["a wall of 50 mm", "a low cylinder", "a rod before a wall"])
def test_narrow_lobes_and_floors_that_mirror_more_or_less_give_that_of_rays(
    name: str, narrowing: int, mirror: float
) -> None:
    columns, count, chip = surfaces(SCENES[name])
    true = reflected_light(columns, count, chip, lobe_of(3.4, narrowing, mirror))
    assert true == pytest.approx(integral(SCENES[name], 3.4, 1600, narrowing, mirror), rel=0.01)


PARTLY_SEEN = {
    "a low block": [Thing(35, 5, 15, 30, 20, top=8)],
    "a step before a wall": [Thing(25, 0, 5, 15, 10, top=8), wall(40, 5, top=50, reflectance=0.5)],
    "a wall of 50 mm far off": [wall(60, -30, top=50)],
    "a block seen by a corner": [Thing(45, 30, 15, 15, 70, top=20)],
    "low cylinders before a higher one": [Thing(20, 4, 6, top=6), Thing(24, -9, 7, top=9), Thing(60, 0, 25)],
}


@pytest.mark.parametrize("name", PARTLY_SEEN)
def test_the_heights_of_faces_and_of_what_hides_count_at_one_azimuth_which_is_nearly_all(name: str) -> None:
    assert light(PARTLY_SEEN[name]) == pytest.approx(integral(PARTLY_SEEN[name]), rel=0.05)


def random_things(rng: np.random.Generator, count: int = 6) -> list[Thing]:
    things: list[Thing] = []
    while len(things) < count:
        x, y = rng.uniform((5, -60), (80, 60)).tolist()
        half, width = rng.uniform(2, 20, 2).tolist()
        if math.hypot(x, y) > math.hypot(half, width) + 3:
            width = width if rng.random() < 0.5 else -1.0
            angle, top, reflectance = rng.uniform((0, 4, 0.05), (180, 50, 1)).tolist()
            things.append(Thing(x, y, half, width, angle, top, reflectance=reflectance))
    return things


@pytest.mark.share(2)
@pytest.mark.parametrize("scenes", [30, 60])
def test_in_random_scenes_light_is_within_few_per_cent_of_that_of_rays(scenes: int) -> None:
    rng = np.random.default_rng(1)
    errors: list[float] = []
    for _ in range(scenes):
        things, exponent = random_things(rng, int(rng.integers(1, 5))), float(rng.uniform(1, 4))
        expected = integral(things, exponent, 700)
        if expected > 30:
            errors.append(abs(light(things, exponent) / expected - 1))
    assert len(errors) > scenes / 2
    assert np.median(errors) < 0.003
    assert np.percentile(errors, 90) < 0.03
    assert max(errors) < 0.1


@pytest.mark.share(2)
@pytest.mark.parametrize("scenes", [60, 300])
def test_the_upper_bound_is_one_in_random_scenes(scenes: int) -> None:
    rng = np.random.default_rng(4)
    n_lit = 0
    for _ in range(scenes):
        exponent = float(rng.uniform(0, 6))
        columns, count, chip = surfaces(random_things(rng, int(rng.integers(1, 7))))
        lobe = lobe_of(exponent, count % 3, 1.0 + count % 2)
        true = reflected_light(columns, count, chip, lobe)
        n_left, bound = remove_faint(columns, count, lobe, 0.0)
        assert (n_left, reflected_light(columns, n_left, chip, lobe)) == (count, true)
        assert bound >= true
        n_lit += true > 0
    assert n_lit > scenes * 0.8


@pytest.mark.share(2)
@pytest.mark.parametrize("scenes", [60, 300])
def test_what_is_sifted_out_sends_back_less_than_it_is_sifted_by(scenes: int) -> None:
    rng = np.random.default_rng(7)
    n_removed = 0
    for _ in range(scenes):
        exponent, min_light = float(rng.uniform(0, 6)), float(10 ** rng.uniform(0, 2.7))
        columns, count, chip = surfaces(random_things(rng))
        lobe = lobe_of(exponent, count % 3, 1.0 + count % 2)
        true = reflected_light(columns, count, chip, lobe)
        n_left, bound = remove_faint(columns, count, lobe, min_light)
        remaining = reflected_light(columns, n_left, chip, lobe) if n_left else 0.0
        assert abs(true - remaining) <= (count - n_left) * min_light
        assert bound >= remaining
        n_removed += count - n_left
    assert n_removed > scenes / 2


def test_light_does_not_depend_on_the_order_of_things() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        things = random_things(rng)
        assert light(things[::-1]) == pytest.approx(light(things), rel=0.01)


def test_what_stands_behind_a_higher_thing_does_not_count() -> None:
    front = Thing(30, 3, 12, 25, 10, top=30)
    hidden = [Thing(50, 0, 6, top=29), Thing(55, 5, 5, 8, 30, top=20), Thing(75, 2, 5, 10, top=30)]
    for exponent in (0.0, 3.3):
        alone = light([front], exponent)
        assert light([front, *hidden], exponent) == alone
        # Found first, they cut its arc into pieces, each of which has its height at another azimuth.
        assert light([*hidden, front], exponent) == pytest.approx(alone, rel=0.01)
    low, higher = front._replace(top=15, reflectance=0.1), Thing(75, 2, 5, 10, top=50)
    assert light([low, higher]) > 1.05 * light([low])


def test_low_things_count_by_the_part_of_the_lobe_that_they_and_their_image_fill() -> None:
    def filled(top: float, distance: float) -> float:
        """Return the integral of cos^7 over the elevation between a top and its mirror image."""
        elevations = np.linspace(-1, 1, 20_001) * math.pi / 2
        heights = SENSOR_HEIGHT * 1e3 + distance * np.tan(elevations)
        return float((np.cos(elevations) ** 7 * (np.abs(heights) <= top)).mean() * math.pi * 35 / 32)

    heights = np.arange(0.5, 50, 0.5).tolist()
    rods = np.array([light([Thing(20, 0, 0.2, top=top)]) for top in heights])
    blocks = np.array([light([Thing(30, 3, 10, 15, 20, top=top)]) for top in heights])
    tall = light([Thing(20, 0, 0.2, top=1e6)])
    assert rods / tall == pytest.approx([filled(top, 19.8) for top in heights], abs=3e-3)
    for lights in (rods, blocks):
        steps = np.diff(lights) / lights[-1]
        assert (steps > 0).all()
        assert steps.max() < 0.035  # no jump where a thing comes up to the sensor's height
    assert 0.05 < blocks[9] / blocks[-1] < 0.25


def test_of_too_many_surfaces_the_nearest_are_kept_in_any_order() -> None:
    rods = [Thing(20 + 0.4 * i, 20 * math.sin(2.4 * i), 0.1) for i in range(N_SURFACES + 20)]
    nearest = sorted(rods, key=lambda rod: math.hypot(rod.x, rod.y) - rod.half)[:N_SURFACES]
    rng = np.random.default_rng(6)
    for _ in range(3):
        columns, count, _ = surfaces([rods[i] for i in rng.permutation(len(rods))])
        assert count == N_SURFACES
        distances = sorted(math.sqrt(square) * 1e3 for square in columns[SQUARE::N_COLUMNS])
        assert distances == pytest.approx([math.hypot(rod.x, rod.y) - rod.half for rod in nearest])


def test_light_fades_to_nothing_in_the_last_quarter_of_the_range() -> None:
    distances = np.arange(40, 62, 0.1).tolist()
    faded = np.array([light([Thing(distance, 0, 5)], reach=0.06) for distance in distances])
    full = np.array([light([Thing(distance, 0, 5)]) for distance in distances])
    assert faded / full == pytest.approx(np.clip(4 * (1 - (np.array(distances) - 5) / 60), 0, 1))


@pytest.mark.parametrize("thing", [Thing(1, 2, 10), Thing(1, 2, 10, 8, 30)])
def test_a_sensor_within_a_thing_gets_all_the_light_there_is(thing: Thing) -> None:
    assert light([thing]) > 1e7
    assert light([thing._replace(top=10)]) == 0


def tipped(kind: int, size: tuple[float, float, float], axis: int, angle_deg: float) -> list[float]:
    """Return an object with its third axis along `axis`, turned about the vertical [degrees, mm]."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    matrix = np.eye(3)[:, [[1, 2, 0], [2, 0, 1], [0, 1, 2]][axis]]
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ matrix
    centre, (cosine, sine), half, (bottom, top) = upright_shape(
        kind, size, (0.1, 0.2, 0.03), rotation.ravel().tolist()
    )
    assert centre == (0.1, 0.2)
    angle = math.degrees(math.atan2(sine, cosine)) % 180
    return [angle, *(value * 1e3 for value in (*half, bottom, top))]


CYLINDER, BOX = 5, 6


def test_what_has_tipped_over_counts_as_the_upright_thing_that_it_resembles() -> None:
    can, brick = (0.008, 0.02, 0.0), (0.02, 0.01, 0.005)
    assert tipped(CYLINDER, can, 2, 30)[1:] == pytest.approx([8, -1e3, 10, 50])
    # A lying cylinder is a box, as long as the cylinder was high.
    lying = tipped(CYLINDER, can, 0, 30)
    assert sorted(lying[1:3]) == pytest.approx([8, 20])
    assert lying[3:] == pytest.approx([22, 38])
    assert (lying[0] if lying[1] > lying[2] else (lying[0] + 90) % 180) == pytest.approx(30)
    for axis, half, height in ((2, (20, 10), 5), (0, (5, 20), 10), (1, (10, 5), 20)):
        shape = tipped(BOX, brick, axis, 0)
        assert sorted(shape[1:3]) == pytest.approx(sorted(half))
        assert shape[3:] == pytest.approx([30 - height, 30 + height])
