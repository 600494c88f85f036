"""Figure of a fit over its data."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from collections.abc import Sequence

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from khep_twin.drawing.map import STYLE, blank_figure
from khep_twin.drawing.symbols import INK
from khep_twin.lab.fit.fit_inputs import FitTests, SensorData
from khep_twin.lab.fit.motor_fit import DutyDrive, simulate
from khep_twin.lab.fit.placement import IN_PLACE
from khep_twin.lab.fit.robot_fit import RobotFit, simulate_readings
from khep_twin.sensing.calibration import Calibration
from khep_twin.units import SENSOR_LABELS

_COLOURS = ("#e4572e", "#4dabf7", "#5c9e3a", "#9775c9", "#b8860b", "#2aa198")
_UNITS = {"linear": "distance driven [cm]", "rotational": "turned [degrees]"}
_ROW_HEIGHT, _MARGIN, _DRIVE_HEIGHT = 1.75, 0.85, 2.6


def draw_fit(tests: FitTests, fit: RobotFit) -> Figure | None:
    """Draw sensor tests and drives with fixed duties as dots, and the fitted twin as lines.

    Returns:
        The figure; None if only measured drives were fitted.
    """
    kinds: dict[tuple[str, str], list[SensorData]] = {}
    for data in (*tests.objects, *tests.lamps):
        kinds.setdefault((data.run.test.what, data.run.test.motion), []).append(data)
    heights = [2 * _ROW_HEIGHT + _MARGIN] * len(kinds) + [_DRIVE_HEIGHT] * len(tests.motors)
    if not heights:
        return None
    with matplotlib.style.context(STYLE):
        figure = blank_figure(10, sum(heights), "constrained")
        rows = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
        parts: list[SubFigure] = rows[:, 0].tolist()
        for part, (kind, runs) in zip(parts, kinds.items(), strict=False):
            _draw_sensors(part, *kind, runs, fit)
        for part, drive in zip(parts[len(kinds) :], tests.motors, strict=True):
            _draw_speeds(part, fit.drives.get(drive.name, drive), fit.calibration)
    return figure


def _draw_sensors(part: SubFigure, kind: str, motion: str, runs: Sequence[SensorData], fit: RobotFit) -> None:
    """Draw eight panels, one per sensor."""
    panels: list[Axes] = list(part.subplots(2, 4, sharex=True, sharey=True).ravel())
    for index, data in enumerate(runs):
        colour = _COLOURS[index % len(_COLOURS)]
        model = simulate_readings(data, fit.calibration, fit.misplacements.get(data.name, IN_PLACE))
        order = np.argsort(data.run.travelled, kind="stable")
        for axes, counts, line in zip(panels, data.counts.T, model.T, strict=True):
            axes.plot(data.run.travelled, counts, ".", ms=2.5, color=colour, alpha=0.55)
            axes.plot(data.run.travelled[order], line[order], color=colour, lw=1.3, label=data.name)
    for axes, name in zip(panels, SENSOR_LABELS, strict=True):
        axes.set_title(name, fontsize=9, color=INK)
    part.supxlabel(_UNITS[motion], fontsize=9)
    part.supylabel("ambient [counts]" if kind == "light" else "proximity [counts]", fontsize=9)
    lines, labels = panels[0].get_legend_handles_labels()
    part.legend(lines, labels, loc="outside upper center", ncols=3, fontsize=7, frameon=False)


def _draw_speeds(part: SubFigure, drive: DutyDrive, calibration: Calibration) -> None:
    """Draw the speeds of the wheels with fixed duties."""
    axes = part.subplots(1, 1)
    measured, twin = drive.speeds(drive.values), simulate(drive, calibration)
    order = np.argsort(drive.times, kind="stable")
    for side, name in enumerate(("left", "right")):
        axes.plot(drive.times, measured[:, side], ".", ms=3, color=_COLOURS[side], alpha=0.6)
        axes.plot(drive.times[order], twin[order, side], color=_COLOURS[side], lw=1.3, label=name)
    axes.set_xlabel("time [s]", fontsize=9)
    axes.set_ylabel("speed [pulses/10 ms]", fontsize=9)
    axes.set_title(drive.name, fontsize=9, color=INK)
    axes.legend(fontsize=7, frameon=False)
