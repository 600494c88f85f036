"""Comparison of the sampled robot's proximity noise with that of a twin of its room.

The tables come from the folder that KHEP_TWIN_REFERENCE_DATA names, as in `infrared_fits`. Their readings
have a ripple that advances by a quarter of a period from one sensor to the next, which is converted 2.5 ms
later. It is the 100 Hz flicker of the room's lighting. The twin of the room has a lamp overhead that
flickers, and its robot is turned as the sampled one was.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import comb

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.planar_world import PlanarWorld
from khep_twin.playpen import Lamp, Playpen, parse
from khep_twin.sensing.optics import convert
from khep_twin.sensing.scene import step
from studies.infrared_fits import CYLINDER_RADIUS, reference
from tools.command_table import command_line

Floats = NDArray[np.float64]

ORDERS = 2, 4, 6
"""Orders of the differences."""

LOW, HIGH = 15, 850
"""Readings between which the noise shows [counts]; above, the twin's lamp lowers the limit."""

N_BEARINGS = 180
DISTANCES_MM = tuple(range(5, 45, 2))
"""Distances at which the robot was sampled, from its edge [mm]."""

SCANS = 3
"""Scans from one sampled bearing to the next (assumed); the ripple is the same for any number of them."""

PERIOD = 4.66
"""Bearings in a period of the ripple, as measured."""

LAMP_W, LAMP_MM = 345.0, 1000.0
"""Power and height of the lamp, all of whose light flickers: fitted to the ripple's amplitude."""

BEARING_SD_DEG = 0.3
"""Standard deviation of the sampled bearings [deg]: noise is larger if readings change fast with them."""

_SIDE_MM = 1000
_SHORTEST = 12
_NEAR = 14
_TURN_NS = SCANS * units.SCAN_NS


def differences(counts: Floats, order: int, low: float = LOW, high: float = HIGH) -> float:
    """Return the rms of the differences of an order along the bearings, scaled for white noise [counts].

    Args:
        counts: Readings (n_distances, n_bearings, 8).
        order: Order of the differences.
        low: Lower limit of the readings that count.
        high: Upper limit of the readings that count.
    """
    wrapped = np.concatenate([counts, counts[:, :order]], axis=1)
    inside = np.lib.stride_tricks.sliding_window_view((wrapped > low) & (wrapped < high), order + 1, axis=1)
    values = np.diff(wrapped, n=order, axis=1)[inside.all(-1)]
    return float(np.sqrt((values**2).mean() / comb(2 * order, order)))


@dataclass(frozen=True, slots=True)
class Ripple:
    """Ripple of readings along the bearings.

    Attributes:
        period: Period [bearings].
        amplitude: Amplitude [counts].
        lead_deg: Phase by which each sensor leads the one before it in the scan [deg].
        coherence: Length of the mean of those phases as unit vectors: 1 if all are equal, 0 if random.
    """

    period: float
    amplitude: float
    lead_deg: float
    coherence: float


def ripple(counts: Floats) -> Ripple:
    """Return the ripple of readings (n_distances, n_bearings, 8), by least squares."""
    stretches = list(_stretches(counts))
    frequencies = np.arange(0.1, 0.45, 0.001)
    left = [sum(_waves(at, values, f)[1] for *_, at, values in stretches) for f in frequencies]
    best = float(frequencies[int(np.argmin(left))])
    waves = [
        (row, sensor, bearings.mean(), _waves(bearings, values, best)[0])
        for row, sensor, bearings, values in stretches
    ]
    leads = [
        next_wave * wave.conjugate()
        for row, sensor, middle, wave in waves
        for other, later, centre, next_wave in waves
        if row == other and later == sensor + 1 and abs(centre - middle) <= _NEAR
    ]
    amplitude = np.sqrt(np.mean([abs(wave) ** 2 for *_, wave in waves]))
    units_of = [lead / abs(lead) for lead in leads]
    return Ripple(
        1 / best, float(amplitude), float(np.degrees(np.angle(sum(leads)))), float(abs(np.mean(units_of)))
    )


