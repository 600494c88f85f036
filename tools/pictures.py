"""Pictures of the docs, drawn by the commands or files that the pages show, in full colour.

    MUJOCO_GL=egl python -m tools pictures

The pictures of the tutorial and the README: tutorial.py.
"""

# MuJoCo's rendering is not typed here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportPrivateUsage=false

import contextlib
import copy
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image
from scipy.io import loadmat
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.host import Gripper, Khepera
from khep_twin.playpen import Playpen
from khep_twin.shadow.recording import read_recording
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog
from khep_twin.world import World
from tools import library_picture, tutorial
from tools.command_table import command_line

_LEFT_COLUMN = (0, 30, 800, 876)
"""Arena, robot and serial line in a still of `khep-twin view` [pixels]."""


def draw_sensor_tests() -> None:
    """Draw the two tests of docs/sense.md, by its commands."""
    source = _first_block("sense.md", "toml")
    Path("bench.toml").write_text(source)
    far = ["--linear", "12", "--runs", "5", "--text", "white wall", "-o", "wall.csv"]
    _type("sense", "khep://bench.toml?seed=1", "--speed", "4", *far, "--picture", "sense_linear.png")
    Path("bench.toml").write_text(source.replace("x_mm = 847.5", "x_mm = 957.5"))
    near = ["--rotate", "360", "--grid", "-o", "turn.mat"]
    _type("sense", "khep://bench.toml?seed=1", "--speed", "4", *near, "--picture", "sense_rotational.png")
    for name in ("sense_linear", "sense_rotational"):
        _keep(tutorial.shrunk(Path(f"{name}.png"), 1050), name)


def draw_vision() -> None:
    """Draw the sensor test with line images of docs/sense.md, and the example of the README in rerun."""
    turn = ["--what", "vision", "--rotate", "360", "--speed", "1"]
    _type("sense", "khep://stripes?seed=1", *turn, "--picture", "sense_vision.png")
    _keep(tutorial.shrunk(Path("sense_vision.png"), 1050), "sense_vision")
    example = Path(__file__).parents[1] / "examples" / "08_landmark.py"
    sys.argv[1:] = ["khep://landmark?log=landmark.mcap"]
    runpy.run_path(str(example), run_name="__main__")
    _type("view", "landmark.mcap", "--png", "landmark.png")
    _keep(tutorial.shrunk(Path("landmark.png"), 1000), "landmark")


def draw_side_by_side() -> None:
    """Draw two logs beside each other, for docs/logs.md."""
    for playpen in ("obstacles", "two-lamps"):
        _type("run", "--playpen", playpen, "--seconds", "20", "--log", f"{playpen}.mcap")
    _type("view", "obstacles.mcap", "two-lamps.mcap", "--png", "side_by_side.png")
    _keep(tutorial.shrunk(Path("side_by_side.png"), 1280), "side_by_side")


def draw_paths() -> None:
    """Draw the pictures of docs/drawing.md, by its programs and the logs that it names."""
    Path("out").mkdir()
    Path("trio.toml").write_text(_first_block("drawing.md", "toml"))
    _type("run", "braitenberg", "--playpen", "obstacles", "--seconds", "60", "--log", "out/run.mcap")
    _type("rollout", "braitenberg", "--playpen", "trio.toml", "--seconds", "30", "--log", "out/trio.mcap")
    for block in tutorial.blocks((tutorial.PAGE.parent / "drawing.md").read_text()):
        if block.language == "python":
            exec(block.text, {})
    for name in ("path", "paths", "trio", "sensors", "where"):
        _keep(Image.open(f"out/{name}.png").convert("RGB"), f"drawing_{name}")


def draw_branches() -> None:
    """Draw the fan of branches of docs/branch.md, by its commands."""
    _type("run", "--playpen", "obstacles", "--seconds", "60", "--seed", "1", "--log", "run.mcap")
    change = ["--controller", "braitenberg", "--seconds", "10", "--runs", "20"]
    _type("branch", "run.mcap", "--at", "33", *change, "-o", "fan.mcap")
    _keep(tutorial.shrunk(Path("fan.png"), 1280), "branches")


