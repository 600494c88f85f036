"""Figure of a fit over its data."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from collections.abc import Sequence
from pathlib import Path

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

_COLOURS = ("#e4572e", "#4dabf7", "#5c9e3a", "#9775c9", "#b8860b", "#2aa198")
_UNITS = {"linear": "distance driven [cm]", "rotational": "turned [degrees]"}
_ROW_HEIGHT, _MARGIN, _DRIVE_HEIGHT = 1.75, 0.85, 2.6  # [inch]


def draw_fit(tests: FitTests, fit: RobotFit) -> Figure | None:
    """Draw sensor tests and drives with fixed duties as dots, and the fitted twin as lines.

    Returns:
        The figure; None if only measured drives were fitted.
    """
    tests_by_kind: dict[tuple[str, str], list[SensorData]] = {}
    for data in (*tests.objects, *tests.lamps):
        tests_by_kind.setdefault((data.run.test.what, data.run.test.motion), []).append(data)
    heights = [2 * _ROW_HEIGHT + _MARGIN] * len(tests_by_kind) + [_DRIVE_HEIGHT] * len(tests.motors)
    if not heights:
        return None
    with matplotlib.style.context(STYLE):
        figure = blank_figure(10, sum(heights), "constrained")
        rows = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
        subfigures: list[SubFigure] = rows[:, 0].tolist()
        for subfigure, (kind, runs) in zip(subfigures, tests_by_kind.items(), strict=False):
            _draw_sensors(subfigure, *kind, runs, fit)
        for subfigure, drive in zip(subfigures[len(tests_by_kind) :], tests.motors, strict=True):
            _draw_speeds(subfigure, fit.drives.get(drive.name, drive), fit.calibration)
    return figure


def _draw_sensors(
    subfigure: SubFigure, kind: str, motion: str, tests: Sequence[SensorData], fit: RobotFit
) -> None:
    """Draw a panel per sensor."""
    n_columns = (len(fit.calibration.heading_deg) + 1) // 2
    panels: list[Axes] = list(subfigure.subplots(2, n_columns, sharex=True, sharey=True).ravel())
    for index, test in enumerate(tests):
        colour = _COLOURS[index % len(_COLOURS)]
        model = simulate_readings(test, fit.calibration, fit.misplacements.get(test.name, IN_PLACE))
        by_travel = np.argsort(test.run.travelled, kind="stable")
        for axes, counts, line in zip(panels[: model.shape[1]], test.counts.T, model.T, strict=True):
            axes.plot(test.run.travelled, counts, ".", ms=2.5, color=colour, alpha=0.55)
            label = Path(test.name).name
            axes.plot(test.run.travelled[by_travel], line[by_travel], color=colour, lw=1.3, label=label)
    names = tests[0].model.body.ring_sensors
    for axes, name in zip(panels[: len(names)], names, strict=True):
        axes.set_title(name, fontsize=9, color=INK)
    subfigure.supxlabel(_UNITS[motion], fontsize=9)
    subfigure.supylabel("ambient [counts]" if kind == "light" else "proximity [counts]", fontsize=9)
    lines, labels = panels[0].get_legend_handles_labels()
    subfigure.legend(lines, labels, loc="outside upper center", ncols=3, fontsize=7, frameon=False)


def _draw_speeds(subfigure: SubFigure, drive: DutyDrive, calibration: Calibration) -> None:
    """Draw the speeds of the wheels with fixed duties."""
    axes = subfigure.subplots(1, 1)
    measured, twin = drive.speeds(drive.values), simulate(drive, calibration)
    by_time = np.argsort(drive.speed_times_s, kind="stable")
    for side, name in enumerate(("left", "right")):
        axes.plot(drive.speed_times_s, measured[:, side], ".", ms=3, color=_COLOURS[side], alpha=0.6)
        axes.plot(drive.speed_times_s[by_time], twin[by_time, side], color=_COLOURS[side], lw=1.3, label=name)
    axes.set_xlabel("time [s]", fontsize=9)
    axes.set_ylabel("speed [pulses/10 ms]", fontsize=9)
    axes.set_title(Path(drive.name).name, fontsize=9, color=INK)
    axes.legend(fontsize=7, frameon=False)
