"""Plot of the twin's infrared sensors over the real robot's: `python -m studies infrared-picture FILE`.

Means on axis per distance, and the responses published by other simulators of this robot; the tables are
located as in `studies.infrared_fits`.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from khep_twin.lab.fit.infrared import Optics
from khep_twin.sensing import calibration
from khep_twin.units import Sensor
from studies.infrared_fits import on_axis, proximity, reference, rms, sampled
from tools.command_table import command_line

PEERS = {
    "Webots": ([0, 50], [1023, 0]),
    "Enki": ([0, 5, 10, 15, 20, 30, 40, 50], [1061, 911, 758, 622, 509, 347, 246, 181]),
    "Michel's simulator": ([12, 20, 32, 44, 58], [900, 750, 650, 160, 40]),
}
"""Counts over distance [mm] before a wall straight ahead, as their sources have them: one for all sensors."""

_INK, _GREY = "#1b4965", "#9a9a9a"
_STYLES = ("--", ":", "-.")


def draw(target: Path) -> None:
    """Draw all sensors; print the rms of each curve."""
    khepera1 = calibration.read("khepera1")[0]
    tables = sampled(reference())
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    panels = figure.subplots(2, 4, sharex=True, sharey=True).ravel()
    order = [0, 1, 2, 7, 5, 4, 3, 6]
    for panel, sensor in zip(panels, order, strict=True):
        heading = float(np.radians(khepera1.heading_deg[sensor]))
        optics = Optics.of(khepera1.proximity, sensor)
        lines = [Sensor(sensor).label]
        for table, name, colour in zip(tables, ("wall", "cylinder r 27 mm"), (_INK, "#e4572e"), strict=True):
            axis, millimetres = on_axis(table, sensor), np.unique(table.distances) * 1e3
            measured = axis @ table.counts[:, sensor]
            modelled = axis @ proximity(table.view(sensor, heading), optics)
            panel.plot(millimetres, measured, "o", ms=3.5, color=colour, label=f"{name}, robot")
            panel.plot(millimetres, modelled, color=colour, lw=1.6, label=f"{name}, twin")
            lines.append(f"{name.split()[0]} {rms([modelled - measured]):.0f}")
            if table.radius == 0:
                for (peer, (positions, counts)), style in zip(PEERS.items(), _STYLES, strict=True):
                    curve = np.clip(np.interp(millimetres, positions, counts), 0, 1023)
                    panel.plot(millimetres, curve, style, color=_GREY, lw=1.2, label=f"wall, {peer}")
                    lines.append(f"{peer} {rms([curve - measured]):.0f}")
        panel.set_title(lines[0], fontsize=10)
        panel.text(
            0.97,
            0.95,
            "rms [counts]\n" + "\n".join(lines[1:]),
            transform=panel.transAxes,
            ha="right",
            va="top",
            fontsize=7.5,
            bbox={"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1},
        )
        panel.spines[["top", "right"]].set_visible(False)
        print("  ".join(lines))
    for panel in panels[4:]:
        panel.set_xlabel("robot's edge to object [mm]")
    for panel in panels[::4]:
        panel.set_ylabel("proximity [counts]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=8.5)
    figure.savefig(target, dpi=110)


def main() -> None:
    """Draw the picture into a file."""
    parser = command_line(__doc__)
    parser.add_argument("file", type=Path)
    draw(parser.parse_args().file)
