"""Playpens of few lines for tests, and the robot in one as a host has it."""

import json
from typing import Any

from khep_twin.host import Khepera
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin


def arena(width_mm: float = 600, height_mm: float = 500, name: str = "p") -> str:
    """Return the text of a playpen in which nothing stands; `table` and `robot` add to it."""
    return f'version = 1\nname = "{name}"\n[arena]\nwidth_mm = {width_mm}\nheight_mm = {height_mm}\n'


def table(kind: str, **values: object) -> str:
    """Return a table such as [[block]] with these keys."""
    return f"[[{kind}]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())


def robot(x_mm: float, y_mm: float, heading_deg: float = 0, **values: object) -> str:
    """Return the table of a robot."""
    return table("robot", x_mm=x_mm, y_mm=y_mm, heading_deg=heading_deg, **values)


def hosted(playpen: Playpen, **options: Any) -> Khepera:
    """Open a playpen's twin in this process, and a host's end of its line."""
    return Khepera(Serial.of(open_twin(playpen, TwinOptions(**options)), timeout=1.0))
