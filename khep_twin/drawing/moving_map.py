"""Maps of one playpen over time: what stays is drawn once, robots and movable objects for each picture.

film = MovingMap(Playpen.load("obstacles"))
picture = film.picture([(0.1, 0.1, 0.0)], [])  # poses [m, rad]
"""

# The annotations of matplotlib leave keyword arguments untyped.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from collections.abc import Sequence
from itertools import chain

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from khep_twin.drawing.labels import Labels
from khep_twin.drawing.map import draw
from khep_twin.drawing.symbols import INK, Look, draw_object, draw_robot
from khep_twin.playpen import Playpen

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

DPI = 100.0
"""Resolution of the pictures [dots/inch]."""

_ABOVE_ROBOTS = 6
"""Least order of what covers robots: lamps and labels."""


class MovingMap:
    """Map of a playpen, whose robots and movable objects are drawn where they are.

    Args:
        playpen: Playpen.
    """

    def __init__(self, playpen: Playpen) -> None:
        blocks, cylinders = (
            tuple(item for item in items if not item.movable) for items in (playpen.blocks, playpen.cylinders)
        )
        still = {"robots": (), "blocks": blocks, "cylinders": cylinders}
        figure = draw(playpen.model_copy(update=still))
        figure.set_dpi(DPI)
        self._axes, self._canvas = figure.axes[0], FigureCanvasAgg(figure)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)
        self._above = [each for each in self._axes.get_children() if each.get_zorder() >= _ABOVE_ROBOTS]
        labels, origin = Labels(self._axes, INK), {"x_mm": 0.0, "y_mm": 0.0}
        self._movers = [
            [draw_object(self._axes, playpen, item.model_copy(update=origin | {"angle_deg": 0.0}))]
            for item in chain(*playpen.objects.values())
            if item.movable
        ]
        self._movers += [
            draw_robot(self._axes, labels, robot.model_copy(update=origin | {"heading_deg": 0.0}), "")
            for robot in playpen.robots
        ]
        look: Look = {"ha": "center", "va": "top", "fontsize": 7.5, "color": INK}
        count = len(playpen.robots) if len(playpen.robots) > 1 else 0
        self._names = [self._axes.text(0, 0, f"khepera{index}", **look) for index in range(count)]
        self._below_mm = [1000 * robot.body.radius + 4 for robot in playpen.robots]

    def picture(self, robots: Sequence[Pose], objects: Sequence[Pose]) -> NDArray[np.uint8]:
        """Return a picture, rows from the top (height, width, 3).

        Args:
            robots: Poses of the robots, x, y [m] and heading [rad].
            objects: Poses of the movable objects, in the order of `Playpen.objects`.
        """
        self._canvas.restore_region(self._still)
        for parts, (x, y, heading) in zip(self._movers, (*objects, *robots), strict=True):
            place = Affine2D().rotate(heading).translate(1000 * x, 1000 * y) + self._axes.transData
            for part in parts:
                part.set_transform(place)
                self._axes.draw_artist(part)
        for name, below_mm, (x, y, _) in zip(self._names, self._below_mm, robots, strict=False):
            name.set_position((1000 * x, 1000 * y - below_mm))
            self._axes.draw_artist(name)
        for part in self._above:
            self._axes.draw_artist(part)
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        # Many players show no video with an odd number of rows or columns.
        height, width = (size // 2 * 2 for size in pixels.shape[:2])
        return np.ascontiguousarray(pixels[:height, :width])
