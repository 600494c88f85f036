"""Comparisons of the noise of proximity."""

from functools import partial
from pathlib import Path

import numpy as np

from khep_twin.board.kernel import PROXIMITY
from khep_twin.playpen import Arena, Playpen, RobotEntry
from khep_twin.units import SCAN_NS
from khep_twin.world import World
from studies.fidelity_comparison import Comparison, Floats, Outcome
from studies.khepera2_fits import REST_MEAN, REST_RANGE, noise_at_rest, pykhepera_wall
from studies.noise_fits import ORDERS, differences, sampled, twin

_SAMPLES = "samples of one Khepera, CNR Rome"


def noise(folder: Path, target: str) -> Outcome:
    """Compare the differences of three orders along the bearings with those of a twin in the same light."""
    measured, modelled = sampled()[target], twin(target)
    levels = [(differences(measured, order), differences(modelled, order)) for order in ORDERS]
    relative_errors = [model / level - 1 for level, model in levels]
    levels_text = ", ".join(f"{model:.0f} for {level:.0f}" for level, model in levels)
    return Outcome(float(np.abs(relative_errors).max()) * 100, note=f"orders 2, 4, 6: {levels_text} counts")


def khepera2_at_rest(scans: int = 1000, seed: int = 1) -> Floats:
    """Return readings of a Khepera II with nothing in reach, one scan after the other (n, 8) [counts]."""
    robot = RobotEntry(x_mm=1000, y_mm=1000, heading_deg=0, model="khepera2", calibration="khepera2")
    arena = Arena(width_mm=2000, height_mm=2000)
    world = World(Playpen(version=1, name="empty", arena=arena, robot=(robot,)), seed=seed)
    readings: list[list[int]] = []
    for scan in range(scans):
        world.advance_to((scan + 1) * SCAN_NS)
        readings.append(world.robots[0].registers[PROXIMITY].tolist())
    return np.array(readings, float)


def khepera2_noise(folder: Path) -> Outcome:
    """Compare the noise of a Khepera II at rest with that of pykhepera's robot from day to day."""
    within, between = noise_at_rest(pykhepera_wall(folder))
    twin_noise = float(np.sqrt(khepera2_at_rest().var(axis=0).mean()))
    note = f"{twin_noise:.0f} counts for {between:.0f} from day to day, {within:.1f} within a day"
    return Outcome(abs(twin_noise - between), note=note)


def khepera2_rest(_: Path) -> Outcome:
    """Compare the mean reading of a Khepera II at rest with that of a robot that was not fitted."""
    twin_means = khepera2_at_rest().mean(axis=0)
    low, high = REST_RANGE
    note = (
        f"{twin_means.mean():.0f} for {REST_MEAN}; by sensor "
        f"{twin_means.min():.0f} to {twin_means.max():.0f} for {low} to {high}"
    )
    return Outcome(abs(float(twin_means.mean()) - REST_MEAN), note=note)


_KHEPERA2 = (
    Comparison(
        "noise of a Khepera II far from a wall",
        "pykhepera's calibration on five days, Edinburgh 2013",
        "fitted: between the noise within a day and from day to day",
        "counts",
        khepera2_noise,
    ),
    Comparison(
        "a Khepera II with nothing in reach, mean of its sensors",
        "koshov/IAR-Khepera-Python-comms, means of a hundred readings, Edinburgh",
        "predicted by two other robots",
        "counts",
        khepera2_rest,
    ),
)

COMPARISONS = (
    tuple(
        Comparison(
            f"noise before a {target}, largest of three orders",
            _SAMPLES,
            "fitted: white noise, flicker of the lamp, error of the bearings",
            "%",
            partial(noise, target=target),
        )
        for target in ("wall", "cylinder")
    )
    + _KHEPERA2
)
"""Comparisons of noise, in the page's order."""
