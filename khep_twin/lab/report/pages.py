"""Pages of a report in HTML, in one file with embedded figures and without scripts.

HTML and PDF are made for A4 and have the same content. The same report gives the same bytes.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from base64 import b64encode
from collections.abc import Callable, Sequence
from html import escape
from string import Template
from typing import TypeVar

import matplotlib.style
from matplotlib.figure import Figure

from khep_twin.drawing import map as drawing
from khep_twin.drawing.map import STYLE, blank_figure
from khep_twin.lab.report import shadow_section
from khep_twin.lab.report.figure import (
    EXTRA_HEIGHT,
    VISION_HEIGHT,
    WHEEL_HEIGHT,
    WIDTH,
    draw_extra,
    draw_sensors,
    draw_vision,
    draw_wheels,
    sensor_height,
)
from khep_twin.lab.report.report import Report, RobotReport
from khep_twin.lab.report.rows import Row, definitions

_T = TypeVar("_T")

Draw = Callable[[Figure, RobotReport, tuple[float, float]], None]
"""Function that draws a robot's picture in a figure; the corner is the lower left [inch]."""

EVENT_LIMIT = 40
"""Largest number of events on a page; later ones are left out."""

DPI = 200
"""Resolution of the figures [dots per inch]."""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>$title</title>
<style>
@page { size: A4; margin: 14mm 15mm }
body { font: 10.5pt/1.35 "Helvetica Neue", Arial, sans-serif; color: #2b2f36; background: white;
  max-width: 180mm; margin: 8mm auto; padding: 0 4mm }
h1 { font-size: 17pt; margin: 0 0 1mm }
h2 { font-size: 13pt; margin: 7mm 0 2mm; border-bottom: 0.3mm solid #2b2f36; break-after: avoid }
img { max-width: 100%; display: block; margin: 2mm auto; break-inside: avoid }
img.map { max-height: 135mm }
table { border-collapse: collapse; width: 100%; break-inside: avoid }
td, th { text-align: left; vertical-align: top; padding: 0.6mm 3mm 0.6mm 0; border-bottom: 0.1mm solid #ccc;
  font-weight: normal; overflow-wrap: anywhere }
th { width: 46mm; color: #5a606b }
.small { font-size: 8.5pt; line-height: 1.3 }
.missing { color: #9a4a00 }
@media print { body { margin: 0; padding: 0; max-width: none } }
</style>
</head>
<body>
<h1>$title</h1>
$body
</body>
</html>
""")


def html(report: Report) -> bytes:
    """Return a report as an HTML page in one file."""
    figure = draw_map(report)
    parts = [] if figure is None else [_image(figure, "Paths in the playpen", "map")]
    for robot in report.robots:
        parts += [f"<h2>{escape(robot.name)}</h2>", _table(robot.rows)]
        if robot.missing:
            parts.append(f'<p class="missing">{escape(robot.missing)}</p>')
        for draw, height, name in pictures(robot):
            parts.append(_image(_sheet(draw, height, robot), f"{name} of {robot.name} over time"))
    row_definitions = definitions()
    if report.shadow is not None:
        row_definitions = shadow_section.DEFINITIONS
        parts += [
            "<h2>The robot as its shadow follows it</h2>",
            _table(tuple(shadow_section.rows(report.shadow))),
        ]
        for draw, height, name in shadow_section.pictures(report.shadow):
            parts.append(_image(_sheet(draw, height, report.shadow), f"{name} over time"))
        alarms = limit_rows(shadow_section.alarm_rows(report.shadow))
        parts += ["<h2>Alarms</h2>", _table(alarms) if alarms else "<p>None.</p>"]
    events = _table(limit_rows(report.events)) if report.events else "<p>None.</p>"
    parts += ["<h2>Faults and events</h2>", events]
    parts += ["<h2>Versions and settings</h2>", _table(report.settings, "small")]
    parts += ["<h2>What the numbers mean</h2>", _table(row_definitions, "small")]
    return _PAGE.substitute(title=escape(report.title), body="\n".join(parts)).encode("utf-8")


def draw_map(report: Report) -> Figure | None:
    """Draw the playpen with the robots' paths; None if the log has no playpen."""
    if report.playpen is None:
        return None
    if report.shadow is not None:
        return shadow_section.draw_map(report.playpen, report.shadow)
    return drawing.draw(report.playpen, report.tracks)


def limit_rows(events: Sequence[Row]) -> tuple[Row, ...]:
    """Return the first events, and a row with the number of omitted ones."""
    if len(events) <= EVENT_LIMIT:
        return tuple(events)
    return (*events[:EVENT_LIMIT], ("…", f"and {len(events) - EVENT_LIMIT} more"))


def pictures(robot: RobotReport) -> list[tuple[Draw, float, str]]:
    """Return drawing function, height [inch] and name of each picture with data in the log."""
    entries: list[tuple[Draw, float, str]] = []
    if robot.proximity is not None or robot.ambient is not None:
        entries.append((draw_sensors, sensor_height(robot.model.body.sensors), "Sensors"))
    if robot.speed is not None:
        entries.append((draw_wheels, WHEEL_HEIGHT, "Wheel speeds"))
    if robot.extra:
        entries.append((draw_extra, EXTRA_HEIGHT, "Further sensors"))
    if robot.vision is not None:
        entries.append((draw_vision, VISION_HEIGHT, "Line images"))
    return entries


def _sheet(draw: Callable[[Figure, _T, tuple[float, float]], None], height: float, subject: _T) -> Figure:
    """Return a figure of this height [inch] with one picture of a robot or a shadow."""
    with matplotlib.style.context(STYLE):
        figure = blank_figure(WIDTH, height)
        draw(figure, subject, (0.0, 0.0))
    return figure


def _image(figure: Figure, text: str, css_class: str = "curves") -> str:
    # PNG images can be pasted into word processors.
    data = b64encode(drawing.picture(figure, "png", DPI)).decode("ascii")
    return f'<img class="{css_class}" alt="{escape(text)}" src="data:image/png;base64,{data}">'


def _table(rows: Sequence[Row], css_class: str = "numbers") -> str:
    lines = [f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows]
    return "\n".join([f'<table class="{css_class}">', *lines, "</table>"])
