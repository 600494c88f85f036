"""Pictures of challenges: the playpen with the robot's start and the goals."""

# matplotlib is typed only in part.
# pyright: reportUnknownMemberType=false

from io import BytesIO
from pathlib import Path

from matplotlib.patches import Circle
from PIL import Image

from khep_twin.drawing import map as drawing
from khep_twin.files.drawings import write_drawing
from khep_twin.lab.challenge.challenge import ChallengeFile

_LONGER_SIDE = 3.0
"""Longer side of the playpen on paper [inch]."""

_DPI = 110
_COLOURS = 128
"""Number of colours of a picture; few colours keep its file small."""

_GOAL_COLOUR = "#b3261e"


def save(file: ChallengeFile, path: Path, replace: bool = True) -> None:
    """Draw a challenge as PNG, its goals as dashed circles, with numbers if there are several.

    `replace` is as for `write_drawing`.

    Raises:
        KhepTwinError: The file cannot be written.
    """
    goals = file.challenge.goals
    figure = drawing.draw(file.playpen, title=file.challenge.title, longer_side=_LONGER_SIDE)
    axes = figure.axes[0]
    for number, goal in enumerate(goals, 1):
        centre = goal.x_mm, goal.y_mm
        axes.add_patch(Circle(centre, goal.radius_mm, fill=False, ec=_GOAL_COLOUR, ls="--", lw=1.2, zorder=9))
        if len(goals) > 1:
            corner = goal.x_mm + goal.radius_mm, goal.y_mm + goal.radius_mm
            axes.text(*corner, str(number), color=_GOAL_COLOUR, fontsize=8, zorder=9)
    image = Image.open(BytesIO(drawing.picture(figure, "png", _DPI))).convert("RGB")
    png = BytesIO()
    image.quantize(_COLOURS).save(png, "PNG", optimize=True)
    write_drawing(path, png.getvalue(), replace)