def twin(
    target: str,
    *,
    noise: float | None = None,
    lamp_w: float = LAMP_W,
    bearing_sd_deg: float = BEARING_SD_DEG,
    distances_mm: Sequence[int] = DISTANCES_MM,
    seed: int = 0,
) -> Floats:
    """Return the readings of a twin that is turned in the room (n_distances, n_bearings, 8).

    Args:
        target: "wall" or "cylinder".
        noise: Standard deviation of one reading [counts]; the calibration's if not given.
        lamp_w: Power of the lamp [W].
        bearing_sd_deg: Standard deviation of the bearings [deg].
        distances_mm: Distances from the robot's edge to the target [mm].
        seed: Seed of the noise, the bearings and of the mains' phases.
    """
    world, rng = _room(), np.random.default_rng(seed)
    sensors, simulation = world.simulation.plain.groups[0][0].sensors, world.simulation
    if noise is not None:
        sensors = sensors._replace(proximity=sensors.proximity._replace(noise=[noise] * units.N_SENSORS))
    readings = np.zeros((len(distances_mm), N_BEARINGS, units.N_SENSORS))
    for row, distance_mm in enumerate(distances_mm):
        away_mm = units.BODY_RADIUS * 1e3 + distance_mm
        x_mm = _SIDE_MM - away_mm if target == "wall" else _SIDE_MM / 2 + CYLINDER_RADIUS * 1e3 + away_mm
        lamp = Lamp(x_mm=x_mm, y_mm=_SIDE_MM / 2, z_mm=LAMP_MM, power_w=lamp_w, flicker=1.0)
        world.reset(int(rng.integers(1 << 31)), starts=[(x_mm, _SIDE_MM / 2, 0)], lamps=[lamp])
        plain, joints = simulation.plain, world.forms.state["joints"]
        light, start = plain.light, 0.0 if target == "wall" else np.pi
        errors = np.radians(bearing_sd_deg) * rng.standard_normal(N_BEARINGS)
        for index in range(N_BEARINGS):
            for channel in range(units.N_SENSORS):
                time_ns = index * _TURN_NS + channel * units.STEP_NS
                joints[2] = start + errors[index] + 2 * np.pi * time_ns / _TURN_NS / N_BEARINGS
                step(plain.scene)
                draws = rng.standard_normal(), 0.0, rng.standard_exponential()
                powers = simulation.inputs.powers[0]
                readings[row, index, channel], _ = convert(
                    plain.scene, sensors, light, powers, time_ns, channel, draws
                )
    return readings


def sampled() -> dict[str, Floats]:
    """Return the readings of the sampled robot (n_distances, n_bearings, 8) by target."""
    readings_by_target: dict[str, Floats] = {}
    for target, name in (("wall", "wall"), ("cylinder", "round")):
        path = reference() / "data" / f"evorobot_{name}_samples.csv"
        rows = np.genfromtxt(path, delimiter=",", skip_header=1)
        readings_by_target[target] = rows[:, 2:].reshape(-1, N_BEARINGS, units.N_SENSORS)
    return readings_by_target


def main() -> None:
    """Print the figures of robot and twin side by side."""
    command_line(__doc__).parse_args()
    print(f"{'':22} differences of order {ORDERS} [counts]   period, amplitude, lead, coherence")
    for target, counts in sampled().items():
        for name, readings in (("robot", counts), ("twin", twin(target))):
            levels = "  ".join(f"{differences(readings, order):5.1f}" for order in ORDERS)
            wave = ripple(readings)
            print(
                f"{target:10} {name:10}  {levels}    {wave.period:.2f} bearings, "
                f"{wave.amplitude:.0f} counts, {wave.lead_deg:.0f} deg, {wave.coherence:.2f}"
            )


@cache
def _room() -> PlanarWorld:
    """Return a world with a wall, a cylinder and mains of the measured frequency, by the robot's clock."""
    cycles = round(_TURN_NS * 1e-7) + 1 / PERIOD
    text = (
        f'version = 1\nname = "room"\n[arena]\nwidth_mm = {_SIDE_MM}\nheight_mm = {_SIDE_MM}\n'
        f"[lighting]\nmains_hz = {cycles / _TURN_NS * 5e8:.9f}\n"
        f"[[cylinder]]\nx_mm = {_SIDE_MM / 2}\ny_mm = {_SIDE_MM / 2}\nradius_mm = {CYLINDER_RADIUS * 1e3}\n"
        "height_mm = 50\n[[robot]]\nx_mm = 200\ny_mm = 200\nheading_deg = 0\n"
    )
    scene: Playpen = parse(text, "room")
    setup = EpisodeSetup(scene, step_ns=units.STEP_NS, planar=True)
    assert setup.planar_scene is not None
    return PlanarWorld(setup.scene_model, setup.planar_scene)


def _stretches(counts: Floats) -> Iterator[tuple[int, int, Floats, Floats]]:
    """Yield stretches of unclipped readings: row, sensor, bearings and readings."""
    for row, readings in enumerate(counts):
        for sensor in range(units.N_SENSORS):
            inside = (readings[:, sensor] > LOW) & (readings[:, sensor] < HIGH)
            edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
            for first, end in zip(edges[::2], edges[1::2], strict=True):
                if end - first >= _SHORTEST:
                    yield row, sensor, np.arange(first, end, dtype=float), readings[first:end, sensor]


def _waves(bearings: Floats, values: Floats, frequency: float) -> tuple[complex, float]:
    """Return a wave's complex amplitude in a stretch, beside a polynomial, and the squares left over."""
    degree = min(6, len(bearings) // 4)
    smooth = np.vander((bearings - bearings.mean()) / len(bearings), degree + 1)
    turn = 2 * np.pi * frequency * bearings
    matrix = np.column_stack([smooth, np.cos(turn), np.sin(turn)])
    x = np.linalg.lstsq(matrix, values)[0]
    return complex(x[-2], -x[-1]), float(((values - matrix @ x) ** 2).sum())
