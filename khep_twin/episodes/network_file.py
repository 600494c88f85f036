"""Network files: NPZ archives that numpy opens without pickle, and programs in C that run on the robot.

Arrays of an archive, which are checked after reading and before writing:

    format      "khep_twin network"
    version     1
    hidden      neurons of each hidden layer (n_layers,)
    recurrent   whether the first layer has feedback of its last values
    top_speed   speed for an output of 1, in units of the robot's register
    genes       weights, in the order of `networks` (n_genes,)
    inputs      names of the inputs in their order (n_inputs,), such as "proximity left_90"
    commands    terms of turrets that are outputs behind the speeds (n_commands,); left out without any
    model       family of the robot; left out for a Khepera
    zero, one   readings that are inputs of 0 and 1 (n_inputs,)
    period_ns   control period of training [ns]
    playpen     playpen of training, as text; empty if unknown
    seed        seed of training; left out if unknown

A program has the network's tables, functions of the model's part `program`, and `assets/network.c`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from types import FunctionType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khep_twin import units
from khep_twin.clock import NS_PER_S
from khep_twin.episodes import networks
from khep_twin.errors import ControllerError, RobotModelError, choices
from khep_twin.files.atomic import open_regular, write_atomic
from khep_twin.files.npz_file import SIZE_LIMIT, npz_bytes, read_arrays
from khep_twin.randomness import SEED_LIMIT
from khep_twin.robots.model import Interface
from khep_twin.robots.registry import default_model, find_family

SUFFIX, PROGRAM = ".npz", ".c"
"""Suffixes of network files: archives and programs."""

FORMAT, VERSION = "khep_twin network", 1

LIGHT = (484.8, 75.0)
"""Ambient counts in the dark and in the brightest light, of the calibration khepera1."""

_TEXT = "U"
_ARRAY_KINDS = {
    "format": (_TEXT, 0),
    "version": ("iu", 0),
    "hidden": ("iu", 1),
    "recurrent": ("b", 0),
    "top_speed": ("fiu", 0),
    "genes": ("fiu", 1),
    "inputs": (_TEXT, 1),
    "commands": (_TEXT, 1),
    "model": (_TEXT, 0),
    "zero": ("fiu", 1),
    "one": ("fiu", 1),
    "period_ns": ("iu", 0),
    "playpen": (_TEXT, 0),
    "seed": ("iu", 0),
}
"""Kinds and dimensions of the arrays, by name."""

_OPTIONAL = "commands", "model", "seed"

_KIND_NAMES = {"U": "text", "b": "true or false", "iu": "integers", "fiu": "numbers"}


class NetworkContent(NamedTuple):
    """Content of a file, named as in `controllers.Network`."""

    hidden: tuple[int, ...]
    recurrent: bool
    ambient: bool
    terms: tuple[str, ...]
    top_speed: float
    genes: tuple[float, ...]
    period_ns: int
    light: tuple[float, float]
    playpen: str
    seed: int | None
    model: str
    commands: tuple[str, ...] = ()


class Input(NamedTuple):
    """Input of a network: its name, register, limits, and the readings that are 0 and 1."""

    name: str
    register: int
    low: float
    high: float
    zero: float
    one: float

    def scale(self, reading: float) -> float:
        """Return the input for a reading."""
        return (min(max(reading, self.low), self.high) - self.zero) / (self.one - self.zero)


def read(path: Path) -> NetworkContent:
    """Return the content of a file.

    Raises:
        ControllerError: It cannot be read, is not a network file, or is damaged.
    """
    try:
        with open_regular(path) as file:
            return decode(file.read(SIZE_LIMIT + 1), path)
    except OSError as error:
        raise ControllerError(f"cannot be read: {error.strerror}", file=path) from None


def decode(data: bytes, path: Path) -> NetworkContent:
    """Return the content of a file's bytes; `path` is for messages.

    Raises:
        ControllerError: They are not those of a network file, or damaged.
    """
    try:
        return _check_arrays(path, read_arrays(data))
    except ValueError as error:
        raise ControllerError(f"cannot be read: {error}", file=path) from None


def write(path: Path, content: NetworkContent, replace: bool = False) -> None:
    """Write a file, or a program in C; an existing one is replaced, any other file only with `replace`.

    Raises:
        ControllerError: The network cannot be used, its model runs no program, or the name ends otherwise.
        KhepTwinError: Another file exists, or the file cannot be written.
    """
    if path.suffix not in (SUFFIX, PROGRAM):
        raise ControllerError(f"{path}: expected a name that ends in {SUFFIX}, or in {PROGRAM} for a program")
    inputs = describe_inputs(content.ambient, content.terms, content.light, content.model)
    names, _, _, _, zero, one = zip(*inputs, strict=True)
    arrays: dict[str, ArrayLike] = {
        "format": FORMAT,
        "version": VERSION,
        "hidden": np.asarray(content.hidden, None if content.hidden else np.int64),
        "recurrent": content.recurrent,
        "top_speed": float(content.top_speed),
        "genes": np.array(content.genes, np.float64),
        "inputs": names,
        "zero": zero,
        "one": one,
        "period_ns": content.period_ns,
        "playpen": content.playpen,
        **({} if content.seed is None else {"seed": content.seed}),
        **({"commands": content.commands} if content.commands else {}),
        **({} if content.model == default_model().family else {"model": content.model}),
    }
    _check_arrays(path, {name: np.asarray(value) for name, value in arrays.items()})
    may_replace = replace or _is_network(path)
    if not may_replace and path.is_file() and path.stat().st_size:
        raise ControllerError(f"{path}: is there, and no network; expected another name, or replace=True")
    is_archive = path.suffix == SUFFIX
    write_atomic(path, npz_bytes(arrays) if is_archive else _program(content, inputs), may_replace)


def _is_network(path: Path) -> bool:
    try:
        if path.suffix == PROGRAM:
            return path.read_text("latin-1").startswith(_source().splitlines()[0])
        read(path)
    except (ControllerError, OSError):
        return False
    return True


def _source() -> str:
    """Return the program without its tables."""
    return (files("khep_twin") / "assets" / "network.c").read_text()


def _program(content: NetworkContent, inputs: Sequence[Input]) -> bytes:
    """Return the program of a network; raise a `ControllerError` if its model runs none."""
    model, sizes = find_family(content.model), (len(inputs), *content.hidden, 2)
    if "program" not in model.parts:
        raise ControllerError(f"a program in C for model {model.name}, which runs none; expected a file .npz")
    seconds, rest_ns = divmod(content.period_ns, NS_PER_S)
    scales = "".join(f"    {', '.join(map(repr, row[2:]))}, /* {row.name} */\n" for row in inputs)
    tables = f"""\
