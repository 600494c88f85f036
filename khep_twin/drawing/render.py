"""View of a playpen from a camera above it, rendered by MuJoCo if OpenGL is available.

A graphics driver may crash the process that uses it, so the picture is made in a process of its own:
`python -m khep_twin.drawing.render` reads a playpen and writes a PNG.
"""

# MuJoCo's renderer and its OpenGL libraries are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false, reportUnknownParameterType=false

import contextlib
import importlib
import os
import subprocess
import sys
import warnings
from collections.abc import Generator
from io import BytesIO, StringIO
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen, dump, parse
from khep_twin.playpen_to_mjcf import to_spec

WIDTH, HEIGHT = 1280, 960
"""Size of a picture [pixels]."""

LONGEST = 60.0
"""Time-out for rendering a picture, wall time [s]."""

_FLOOR, _LINES = [0.68, 0.76, 0.80], [0.48, 0.57, 0.63]
"""Colours of no surface of the library."""


def render(playpen: Playpen, target: Path) -> bytes:
    """Return a picture of a playpen at its start, as PNG.

    Args:
        playpen: Playpen to render.
        target: Name of the file, checked for its suffix.

    Raises:
        KhepTwinError: The name does not end in .png, or no picture can be made on this machine.
    """
    if target.suffix.lower() != ".png":
        raise KhepTwinError(f"{target}: expected a name that ends in .png", ", or no --perspective")
    command = [sys.executable, "-m", "khep_twin.drawing.render"]
    text = dump(playpen).encode("utf-8")
    try:
        done = subprocess.run(command, input=text, capture_output=True, timeout=LONGEST, check=False)
    except subprocess.TimeoutExpired:
        raise KhepTwinError(f"{target}: the picture took longer than {LONGEST:g} s") from None
    if done.returncode:
        told = done.stderr.decode("utf-8", "replace").strip().splitlines()
        reason = told[-1] if told else f"the graphics driver ended with status {done.returncode}"
        raise KhepTwinError(f"{target}: {reason}", ", or no --perspective")
    return done.stdout


def main() -> int:
    """Write a picture of the playpen on standard input to standard output; return the exit status."""
    try:
        picture = _rendered(parse(sys.stdin.buffer.read().decode("utf-8"), "standard input"))
    except KhepTwinError as error:
        print(error, file=sys.stderr)
        return 1
    sys.stdout.buffer.write(picture)
    return 0


def _rendered(playpen: Playpen) -> bytes:
    spec = to_spec(playpen)
    _decorate(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    arena = playpen.arena
    camera = mujoco.MjvCamera()
    camera.lookat[:] = arena.width_mm / 2000, arena.height_mm / 2000, 0
    camera.distance = 1.4 * max(arena.width_mm, 1.2 * arena.height_mm) / 1000
    camera.azimuth, camera.elevation = 90, -52
    scene = mujoco.MjvScene(model, maxgeom=20_000)
    everything = int(mujoco.mjtCatBit.mjCAT_ALL)
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = 0
    mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    view = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)
    with window_of(model) as window:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, window)
        mujoco.mjr_render(view, scene, window)
        mujoco.mjr_readPixels(pixels, None, view, window)
    picture = BytesIO()
    Image.fromarray(pixels[::-1]).save(picture, format="PNG")
    return picture.getvalue()


def _decorate(spec: mujoco.MjSpec) -> None:
    """Add a sky, a floor with lines every 100 mm, and light from the side, for shadows, to a scene.

    The lights together stay below full brightness, so that white objects differ from the floor, and their
    tops from their sides.
    """
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.32] * 3, [0.15] * 3, [0.0] * 3
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.shadowclip = 2
    floor = spec.geom("floor")
    for light in spec.lights:
        light.dir, light.diffuse, light.specular = [0.45, 0.55, -1], [0.5] * 3, [0.1] * 3
        # From about as far as the arena is wide: from farther off, shadows would have stripes.
        far = 2 * max(floor.size[:2])
        light.pos = [at - far * part for at, part in zip(floor.pos, light.dir, strict=True)]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.98, 0.98, 0.99],
        rgb2=[0.86, 0.89, 0.93],
        width=64,
        height=384,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=_FLOOR,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        markrgb=_LINES,
        width=120,
        height=120,
    )
    lines = spec.add_material(name="floor", texrepeat=[20, 20], texuniform=True, specular=0.0)
    lines.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor.material, floor.rgba = "floor", [1, 1, 1, 1]
    # The grid includes the lines through the arena's corner.
    place, size = np.array(floor.pos), np.array(floor.size)
    low, high = np.floor(10 * (place - size)) / 10, np.ceil(10 * (place + size)) / 10
    floor.pos, floor.size = [*(low + high)[:2] / 2, 0], [*(high - low)[:2] / 2, 0.01]


@contextlib.contextmanager
def window_of(model: mujoco.MjModel) -> Generator[object]:
    """Provide a context for MuJoCo to render in: by the screen's driver, or without a screen."""
    screen = bool(os.environ.get("DISPLAY")) or sys.platform != "linux"
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    kinds = [wanted] if wanted in ("egl", "osmesa", "glfw") else (["glfw"] if screen else ["egl", "osmesa"])
    reasons: list[str] = []
    for kind in kinds:
        # These libraries print warnings about what is missing, and raise arbitrary exceptions.
        try:
            with warnings.catch_warnings(), contextlib.redirect_stderr(StringIO()):
                warnings.simplefilter("ignore")
                context = importlib.import_module(f"mujoco.{kind}").GLContext(WIDTH, HEIGHT)
                context.make_current()
                window = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:
            reasons.append(f"{kind}: {type(error).__name__}")
            continue
        try:
            yield window
        finally:
            window.free()
            context.free()
        return
    raise KhepTwinError(
        f"there is no OpenGL to render with ({', '.join(reasons)}); expected a graphics driver with EGL, or "
        "libOSMesa"
    )


if __name__ == "__main__":
    sys.exit(main())
