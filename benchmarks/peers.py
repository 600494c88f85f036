"""Other simulators for comparison, each in a separate process and Python.

`kheperax_peer` lists the differences of Kheperax.
"""

import importlib.util
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from benchmarks.scale import generation
from benchmarks.table import Row, RunTimes
from khep_twin import units
from khep_twin.board import kernel
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen
from khep_twin.playpen.footprint import Circle, Footprint
from khep_twin.sensing import calibration

REACH_MM = 50.0
"""Reach of Kheperax's lasers beyond the body: about that of the sensors [mm]."""

N_SIDES = 12
"""Sides of a cylinder in Kheperax, which has no circles; the corners are on the circle."""

VARIABLE = "KHEP_TWIN_KHEPERAX"

ABSENT = "Kheperax left out: pip install kheperax==0.2.0 in an environment KX, then --kheperax KX/bin/python"

_CORNER_SIGNS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
"""Signs of a rectangle's corners along and across it."""

_PEER = Path(__file__).with_name("kheperax_peer.py")


def kheperax_python(argument: str | None) -> str | None:
    """Return the Python with Kheperax: by the argument, by the environment, or this one; None without any.

    Raises:
        KhepTwinError: The named Python has no Kheperax.
    """
    named = argument or os.environ.get(VARIABLE)
    if named is None:
        return sys.executable if importlib.util.find_spec("kheperax") else None
    look = "import importlib.util, sys; sys.exit(importlib.util.find_spec('kheperax') is None)"
    if shutil.which(named) is None or subprocess.run([named, "-c", look]).returncode:
        raise KhepTwinError(f"{named}: no Python with Kheperax; expected one that can import it")
    return named


class Kheperax(AbstractContextManager["Kheperax"]):
    """Kheperax in a playpen.

    Args:
        python: Python that can import Kheperax.
        playpen: Playpen with one robot; its walls have no thickness, and a cylinder has `N_SIDES` sides.
        platform: Platform of JAX: "cpu", or "cuda" for a GPU.

    Attributes:
        versions: Versions of Kheperax and jax.

    Raises:
        KhepTwinError: Kheperax does not start; its last line gives the reason.
    """

    def __init__(self, python: str, playpen: Playpen, platform: str = "cpu") -> None:
        self._process = subprocess.Popen(
            [python, str(_PEER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # A GPU would round 32-bit factors to fewer bits by default.
            env={**os.environ, "JAX_PLATFORMS": platform, "JAX_DEFAULT_MATMUL_PRECISION": "highest"},
        )
        self.versions: dict[str, str] = self._ask(json.dumps(scene(playpen)))

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self._process.communicate()

    def row(self, name: str, robots: int, seconds: float) -> Row:
        """Return a row of this number of robots for this time [s]."""
        steps = round(seconds * 1e9) // units.SCAN_NS

        def run() -> RunTimes:
            answer = self._ask(f"{robots} {steps}")
            return RunTimes(answer["wall"], answer["cpu"])

        return Row(name, robots * seconds, run, generation if robots > 1 else lambda rate: "")

    def _ask(self, line: str) -> dict[str, Any]:
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        try:
            print(line, file=stdin, flush=True)
            return json.loads(stdout.readline())
        except (BrokenPipeError, json.JSONDecodeError):
            self._process.kill()
            error_lines = self._process.communicate()[1].strip().splitlines() or ["it printed nothing"]
            raise KhepTwinError(f"Kheperax failed: {error_lines[-1]}") from None


def scene(playpen: Playpen) -> dict[str, Any]:
    """Return a playpen as Kheperax's process reads it: lengths in mm, angles in rad."""
    robot, arena = playpen.robots[0], playpen.arena
    lines = [_edges(arena.outline_mm, True)] if arena.outline_mm else []
    lines += [_edges(wall.points_mm, wall.closed) for wall in playpen.walls]
    lines += [_edges(corners(thing.footprint), True) for thing in (*playpen.blocks, *playpen.cylinders)]
    headings = calibration.read(robot.calibration)[0].heading_deg
    return {
        "width_mm": arena.width_mm,
        "height_mm": arena.height_mm,
        "walls_mm": [edge for line in lines for edge in line],
        "start": [robot.x_mm, robot.y_mm, math.radians(robot.heading_deg)],
        "radius_mm": units.BODY_RADIUS * 1000,
        "reach_mm": REACH_MM,
        "headings": [math.radians(heading) for heading in headings],
        "pulse_mm": units.PULSE_LENGTH * 1000,
        "weights": kernel.DEMO_WEIGHTS,
        "divisor": kernel.DEMO_DIVISOR,
        "speed": kernel.DEMO_SPEED_PULSES,
        "top_speed": 127,
    }


def corners(shape: Footprint) -> list[tuple[float, float]]:
    """Return the corners of an object's outline, with `N_SIDES` sides for a disc [mm]."""
    if isinstance(shape, Circle):
        angles = [2 * math.pi * side / N_SIDES for side in range(N_SIDES)]
        offsets = [(shape.radius_mm * math.cos(angle), shape.radius_mm * math.sin(angle)) for angle in angles]
    else:
        (c, s), _ = shape.axes()
        halves = [
            (along * shape.length_mm / 2, across * shape.width_mm / 2) for along, across in _CORNER_SIGNS
        ]
        offsets = [(along * c - across * s, along * s + across * c) for along, across in halves]
    return [(shape.x_mm + dx, shape.y_mm + dy) for dx, dy in offsets]


def _edges(points: Sequence[tuple[float, float]], closed: bool) -> list[tuple[float, ...]]:
    """Return x, y, x, y [mm] of each piece of a line."""
    ends = [*points[1:], points[0]] if closed else points[1:]
    return [(*start, *end) for start, end in zip(points, ends, strict=False)]