#define PERIOD {{{seconds}, {rest_ns}}}
#define TOP_SPEED {float(content.top_speed)!r}
#define N_INPUTS {len(inputs)}
#define N_NEURONS {sum(sizes)}
#define N_LAYERS {len(sizes)}
#define N_FEEDBACK {content.recurrent * sizes[1]}
static const int SIZES[] = {{{", ".join(map(str, sizes))}}};
static const double GENES[] = {{{", ".join(map(repr, content.genes))}}};
static const double SCALES[] = {{
{scales.replace("inf,", "INFINITY,")}}};
{model.load("program", FunctionType)([row.register for row in inputs])}"""
    return _source().replace("/* tables */", tables).encode()


def describe_inputs(
    ambient: bool, terms: Sequence[str], light: tuple[float, float], family: str
) -> list[Input]:
    """Return the inputs in their order."""
    model = find_family(family)
    interface, cameras, none = model.episode_interface, model.body.cameras, (-math.inf, math.inf)
    scale = *none, 0.0, float(interface.counts[1])
    parts = [("proximity", interface.proximity, cameras[: interface.n_proximity], scale)]
    if ambient:
        parts.append(("light", interface.ambient, cameras[: interface.n_ambient], (*none, *light)))
    for term in model.place_terms(terms):
        parts.append((term.name, term.registers, term.names, (term.low, term.high, term.zero, term.high)))
    return [
        Input(f"{part} {name}", register, *map(float, scale))
        for part, registers, names, scale in parts
        for register, name in zip(range(*registers), names, strict=True)
    ]


def _check_arrays(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> NetworkContent:
    """Return the content of a file's arrays; raise a `ControllerError` for unusable ones."""

    def refusal(problem: str, expected: str) -> ControllerError:
        return ControllerError(f"{path}: {problem}; expected {expected}")

    if "format" not in arrays or arrays["format"].shape or str(arrays["format"]) != FORMAT:
        names = ", ".join(sorted(arrays)) or "nothing"
        raise refusal(f"no network: an NPZ file of {names[:200]}", "one that Network.save has written")
    for name, (kind, dimensions) in _ARRAY_KINDS.items():
        if name not in arrays and name not in _OPTIONAL:
            raise refusal(f"no {name}", "one")
        if name in arrays and (arrays[name].dtype.kind not in kind or arrays[name].ndim != dimensions):
            shape = "a single one" if dimensions == 0 else "a row of them"
            array_type = f"{name}: {arrays[name].dtype} of shape {arrays[name].shape}"
            raise refusal(array_type, f"{_KIND_NAMES[kind]}, {shape}")
        if name == "version" and int(arrays[name]) != VERSION:
            raise refusal(f"version = {arrays[name]}", f"{VERSION}; is it of a newer khep_twin?")
    for name in arrays.keys() - _ARRAY_KINDS.keys():
        raise ControllerError(f"{path}: {name}: unknown; {choices(name, _ARRAY_KINDS)}")
    return _content(path, arrays, refusal)


