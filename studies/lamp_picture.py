"""Plot of the twin's receivers over the real robot's: `python -m studies lamp-picture FILE`.

Readings of a lamp of 2 W over its distance, means within 10 degrees of the receiver's axis; and over its
bearing, 213 mm away. The tables are located as in `studies.infrared_fits`.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from khep_twin.lab.fit.lamp_fit import LampPositions, ambient_counts
from khep_twin.sensing import calibration
from khep_twin.units import Sensor
from studies.infrared_fits import reference
from studies.lamp_fits import sampled_lamp
from tools.command_table import command_line

_INK, _RED, _GREY = "#1b4965", "#e4572e", "#9a9a9a"
_AWAY = 0.213


def draw(target: Path) -> None:
    """Draw all sensors."""
    ambient = calibration.read("khepera1")[0].ambient
    distances, test = sampled_lamp(reference())
    lamp, (_, bearings) = LampPositions.of(test), test.placement.object_positions()
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    panels = figure.subplots(2, 4, sharey=True).ravel()
    for panel, sensor in zip(panels, [0, 1, 2, 7, 5, 4, 3, 6], strict=True):
        counts, modelled = test.counts[:, sensor], ambient_counts(lamp, sensor, ambient)
        tangential = np.angle(np.exp(1j * (bearings - np.radians(ambient.heading_deg[sensor]))))
        near = np.abs(tangential) <= np.radians(10)
        positions = np.unique(distances)
        means = [
            [values[near & (distances == position)].mean() for position in positions]
            for values in (counts, modelled)
        ]
        panel.plot(positions * 1e3, means[0], "o", ms=3.5, color=_INK, label="over distance [mm], robot")
        panel.plot(positions * 1e3, means[1], color=_INK, lw=1.6, label="over distance [mm], twin")
        # Michel's simulator publishes this for a lamp straight ahead, the same for any power.
        michel = np.where(positions < 0.25, 500 - 450 * (1 - positions / 0.25), 500)
        panel.plot(
            positions * 1e3, michel, "--", color=_GREY, lw=1.2, label="over distance, Michel's simulator"
        )
        turn = np.isclose(distances, _AWAY)
        order = np.argsort(tangential[turn])
        degrees = np.degrees(tangential[turn][order])
        upper = panel.twiny()
        upper.plot(degrees, counts[turn][order], ".", ms=3, color=_RED)
        upper.plot(degrees, modelled[turn][order], color=_RED, lw=1.3)
        upper.set_xticks([-180, -90, 0, 90, 180])
        upper.tick_params(axis="x", colors=_RED, labelsize=8)
        name = Sensor(sensor).label
        panel.set_title(name, fontsize=10)
        panel.text(
            0.97,
            0.04,
            "red: bearing off\nthe axis [degrees]",
            transform=panel.transAxes,
            ha="right",
            fontsize=7.5,
            color=_RED,
        )
    figure.supylabel("ambient light [counts]; dark is high", fontsize=10)
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    figure.savefig(target, dpi=110, metadata={"Software": None})


def main() -> None:
    """Draw the picture into a file."""
    parser = command_line(__doc__)
    parser.add_argument("file", type=Path)
    draw(parser.parse_args().file)
