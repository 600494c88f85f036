"""PDF pages of a report, with the content of the HTML in a simpler layout; reproducible to the byte."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import textwrap
from collections.abc import Sequence
from io import BytesIO

import matplotlib.image
import matplotlib.style
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from khep_twin.drawing import map as drawing
from khep_twin.drawing.map import METADATA, STYLE, blank_figure
from khep_twin.drawing.symbols import INK
from khep_twin.lab.report import shadow_section
from khep_twin.lab.report.figure import WIDTH
from khep_twin.lab.report.pages import DPI, draw_map, limit_rows, pictures
from khep_twin.lab.report.report import Report
from khep_twin.lab.report.rows import Row, definitions

_PAGE = (210 / 25.4, 297 / 25.4)
"""A4 [inch]."""

_SIDE_MARGIN, _END_MARGIN = (_PAGE[0] - WIDTH) / 2, 0.6
"""Margins at the sides, above and below [inch]."""

_TITLE_SIZE, _HEADING_SIZE, _TEXT_SIZE, _SMALL_SIZE = 16, 12, 9.5, 8
"""Sizes of type [points]."""

_NAME_WIDTH = 1.85
"""Width of a table's first column [inch]."""

_MAP_HEIGHT = 4.7


def pdf(report: Report) -> bytes:
    """Return a report as the bytes of a PDF file."""
    with matplotlib.style.context(STYLE):
        pages = _Pages()
        pages.text(report.title, _TITLE_SIZE)
        if (playpen := draw_map(report)) is not None:
            pages.picture(drawing.picture(playpen, "png", DPI))
        for robot in report.robots:
            pages.heading(robot.name, 0.25 * len(robot.rows))
            pages.table(robot.rows, _TEXT_SIZE)
            if robot.missing:
                pages.text(robot.missing, _SMALL_SIZE)
            for draw, height, _ in pictures(robot):
                bottom = pages.reserve(height)
                draw(pages.figures[-1], robot, (_SIDE_MARGIN, bottom))
        row_definitions = definitions()
        if report.shadow is not None:
            row_definitions = shadow_section.DEFINITIONS
            shadow_rows = tuple(shadow_section.rows(report.shadow))
            pages.heading("The robot as its shadow follows it", 0.25 * len(shadow_rows))
            pages.table(shadow_rows, _TEXT_SIZE)
            for draw_residuals, height, _ in shadow_section.pictures(report.shadow):
                bottom = pages.reserve(height)
                draw_residuals(pages.figures[-1], report.shadow, (_SIDE_MARGIN, bottom))
            pages.heading("Alarms", 1)
            pages.table(limit_rows(shadow_section.alarm_rows(report.shadow)) or [("none", "")], _TEXT_SIZE)
        pages.heading("Faults and events", 1)
        pages.table(limit_rows(report.events) or [("none", "")], _TEXT_SIZE)
        pages.heading("Versions and settings", 2.5)
        pages.table(report.settings, _SMALL_SIZE)
        pages.heading("What the numbers mean", 2.5)
        pages.table(row_definitions, _SMALL_SIZE)
        data = BytesIO()
        with PdfPages(data, metadata=METADATA["pdf"]) as file:
            for figure in pages.figures:
                file.savefig(figure)
    return data.getvalue()


class _Pages:
    """Pages that are filled from top to bottom, one figure each."""

    def __init__(self) -> None:
        self.figures: list[Figure] = []
        self._free_height = 0.0

    def reserve(self, height: float) -> float:
        """Reserve a strip on this or a new page; return the position of its lower edge [inch]."""
        if not self.figures or self._free_height < height:
            self.figures.append(blank_figure(*_PAGE))
            self._free_height = _PAGE[1] - 2 * _END_MARGIN
        self._free_height -= height
        return _END_MARGIN + self._free_height

    def text(self, text: str, size: float) -> None:
        """Write a paragraph."""
        lines = _wrap(text, size, WIDTH)
        bottom = self.reserve((len(lines) + 0.5) * _line_height(size))
        self._write_lines(_SIDE_MARGIN, bottom + 0.5 * _line_height(size), lines, size)

    def heading(self, text: str, min_height: float) -> None:
        """Write an underlined heading on a page with at least `min_height` [inch] below it."""
        if self._free_height < 0.42 + min_height:
            self._free_height = 0.0
        bottom = self.reserve(0.42)
        self._write_lines(_SIDE_MARGIN, bottom + 0.1, [text], _HEADING_SIZE)
        self._draw_line(bottom + 0.05, INK, 0.8)

    def table(self, rows: Sequence[Row], size: float) -> None:
        """Write names and values, with a thin line below each."""
        for name, value in rows:
            names, values = _wrap(name, size, _NAME_WIDTH - 0.1), _wrap(value, size, WIDTH - _NAME_WIDTH)
            n_lines = max(len(names), len(values))
            bottom = self.reserve((n_lines + 0.45) * _line_height(size))
            for x, lines in ((_SIDE_MARGIN, names), (_SIDE_MARGIN + _NAME_WIDTH, values)):
                self._write_lines(x, bottom + (n_lines - len(lines) + 0.25) * _line_height(size), lines, size)
            self._draw_line(bottom, "#cccccc", 0.4)
        self.reserve(min(0.1, max(self._free_height, 0.0)))

    def picture(self, png: bytes) -> None:
        """Draw a picture, centred on the page."""
        pixels = matplotlib.image.imread(BytesIO(png), format="png")
        rows, columns = pixels.shape[:2]
        height = min(_MAP_HEIGHT, WIDTH * rows / columns)
        width = height * columns / rows
        bottom = self.reserve(height)
        box = ((_PAGE[0] - width) / 2 / _PAGE[0], bottom / _PAGE[1], width / _PAGE[0], height / _PAGE[1])
        axes = self.figures[-1].add_axes(box)
        axes.set_axis_off()
        axes.imshow(pixels, aspect="auto", interpolation="none")

    def _write_lines(self, x: float, bottom: float, lines: Sequence[str], size: float) -> None:
        for number, line in enumerate(reversed(lines)):
            y = bottom + (number + 0.2) * _line_height(size)
            text = self.figures[-1].text(x / _PAGE[0], y / _PAGE[1], line, fontsize=size, va="baseline")
            text.set_parse_math(False)  # a dollar in the text is a dollar

    def _draw_line(self, y: float, colour: str, width: float) -> None:
        ends = [_SIDE_MARGIN / _PAGE[0], (_SIDE_MARGIN + WIDTH) / _PAGE[0]]
        self.figures[-1].add_artist(Line2D(ends, [y / _PAGE[1]] * 2, color=colour, lw=width))


def _line_height(size: float) -> float:
    """Return the line height [inch] of text of a size in points."""
    return 1.3 * size / 72


def _wrap(text: str, size: float, width: float) -> list[str]:
    """Wrap a text to lines that fit a width [inch]."""
    # The mean width of a letter is 0.56 of the font size, with some margin.
    return textwrap.wrap(text, int(width * 72 / (0.56 * size))) or [""]