def _content(
    path: Path, arrays: Mapping[str, NDArray[np.generic]], refusal: Callable[[str, str], Exception]
) -> NetworkContent:
    """Return the content of arrays of the right kinds; raise `refusal` for unusable values."""
    hidden, genes = tuple(arrays["hidden"].tolist()), tuple(map(float, arrays["genes"].tolist()))
    recurrent, inputs = bool(arrays["recurrent"]), arrays["inputs"].tolist()
    top_speed, period_ns = float(arrays["top_speed"]), int(arrays["period_ns"])
    seed = int(arrays["seed"]) if "seed" in arrays else None
    family = str(arrays["model"]) if "model" in arrays else default_model().family
    commands = tuple(arrays["commands"].tolist()) if "commands" in arrays else ()
    try:
        model = find_family(family)
        model.find_terms(commands, commanded=True)
        interface = model.episode_interface
    except RobotModelError as error:
        raise ControllerError(str(error), file=path) from error
    if not all(1 <= size <= 1000 for size in hidden) or len(hidden) > 100:
        raise refusal(f"hidden = {list(hidden)[:100]}", "1 to 1000 neurons in each of at most 100 layers")
    if not 0 < top_speed <= interface.speed_limit:
        raise refusal(f"top_speed = {top_speed:g}", f"a number above 0 and at most {interface.speed_limit}")
    if period_ns <= 0 or period_ns % units.TICK_NS:
        raise refusal(f"period_ns = {period_ns}", f"whole ticks of {units.TICK_NS} ns")
    if seed is not None and not 0 <= seed < SEED_LIMIT:
        raise refusal(f"seed = {seed}", "an integer from 0 to 2**63-1")
    parts = dict.fromkeys(input_name.partition(" ")[0] for input_name in inputs)
    terms = tuple(name for name in parts if name in model.known_terms)
    n_readings = sum(len(term.names) for term in model.find_terms(terms))
    ambient = len(inputs) > interface.n_proximity + n_readings
    light, index = LIGHT, interface.n_proximity
    zero, one = arrays["zero"].tolist(), arrays["one"].tolist()
    if ambient and len(zero) == len(one) == len(inputs):
        light = float(zero[index]), float(one[index])
    expected_inputs = zip(*describe_inputs(ambient, terms, light, family), strict=True)
    names, _, _, _, *expected_scale = map(list, expected_inputs)
    if len(inputs) != len(names):
        raise refusal(f"{len(inputs)} inputs", _n_inputs_text(interface, n_readings))
    for index, (input_name, name) in enumerate(zip(inputs, names, strict=True)):
        if input_name != name:
            raise refusal(f"inputs[{index}] = {input_name[:40]!r}", repr(name))
    if [zero, one] != expected_scale or not np.isfinite(light).all() or light[0] == light[1]:
        expected = (
            f"proximity from 0 to {interface.counts[1]}, and the same light from dark to bright for all"
        )
        if terms:
            expected += f"; {', '.join(terms)} from {expected_scale[0][-n_readings:]}"
            expected += f" to {expected_scale[1][-n_readings:]}"
        raise refusal(f"inputs are 0 at {zero[:16]} and 1 at {one[:16]} counts", expected)
    layers = len(names), *hidden, 2 + len(commands)
    if len(genes) != (count := networks.n_genes(layers, recurrent)):
        feedback = ", recurrent" if recurrent else ""
        raise refusal(f"{len(genes)} genes", f"{count} for layers of {', '.join(map(str, layers))}{feedback}")
    if (invalid := np.flatnonzero(~np.isfinite(genes))).size:
        raise refusal(f"genes[{invalid[0]}] = {genes[invalid[0]]}", "finite numbers")
    if not (playpen := str(arrays["playpen"])).isprintable() or len(playpen) > 200:
        raise refusal(f"playpen = {playpen[:40]!r}", "a name of at most 200 characters")
    return NetworkContent(
        hidden, recurrent, ambient, terms, top_speed, genes, period_ns, light, playpen, seed, family, commands
    )


def _n_inputs_text(interface: Interface, n_readings: int) -> str:
    n_sensors = interface.n_proximity + n_readings
    return f"{n_sensors}, or {n_sensors + interface.n_ambient} with light"
