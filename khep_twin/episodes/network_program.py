"""Programs in C of networks, which run on the robot itself: `Network.save("best.c")`.

A program has the network's tables, the functions of the model's part `program`, and `assets/network.c`,
which evaluates the network as a rollout does.
"""

from collections.abc import Sequence
from importlib.resources import files
from types import FunctionType
from typing import TYPE_CHECKING

from khep_twin.errors import ControllerError
from khep_twin.robots.registry import find_family

if TYPE_CHECKING:
    from khep_twin.episodes.network_file import Input, NetworkContent

SUFFIX = ".c"
"""Suffix of programs."""

HEAD, _, _SOURCE = (files("khep_twin") / "assets" / "network.c").read_text().partition("\n")
"""First line of a program."""


def c_source(content: "NetworkContent", inputs: "Sequence[Input]", sizes: Sequence[int]) -> str:
    """Return the source of a network's program.

    Raises:
        ControllerError: Its model has no programs.
    """
    model = find_family(content.model)
    if "program" not in model.parts:
        raise ControllerError(f"a program in C for model {model.name}, which runs none; expected a file .npz")
    registers = [entry.register for entry in inputs]
    numbers = {
        "PERIOD_NS": content.period_ns,
        "TOP_SPEED": float(content.top_speed),
        "N_INPUTS": sizes[0],
        "N_NEURONS": sum(sizes),
        "N_LAYERS": len(sizes),
        "N_FEEDBACK": content.recurrent * sizes[1],
    }
    scales = (", ".join(map(repr, map(float, entry[2:]))) + f", /* {entry.name} */" for entry in inputs)
    lines = (
        *(f"#define {name} {number!r}" for name, number in numbers.items()),
        f"static const int SIZES[] = {{{', '.join(map(str, sizes))}}};",
        f"static const double GENES[] = {{{', '.join(map(repr, content.genes))}}};",
        "static const double SCALES[] = {",
        *(f"    {scale.replace('inf', 'INFINITY')}" for scale in scales),
        "};",
        model.load("program", FunctionType)(registers),
    )
    return f"{HEAD}\n{_SOURCE.replace('/* tables */', chr(10).join(lines))}"
