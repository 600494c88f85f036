"""Comparison of the twin with reality, as a row of `docs/fidelity.md`, and functions for its measures."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Figures of a comparison, in its unit; less is better.

    Attributes:
        figure: Deviation of the twin from the robot.
        floor: Deviation that the robot's noise leaves to a perfect twin; None if unknown.
        peers: Deviations of other simulators by name.
        note: Further figures or a remark.
    """

    figure: float
    floor: float | None = None
    peers: Mapping[str, float] = field(default_factory=dict[str, float])
    note: str = ""


@dataclass(frozen=True, slots=True)
class Comparison:
    """A comparison of the twin with measurements.

    Attributes:
        name: Compared quantity.
        source: Origin of the measurements.
        basis: Values that were fitted to them; starts with "predicted" if nothing was.
        unit: Unit of the figures.
        measure: Function of the folder of the measured tables that makes the comparison.
    """

    name: str
    source: str
    basis: str
    unit: str
    measure: Callable[[Path], Outcome]

    @property
    def is_predicted(self) -> bool:
        """True if nothing of the twin was fitted to the measurements."""
        return self.basis.startswith("predicted")


def short(value: float) -> str:
    """Return a number with two digits, and all of those before the point."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"


def noise_variance(readings: Floats, order: int = 2) -> Floats:
    """Return the variance of the noise along the last axis, by differences, which a smooth curve lacks."""
    differences = np.diff(readings, order, axis=-1)
    return (differences**2).mean(axis=-1) / math.comb(2 * order, order)


def read_at_rest(playpen: Playpen, starts: Floats) -> tuple[Floats, Floats]:
    """Return the twin's proximity and ambient counts without noise at poses of its robots, each (n, 8).

    Args:
        playpen: Playpen; the first robot reads.
        starts: Poses x, y [mm] and heading [deg] (n, 3), or of each robot (n, n_robots, 3).
    """
    episode = Episode(EpisodeSetup(playpen))
    counts: list[tuple[list[int], list[int]]] = []
    for start in starts.tolist():
        episode.begin(options=EpisodeOptions(start=start, noise=False))
        counts.append(episode.readings())
    return np.array([reading[0] for reading in counts], float), np.array(
        [reading[1] for reading in counts], float
    )


def columns(path: Path, kind: type | None = None) -> Any:
    """Return a table's columns by name, each with its type or all with one type; words become NaN."""
    return np.genfromtxt(path, delimiter=",", names=True, dtype=kind, encoding="utf-8")
