"""Maps of one playpen over time: static parts are drawn once, robots and movable objects per picture.

moving_map = MovingMap(Playpen.load("obstacles"))
picture = moving_map.picture([(0.1, 0.1, 0.0)], [])  # poses [m, rad]
"""

# The annotations of matplotlib leave keyword arguments untyped.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false

from collections.abc import Sequence
from itertools import chain

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from khep_twin.drawing.map import draw
from khep_twin.drawing.symbols import INK, Look, draw_object, draw_robot
from khep_twin.playpen import Playpen
from khep_twin.robots.model import robot_name

Pose = tuple[float, float, float]
"""x, y [m] and heading [rad]."""

DPI = 100.0
"""Resolution of the pictures [dots/inch]."""

_ABOVE_ROBOTS = 6
"""Lowest z-order of artists in front of robots: lamps and labels."""


class MovingMap:
    """Map of a playpen with robots and movable objects at given poses."""

    def __init__(self, playpen: Playpen) -> None:
        blocks, cylinders = (
            tuple(item for item in items if not item.movable) for items in (playpen.blocks, playpen.cylinders)
        )
        static_parts = {"robots": (), "blocks": blocks, "cylinders": cylinders}
        figure = draw(playpen.model_copy(update=static_parts))
        figure.set_dpi(DPI)
        self._axes = figure.axes[0]
        self._canvas = FigureCanvasAgg(figure)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)
        artists = self._axes.get_children()
        self._foreground = [artist for artist in artists if artist.get_zorder() >= _ABOVE_ROBOTS]
        origin = {"x_mm": 0.0, "y_mm": 0.0}
        self._moving_artists = [
            [draw_object(self._axes, playpen, item.model_copy(update=origin | {"angle_deg": 0.0}))]
            for item in chain(*playpen.objects.values())
            if item.movable
        ]
        self._moving_artists += [
            draw_robot(self._axes, robot.model_copy(update=origin | {"heading_deg": 0.0}))
            for robot in playpen.robots
        ]
        text_style: Look = {"ha": "center", "va": "top", "fontsize": 7.5, "color": INK}
        count = len(playpen.robots) if len(playpen.robots) > 1 else 0
        self._labels = [self._axes.text(0, 0, robot_name(index), **text_style) for index in range(count)]
        self._label_offsets_mm = [1000 * robot.body.radius + 4 for robot in playpen.robots]

    def picture(self, robots: Sequence[Pose], objects: Sequence[Pose]) -> NDArray[np.uint8]:
        """Return a picture, rows from the top (height, width, 3).

        Args:
            robots: Poses of the robots, x, y [m] and heading [rad].
            objects: Poses of the movable objects, in the order of `Playpen.objects`.
        """
        self._canvas.restore_region(self._background)
        for artists, (x, y, heading) in zip(self._moving_artists, (*objects, *robots), strict=True):
            transform = Affine2D().rotate(heading).translate(1000 * x, 1000 * y) + self._axes.transData
            for artist in artists:
                artist.set_transform(transform)
                self._axes.draw_artist(artist)
        for label, offset_mm, (x, y, _) in zip(self._labels, self._label_offsets_mm, robots, strict=False):
            label.set_position((1000 * x, 1000 * y - offset_mm))
            self._axes.draw_artist(label)
        for artist in self._foreground:
            self._axes.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        # Many players cannot show videos with an odd number of rows or columns.
        height, width = (size // 2 * 2 for size in pixels.shape[:2])
        return np.ascontiguousarray(pixels[:height, :width])
