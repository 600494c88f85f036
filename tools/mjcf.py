"""The shipped playpens as MJCF with a picture each, for viewers without khep_twin: the folder mjcf.

    python -m tools mjcf                            rewrites all of it
    python -m tools mjcf FOLDER --without-pictures

The pictures need OpenGL: EGL or libOSMesa.
"""

import io
from pathlib import Path

from PIL import Image

from khep_twin import playpen
from khep_twin.drawing.render import render
from khep_twin.files.atomic import write_atomic
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_spots
from khep_twin.playpen_to_mjcf import to_mjcf
from tools.command_table import command_line

FOLDER = Path(__file__).parents[1] / "mjcf"

SIZE, COLOURS = (640, 480), 128
"""Size of a picture [pixels], and number of its colours."""

INTRODUCTION = """# Playpens as MJCF

The shipped playpens for MuJoCo's own viewers, without khep_twin. `python -m tools mjcf` writes this folder.

- On the desktop: `python -m mujoco.viewer --mjcf=mjcf/default.xml`, or drop a file onto `simulate`.
- In a browser: drop a file onto [live.mujoco.org](https://live.mujoco.org). A file with a public address
  opens by the link `https://live.mujoco.org/?model=ADDRESS`, one on GitHub by
  `https://live.mujoco.org/?model=github:OWNER/REPOSITORY/BRANCH/mjcf/default.xml`.

Load the keyframe `home` first: it holds a gripper up. The robots stand still, as no board drives their
motors; the viewer's control sliders do. [docs/playpens.md](../docs/playpens.md) describes the playpens.

| playpen | picture |
|---|---|
"""


def main() -> None:
    """Write the folder."""
    parser = command_line(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--without-pictures", action="store_true", help="only the scenes and the list")
    options = parser.parse_args()
    options.folder.mkdir(exist_ok=True)
    table = ""
    for name in playpen.names():
        placed_playpen = at_spots(Playpen.load(name), 0)
        write_atomic(options.folder / f"{name}.xml", to_mjcf(placed_playpen).encode("utf-8"))
        picture = options.folder / f"{name}.png"
        if not options.without_pictures:
            write_atomic(picture, small(render(placed_playpen, picture)))
        table += f"| [{name}]({name}.xml) | ![Scene of {name}]({name}.png) |\n"
    write_atomic(options.folder / "README.md", (INTRODUCTION + table).encode("utf-8"))
    print(f"mjcf     {options.folder}")


def small(picture: bytes) -> bytes:
    """Return a picture in the size of the list."""
    image = Image.open(io.BytesIO(picture)).resize(SIZE, Image.Resampling.LANCZOS).quantize(COLOURS)
    content = io.BytesIO()
    image.save(content, format="PNG", optimize=True)
    return content.getvalue()
