"""Fit of the infrared optics of a Khepera III to recordings before a white obstacle, and a comparison.

The table of recordings (`khepera3_bench`) is not part of the project; the first argument is its path. The
robot and the place of the obstacle are fitted to the rows above the black floor, without each third position.
Above the white floor only the place is fitted, likewise without each third position, and rows far from the
obstacle give the light of the floor. All sensors have one offset, one lobe, and a gain near that which the
light of the floor predicts. `--compare` compares all rows with a robot of the shipped calibration in MuJoCo's
scene.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration, lobes
from khep_twin.sensing.reflection import Lobe, reflected_light
from khep_twin.sensing.seen_surfaces import N_COLUMNS, N_SURFACES, Chip, add_upright
from studies.khepera3_bench import Bench, Floats, Recording, scene_counts
from tools.command_table import command_line

SENSORS = (2, 3, 4, 5)
"""Sensors that see the obstacle: two at 45 degrees and between them two in front."""

GAP_SPREAD_MM, ANGLE_SPREAD_DEG, GAIN_SPREAD, REST_SPREAD = 0.5, 1.0, 0.3, 2.0
"""Standard deviations of gap and angle of an obstacle that is placed by hand, of the logarithm of gains over
the light of the floor, and of the counts of the floor over those of far rows (all assumed)."""

FAR_MM = 300.0
"""Distance from which on readings are those of the floor alone [mm]."""

EXPONENT, MIRROR = 5, 1.5
"""Exponent of the lobe in azimuth and in elevation (assumed: 5 to 11 fit the black floor about equally well),
and weight of the images in a white floor: of those from 0.75 to 2, it fits the white floor best."""

MODEL = find_model("khepera3")
HEADINGS_DEG = calibration.read(MODEL.calibration)[0].heading_deg
BLACK = BUILT_IN_SURFACES["black"].reflectance
_LIMIT = 3980


@dataclass(frozen=True, slots=True)
class Optics:
    """Optics of a sensor: gain [counts m^2], offset [m], and counts of the floor."""

    gain: float
    offset: float
    rest: float


def light(sensor: int, offset: float, gaps: Floats, bench: Bench, reflectance: float) -> Floats:
    """Return the light from the obstacle to a sensor above a floor (n,) [1/m^2].

    Args:
        sensor: Number of the sensor.
        offset: Offset of its chip [m].
        gaps: Distances from the first position (n,) [mm].
        bench: Place of the obstacle.
        reflectance: Reflectance of the floor.
    """
    body, heading = MODEL.body, math.radians(HEADINGS_DEG[sensor])
    (x, y), c, s = body.sensor_positions[sensor], math.cos(heading), math.sin(heading)
    chip = Chip(x - offset * c, y - offset * s, c, s, body.sensor_height, 5.0)
    norm, table = lobes.norm(EXPONENT), lobes.table(EXPONENT)
    lobe = Lobe(
        EXPONENT, 0.0, norm, lobes.width(EXPONENT) / norm, table, EXPONENT // 2 - 1, MIRROR * reflectance
    )
    buffer, lights = [0.0] * (N_SURFACES * N_COLUMNS), list[float]()
    (x, y), direction, half_sizes, span = bench.shape
    for gap in gaps.tolist():
        shape = (x + gap * 1e-3, y), direction, half_sizes, span
        count = add_upright(buffer, 0, chip, shape, 1.0)
        lights.append(reflected_light(buffer, count, chip, lobe) if count else 0.0)
    return np.array(lights)


def counts(sensor: int, optics: Optics, gaps: Floats, bench: Bench, reflectance: float) -> Floats:
    """Return the mean readings of a sensor (n,) [counts]; the arguments are those of `light`."""
    level = optics.gain * light(sensor, optics.offset, gaps, bench, reflectance) + optics.rest
    level = np.maximum(level, 0)
    return level / (1 + (level / _LIMIT) ** 4) ** 0.25


def above(
    recording: Recording, gains: Sequence[float], offset: float, bench: Bench, reflectance: float
) -> dict[int, Optics]:
    """Return the optics above the floor of a recording, whose rows far from the obstacle give its counts."""
    far = recording[recording.gaps >= FAR_MM]
    optics: dict[int, Optics] = {}
    for sensor, gain in zip(SENSORS, gains, strict=True):
        obstacle = gain * light(sensor, offset, far.gaps, bench, reflectance)
        optics[sensor] = Optics(gain, offset, float((far.means[:, sensor] - obstacle).mean()))
    return optics


def errors(recording: Recording, optics: Mapping[int, Optics], bench: Bench, reflectance: float) -> Floats:
    """Return errors over a third of their tolerances, and the deviations of the obstacle's gap and angle."""
    # Far rows are many and alike. Some deviations, of ten readings, are too small.
    used = recording[(recording.gaps < 120) | (recording.positions % 5 == 0)]
    tolerances = np.maximum(used.tolerances, 12) / 3
    parts = [
        (counts(sensor, lens, used.gaps, bench, reflectance) - used.means[:, sensor]) / tolerances[:, sensor]
        for sensor, lens in optics.items()
    ]
    return np.concatenate([*parts, [bench.gap_mm / GAP_SPREAD_MM, bench.angle_deg / ANGLE_SPREAD_DEG]])


