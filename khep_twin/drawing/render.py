"""View of a playpen from a camera above it, rendered by MuJoCo if OpenGL is available.

A graphics driver may crash its process, so the picture is rendered in a separate one:
`python -m khep_twin.drawing.render` reads a playpen and writes a PNG.
"""

# MuJoCo's renderer is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportAttributeAccessIssue=false

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen, dump, parse
from khep_twin.playpen_to_mjcf import to_spec

WIDTH, HEIGHT = 1280, 960
"""Size of a picture [pixels]."""

TIMEOUT_S = 60.0
"""Time-out for rendering a picture, wall time [s]."""

_NO_OPENGL, _FAILED = 1, 2
"""Exit statuses; 1 also if the library is missing, as `import mujoco` then fails."""

_FLOOR, _LINES = [0.68, 0.76, 0.80], [0.48, 0.57, 0.63]
"""Colours that no built-in surface has."""


def render(playpen: Playpen, target: Path) -> bytes:
    """Return a picture of a playpen at its start, as PNG.

    Args:
        playpen: Playpen to render.
        target: Name of the file; only its suffix is checked.

    Raises:
        KhepTwinError: The name does not end in .png, or no picture can be rendered on this machine.
    """
    if target.suffix.lower() != ".png":
        raise KhepTwinError(f"{target}: expected a name that ends in .png", ", or no --perspective")
    command = [sys.executable, "-m", "khep_twin.drawing.render"]
    text = dump(playpen).encode("utf-8")
    reasons: list[str] = []
    for library in _libraries():
        environment = {**os.environ, "MUJOCO_GL": library}
        try:
            process = subprocess.run(
                command, input=text, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise KhepTwinError(f"{target}: the picture took longer than {TIMEOUT_S:g} s") from None
        if not process.returncode:
            return process.stdout
        messages = process.stderr.decode("utf-8", "replace").strip().splitlines()
        reason = messages[-1] if messages else f"the graphics driver ended with status {process.returncode}"
        if process.returncode != _NO_OPENGL:
            raise KhepTwinError(f"{target}: {reason}", ", or no --perspective")
        reasons.append(f"{library}: {reason.split(':')[0]}")
    raise KhepTwinError(
        f"{target}: there is no OpenGL to render with ({', '.join(reasons)}); expected a graphics driver "
        "with EGL, or libOSMesa",
        ", or no --perspective",
    )


def main() -> int:
    """Write a picture of the playpen on standard input to standard output; return the exit status."""
    try:
        picture = _render_pixels(parse(sys.stdin.buffer.read().decode("utf-8"), "standard input"))
    except Exception as error:
        message = str(error) if isinstance(error, KhepTwinError) else f"{type(error).__name__}: {error}"
        print(message, file=sys.stderr)
        return _FAILED
    if isinstance(picture, str):
        print(picture, file=sys.stderr)
        return _NO_OPENGL
    Image.fromarray(picture).save(sys.stdout.buffer, format="PNG")
    return 0


def _libraries() -> list[str]:
    """Return the libraries to try, by their names in `MUJOCO_GL`: with a screen, or without one."""
    requested = os.environ.get("MUJOCO_GL", "").lower()
    if requested in ("egl", "osmesa", "glfw"):
        return [requested]
    return ["glfw"] if os.environ.get("DISPLAY") or sys.platform != "linux" else ["egl", "osmesa"]


def _render_pixels(playpen: Playpen) -> NDArray[np.uint8] | str:
    """Return the pixels, or the name of the error if the library cannot render here."""
    spec = to_spec(playpen)
    _add_background(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    arena = playpen.arena
    camera = mujoco.MjvCamera()
    camera.lookat[:] = arena.width_mm / 2000, arena.height_mm / 2000, 0
    camera.distance = 1.4 * max(arena.width_mm, 1.2 * arena.height_mm) / 1000
    camera.azimuth, camera.elevation = 90, -52
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = 0
    try:
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH, max_geom=20_000)
    except Exception as error:
        # The libraries raise different errors.
        return type(error).__name__
    with renderer:
        renderer.update_scene(data, camera, option)
        return renderer.render()


def _add_background(spec: mujoco.MjSpec) -> None:
    """Add a sky, a floor with lines every 100 mm, and a light from the side for shadows to a scene.

    The sum of the lights stays below full brightness, so that white objects differ from the floor, and their
    tops from their sides.
    """
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.32] * 3, [0.15] * 3, [0.0] * 3
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.shadowclip = 2
    floor = spec.geom("floor")
    for light in spec.lights:
        light.dir, light.diffuse, light.specular = [0.45, 0.55, -1], [0.5] * 3, [0.1] * 3
        # At about the width of the arena; from farther away, shadows would have stripes.
        distance = 2 * max(floor.size[:2])
        light.pos = [x - distance * dx for x, dx in zip(floor.pos, light.dir, strict=True)]
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
    centre, size = np.array(floor.pos), np.array(floor.size)
    low, high = np.floor(10 * (centre - size)) / 10, np.ceil(10 * (centre + size)) / 10
    floor.pos, floor.size = [*(low + high)[:2] / 2, 0], [*(high - low)[:2] / 2, 0.01]


if __name__ == "__main__":
    sys.exit(main())