def draw_shadow() -> None:
    """Draw the log of a shadow of a varied robot with a stuck sensor, for docs/logs.md."""
    fault = ["--vary", "on", "--seed", "5", "--fault", "stuck:5@25"]
    _type("run", "--playpen", "workshop", *fault, "--seconds", "60", "--log", "robot.mcap")
    settings, playpen, parent = ShadowSettings(), Playpen.load("workshop"), Path("robot.mcap")
    shadow, log = Shadow(playpen, settings), ShadowLog(Path("shadow.mcap"), playpen, settings, parent=parent)
    for chunk in read_recording(parent).chunks:
        for update in shadow.feed(*chunk):
            log.write(update)
    log.close()
    _type("view", "shadow.mcap", "--at", "40", "--png", "shadow.png")
    _keep(tutorial.shrunk(Path("shadow.png"), 1280), "shadow")


def draw_import() -> None:
    """Draw the scan of docs/import.md, the right way up, and the playpen that is imported from it."""
    exec(_first_block("import.md", "python"), {})
    scan = loadmat("scan.mat")["btmap1"][::-1]
    _type("playpen", "import", "scan.mat", "-o", "scan.toml")
    _type("playpen", "draw", "scan.toml", "-o", "map.png")
    drawn = tutorial.shrunk(Path("map.png"), 620)
    sheet = Image.new("RGB", (scan.shape[1] + 20 + drawn.width, drawn.height), "white")
    picture = Image.fromarray(np.where(scan == 1, 255, 0).astype(np.uint8))
    sheet.paste(picture.convert("RGB"), (0, max((drawn.height - picture.height) // 2 - 20, 0)))
    sheet.paste(drawn, (picture.width + 20, 0))
    _keep(sheet, "import")


def draw_gripper() -> None:
    """Draw the gripper around a cylinder, lifting it, and carrying it, as the README's program does."""
    with Khepera("khep://gripper") as robot:
        gripper = Gripper(robot)
        world = robot.port.twin.world
        gripper.lower()
        gripper.wait()
        robot.set_speed(5, 5)
        while gripper.barrier() == 0:
            pass
        robot.set_speed(0, 0)
        shots = [_render_robot(world)]
        gripper.close()
        gripper.wait()
        gripper.lift()
        robot.sleep(0.6)
        shots.append(_render_robot(world))
        gripper.wait()
        shots.append(_render_robot(world))
    width, height = shots[0].size
    strip = Image.new("RGB", (3 * width + 20, height), "white")
    for index, shot in enumerate(shots):
        strip.paste(shot, (index * (width + 10), 0))
    _keep(strip, "gripper")


def draw_baton() -> None:
    """Draw the end of the run of examples/07_baton.py and the first robot's line, for docs/host.md."""
    example = tutorial.PAGE.parents[1] / "examples" / "07_baton.py"
    subprocess.run([sys.executable, str(example), "baton.mcap"], check=True)
    _type("view", "baton.mcap", "--png", "baton.png")
    _keep(Image.open("baton.png").convert("RGB").crop(_LEFT_COLUMN), "baton")


def _first_block(page: str, language: str) -> str:
    """Return the first block of a language in a page of the docs."""
    text = (tutorial.PAGE.parent / page).read_text()
    return next(block.text for block in tutorial.blocks(text) if block.language == language)


def _render_robot(world: World) -> Image.Image:
    """Render the first robot of a world from nearby."""
    model, data = copy.copy(world.model), copy.copy(world.data)
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.3, 0.6
    model.light_diffuse[:] = 0.25
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = data.body("khepera0/base").xpos + np.array((0.012, 0, 0.03))
    camera.distance, camera.azimuth, camera.elevation = 0.26, 145, -38
    with mujoco.Renderer(model, 800, 960) as renderer:
        renderer.update_scene(data, camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        picture = Image.fromarray(renderer.render())
    return picture.resize((480, 400), Image.Resampling.LANCZOS)


def _type(*words: str) -> None:
    result = CliRunner().invoke(app, list(words), prog_name="khep-twin")
    assert result.exit_code == 0, f"{words}\n{result.output}{result.exception or ''}"


def _keep(picture: Image.Image, name: str) -> None:
    picture.save(tutorial.PICTURES / f"{name}.png", optimize=True)
    print(f"{name}.png")


def main() -> None:
    """Redraw all pictures."""
    command_line(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        library_picture.draw(tutorial.PICTURES / "library.png")
        draw_gripper()
        draw_baton()
        draw_import()
        draw_sensor_tests()
        draw_vision()
        draw_side_by_side()
        draw_paths()
        draw_branches()
        draw_shadow()
