"""Picture of the shipped playpens on one sheet."""

from io import BytesIO
from pathlib import Path

from PIL import Image

from khep_twin import playpen
from khep_twin.drawing import map as drawing
from khep_twin.playpen import Playpen

COLUMNS, DPI = 3, 130
_LONGER_SIDE = 3.3
"""Longer side of a playpen [inch]: small on paper, so that letters are large beside it."""


def draw(target: Path) -> None:
    """Draw the playpens as `khep-twin playpen draw` does, smaller."""
    pictures: list[Image.Image] = []
    for name in playpen.names():
        figure = drawing.draw(Playpen.load(name), longer_side=_LONGER_SIDE)
        pictures.append(Image.open(BytesIO(drawing.picture(figure, "png", DPI))).convert("RGB"))
    rows = [pictures[start : start + COLUMNS] for start in range(0, len(pictures), COLUMNS)]
    width = max(picture.width for picture in pictures)
    heights = [max(picture.height for picture in row) for row in rows]
    sheet = Image.new("RGB", (COLUMNS * width, sum(heights)), "white")
    for index, row in enumerate(rows):
        for column, picture in enumerate(row):
            sheet.paste(picture, (column * width, sum(heights[:index])))
    sheet.save(target, optimize=True)