def fit(black: Recording, white: Recording) -> tuple[dict[int, Optics], Bench]:
    """Return the optics of the sensors that see the obstacle, and its place, above the black floor."""
    rests, white_rests = (part[part.gaps >= FAR_MM].means.mean(axis=0) for part in (black, white))
    floor_light = (white_rests - rests)[[*SENSORS]]

    def split(x: Floats) -> tuple[dict[int, Optics], Bench]:
        offset_mm, gap_mm, angle_deg, left_mm = x[:4].tolist()
        bench, gains = Bench(gap_mm, angle_deg, left_mm), 0.03 * floor_light * np.exp(x[8:])
        optics = above(black, gains.tolist(), offset_mm * 1e-3, bench, BLACK)
        shifts = zip(optics.items(), x[4:8].tolist(), strict=True)
        return {s: replace(lens, rest=lens.rest + shift) for (s, lens), shift in shifts}, bench

    def residuals(x: Floats) -> Floats:
        priors = x[4:8] / REST_SPREAD, (x[8:] - x[8:].mean()) / GAIN_SPREAD
        return np.concatenate([errors(black, *split(x), BLACK), *priors])

    start = [3.0, 0.0, 0.0, 100.0] + [0.0] * 8
    scale = [2.0, 1.0, 2.0, 20.0] + [2.0] * 4 + [0.3] * 4
    return split(least_squares(residuals, start, x_scale=scale, diff_step=1e-4).x)


def place(optics: Mapping[int, Optics], bench: Bench, white: Recording) -> tuple[dict[int, Optics], Bench]:
    """Return the optics of sensors of known gain, and the place of the obstacle, above the white floor.

    Args:
        optics: Optics of the sensors above another floor.
        bench: Place of the obstacle there.
        white: Recording above the white floor.
    """
    gains, offset = [lens.gain for lens in optics.values()], optics[SENSORS[0]].offset

    def split(x: Floats) -> tuple[dict[int, Optics], Bench]:
        gap_mm, angle_deg, left_mm = x.tolist()
        moved = Bench(gap_mm, angle_deg, left_mm)
        return above(white, gains, offset, moved, 1.0), moved

    def residuals(x: Floats) -> Floats:
        return errors(white, *split(x), 1.0)

    start = [bench.gap_mm, bench.angle_deg, bench.left_mm]
    return split(least_squares(residuals, start, x_scale=[1.0, 2.0, 20.0], diff_step=1e-4).x)


def show_shares(title: str, recording: Recording, readings: Mapping[int, Floats]) -> None:
    """Print the share of rows that readings meet, by sensor and in all."""
    shares = {sensor: recording.is_met(sensor, values).mean() for sensor, values in readings.items()}
    text = ", ".join(f"{sensor} {share:.0%}" for sensor, share in shares.items())
    print(f"{title:24} {text}, all {np.mean(list(shares.values())):.1%}")


def show_calibration(
    black: Recording, white: Recording, optics: Mapping[int, Optics], above_white: Mapping[int, Optics]
) -> None:
    """Print the values of the calibration; gains of other sensors are in proportion to the floor's light."""
    rests, white_rests = (part[part.gaps >= FAR_MM].means.mean(axis=0) for part in (black, white))
    for sensor, lens in optics.items():
        rests[sensor], white_rests[sensor] = lens.rest, above_white[sensor].rest
    floor_light = (white_rests - rests) / (1 - BLACK)
    gain = math.exp(np.mean([math.log(lens.gain / floor_light[s]) for s, lens in optics.items()]))
    gains = [optics[s].gain if s in optics else gain * light for s, light in enumerate(floor_light)]
    print("gain_counts_mm2 =", [round(float(gain) * 1e6, -3) for gain in gains])
    print("threshold_counts =", (-np.round(white_rests, 1)).tolist())
    print("floor_light_counts =", np.round(floor_light, 1).tolist())
    print("offset_mm =", [round(optics[SENSORS[0]].offset * 1e3, 1)] * len(gains))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("recordings", type=Path, help="table of the recordings")
    parser.add_argument("--compare", action="store_true", help="compare all rows with a scene in MuJoCo")
    options = parser.parse_args()
    recordings = {floor: Recording.read(options.recordings, floor) for floor in ("black", "white")}
    if options.compare:
        for floor, recording in recordings.items():
            readings = scene_counts(recording.gaps, floor)
            for title, rows in (("fitted", recording.is_fitted), ("held out", ~recording.is_fitted)):
                part = {sensor: values[rows] for sensor, values in readings.items()}
                show_shares(f"{floor} floor, {title}", recording[rows], {s: part[s] for s in (2, 3, 4, 5)})
                show_shares(f"{floor} floor, {title}", recording[rows], part)
        return
    black, white = (recording[recording.is_fitted] for recording in recordings.values())
    optics, bench = fit(black, white)
    above_white, white_bench = place(optics, bench, white)
    print(bench, white_bench, sep="\n")
    show_calibration(black, white, optics, above_white)
    show_shares("black floor", black, {s: counts(s, o, black.gaps, bench, BLACK) for s, o in optics.items()})
    readings = {s: counts(s, o, white.gaps, white_bench, 1.0) for s, o in above_white.items()}
    show_shares("white floor", white, readings)
