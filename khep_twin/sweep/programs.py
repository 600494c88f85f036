"""Programs, measures and genomes of a study.

Functions are sent to workers as source text, so that these need no files. Genomes are read from files beside
the study, or drawn at random.
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

from khep_twin.episodes.controllers import Driver, Floats, Function, terms_in
from khep_twin.errors import ControllerError, choices, exception_text
from khep_twin.files.atomic import read_regular
from khep_twin.files.text import decode
from khep_twin.files.toml_files import format_value
from khep_twin.process.signals import is_interruption
from khep_twin.randomness import stream
from khep_twin.sweep.study import NetworkTable, StudyFile

N_ARGUMENTS = 4
"""Number of arguments of a program before its terms: proximity, ambient light, memory and genes."""


@dataclass(frozen=True, slots=True)
class Program:
    """Function in a file's source text, defined by the worker; `memory` is the length of a controller's."""

    text: str
    file: str
    function: str
    memory: int


def driver_of(driver: Driver | Program) -> Driver:
    """Return a controller; a program is executed and cached."""
    if not isinstance(driver, Program):
        return driver
    function = function_of(driver)
    return Function(function, driver.memory, terms=terms_in(function, N_ARGUMENTS))


@lru_cache(maxsize=32)
def function_of(program: Program) -> Callable[..., Any]:
    """Return the Python function.

    Raises:
        ControllerError: The text raises an error, or does not define the function.
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
        raise ControllerError(f"{program.file}: {exception_text(error)}") from error
    member: object = vars(module).get(program.function)
    if not callable(member):
        names = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise ControllerError(f"no function {program.function!r}; {choices(program.function, names)}")
    return member


def genomes_of(
    file: StudyFile, kind: Literal["network", "program"], index: int, n_genes: int | None
) -> Floats:
    """Return the genomes of one of a study's controllers (n, n_genes); n_genes is 0 if it has none.

    Args:
        file: Study.
        kind: Kind of the controller.
        index: Index of the controller among those of its kind.
        n_genes: Length of a network's genome; None for a program.
    """
    table = file.study.networks[index] if kind == "network" else file.study.programs[index]
    if isinstance(table, NetworkTable) and table.drawn is not None:
        rng = stream(table.drawn_seed, "genomes", table.name)
        return rng.normal(0.0, table.drawn_sd, (table.drawn, n_genes or 0))
    if table.genomes is None:
        return np.zeros((1, 0))
    location = (kind, index, "genomes")
    key = f"{kind} {index + 1}: genomes = {format_value(table.genomes)}"
    try:
        genomes = _read_genomes(file.folder / table.genomes)
    except (OSError, ValueError, TypeError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise file.error(location, f"{key}: cannot be read: {reason.splitlines()[0]}") from None
    if genomes.ndim != 2 or 0 in genomes.shape or (n_genes is not None and genomes.shape[1] != n_genes):
        expected = "finite numbers" if n_genes is None else f"rows of {n_genes} numbers"
        raise file.error(location, f"{key}: shape {genomes.shape}; expected {expected}")
    if not np.isfinite(genomes).all():
        raise file.error(location, f"{key}: NaN or infinity; expected finite numbers")
    return genomes


def _read_genomes(path: Path) -> Floats:
    """Return a table of numbers; a single row is accepted."""
    data = read_regular(path)
    if path.suffix == ".npy":
        return np.atleast_2d(np.asarray(np.lib.format.read_array(io.BytesIO(data)), np.float64))
    if path.suffix == ".csv":
        if not data.strip():
            raise ValueError("it is empty")
        return np.loadtxt(io.StringIO(decode(data)), delimiter=",", ndmin=2)
    raise ValueError("expected a .npy or .csv file")
