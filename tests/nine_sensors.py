"""A robot with nine infrared sensors around, a Khepera IV with one more, for a shadow and its log."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from khep_twin import playpen as playpens
from khep_twin.playpen import Playpen
from khep_twin.robots.khepera4.model import KHEPERA_4
from khep_twin.robots.khepera4.registers import GROUND, RING
from khep_twin.robots.registry import installed_models
from khep_twin.sensing import calibration

SENSORS = (*RING, "tail")
HEADING_DEG = 157.5
"""Heading of the ninth sensor, the tail."""

TEXT = """
version = 1
name = "nine"

[arena]
width_mm = 2000
height_mm = 2000

[[robot]]
model = "nine"
x_mm = 110
y_mm = 1000
heading_deg = 0
"""


def nine_playpen(folder: Path, patch: pytest.MonkeyPatch) -> Playpen:
    """Install the model with files in a folder; return a playpen with a wall behind the robot."""
    body, dialect, heading = KHEPERA_4.body, KHEPERA_4.dialect, math.radians(HEADING_DEG)
    x, y = 0.068 * math.cos(heading), 0.068 * math.sin(heading)
    scene, measured = folder / "nine.xml", folder / "nine.toml"
    camera = f'<camera name="tail" class="infrared" pos="{x} {y} 0.01435" xyaxes="{-y} {x} 0 0 0 1"/>'
    first_ground = '<camera name="ground_left"'
    scene.write_text(Path(body.scene).read_text().replace(first_ground, f"{camera}\n{first_ground}"))
    ninths = re.sub(r"(\[(?:[^],]+, ){7})([^],]+)\]", r"\1\2, \2]", calibration.read("khepera4")[1])
    measured.write_text(ninths.replace("180.0, 180.0]", f"180.0, {HEADING_DEG}]"))
    n_values = len(SENSORS) + len(GROUND)
    reads = {
        name: dialect.reads[name]._replace(n_values=n_values, values=range(n_values))
        for name in ("proximity", "ambient")
    }
    model = replace(
        KHEPERA_4,
        name="nine",
        body=replace(
            body,
            sensor_positions=(*body.sensor_positions, (x, y)),
            sensors=(*SENSORS, *GROUND),
            scene=str(scene),
        ),
        calibration=str(measured),
        dialect=dialect._replace(reads={**dialect.reads, **reads}),
    )
    models: Any = installed_models()
    patch.setitem(models, "nine", model)
    return playpens.parse(TEXT, "nine")
