"""The shipped playpens on one sheet: `python -m benchmarks.library_picture FILE`."""

import sys
from io import BytesIO
from pathlib import Path

import matplotlib.style
from PIL import Image

from khep_twin import drawing, playpen

_COLUMNS, _CELL = 5, 300


def draw(target: Path) -> None:
    """Draws them as `khep-twin playpen draw` does, smaller."""
    names = playpen.names()
    rows = -(-len(names) // _COLUMNS)
    sheet = Image.new("RGB", (_COLUMNS * _CELL, rows * _CELL), "white")
    for index, name in enumerate(names):
        file = BytesIO()
        with matplotlib.style.context(drawing.STYLE):
            drawing.draw(playpen.load(name)).savefig(file, format="png", dpi=110)
        picture = Image.open(file).convert("RGB")
        picture.thumbnail((_CELL - 8, _CELL - 8), Image.Resampling.LANCZOS)
        row, column = divmod(index, _COLUMNS)
        sheet.paste(picture, (column * _CELL + 4, row * _CELL + 4))
    sheet.save(target, optimize=True)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
