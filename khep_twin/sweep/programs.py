"""Programs, measures and genomes of a study.

Functions are sent as text, so that workers need none of their files; genomes are from files beside the study,
or drawn at random.
"""

import hashlib
import io
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from khep_twin.episodes.controllers import Driver, Floats, Function
from khep_twin.errors import ControllerError, choices, in_a_line
from khep_twin.files.atomic import read_regular
from khep_twin.files.text import decode
from khep_twin.files.toml_files import show
from khep_twin.randomness import stream
from khep_twin.signals import is_interruption
from khep_twin.sweep.study import NetworkTable, StudyFile


@dataclass(frozen=True, slots=True)
class Program:
    """A function in a file's text, defined by the worker; a controller has a memory of this length."""

    text: str
    file: str
    function: str
    memory: int


def driver_of(driver: Driver | Program) -> Driver:
    """Return a controller, defined and cached if it is a program."""
    return _compiled(driver) if isinstance(driver, Program) else driver


@lru_cache(maxsize=16)
def _compiled(program: Program) -> Driver:
    return Function(function_of(program), program.memory)


@lru_cache(maxsize=32)
def function_of(program: Program) -> Callable[..., Any]:
    """Return the Python function.

    Raises:
        ControllerError: The text fails, or has no such function.
    """
    name = f"khep_twin_study_{hashlib.sha256(program.text.encode()).hexdigest()[:16]}"
    module = ModuleType(name)
    module.__file__ = program.file
    # numba looks up the functions that it compiles by their module.
    sys.modules[name] = module
    try:
        exec(compile(program.text, program.file, "exec"), vars(module))  # the user's own program
    except BaseException as error:
        if is_interruption(error):
            raise
        raise ControllerError(f"{program.file}: {in_a_line(error)}") from error
    found: object = vars(module).get(program.function)
    if not callable(found):
        offers = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise ControllerError(f"no function {program.function!r}; {choices(program.function, offers)}")
    return found


def genomes_of(file: StudyFile, kind: Literal["network", "program"], index: int) -> Floats:
    """Return the genomes of one of a study's controllers (n, n_genes); n_genes is 0 for a program without."""
    table = file.study.networks[index] if kind == "network" else file.study.programs[index]
    wanted = table.network().n_genes if isinstance(table, NetworkTable) else None
    if isinstance(table, NetworkTable) and table.drawn is not None:
        rng = stream(table.drawn_seed, "genomes", table.name)
        return rng.normal(0.0, table.drawn_sd, (table.drawn, wanted or 0))
    if table.genomes is None:
        return np.zeros((1, 0))
    location = (kind, index, "genomes")
    key = f"{kind} {index + 1}: genomes = {show(table.genomes)}"
    try:
        found = _read(file.folder / table.genomes)
    except (OSError, ValueError, TypeError) as trouble:
        reason = (trouble.strerror if isinstance(trouble, OSError) else None) or str(trouble)
        raise file.error(location, f"{key}: cannot be read: {reason.splitlines()[0]}") from None
    if found.ndim != 2 or 0 in found.shape or (wanted is not None and found.shape[1] != wanted):
        right = "finite numbers" if wanted is None else f"rows of {wanted} numbers"
        raise file.error(location, f"{key}: shape {found.shape}; expected {right}")
    if not np.isfinite(found).all():
        raise file.error(location, f"{key}: NaN or infinity; expected finite numbers")
    return found


def _read(path: Path) -> Floats:
    """Return a table of numbers; a single row is accepted."""
    data = read_regular(path)
    if path.suffix == ".npy":
        return np.atleast_2d(np.asarray(np.lib.format.read_array(io.BytesIO(data)), np.float64))
    if path.suffix == ".csv":
        if not data.strip():
            raise ValueError("it is empty")
        return np.loadtxt(io.StringIO(decode(data)), delimiter=",", ndmin=2)
    raise ValueError("expected a .npy or .csv file")
