"""Genomes of a study's controllers: from files beside it, or drawn at random."""

import io
from pathlib import Path
from typing import Literal

import numpy as np

from khep_twin.episodes.controllers import Floats
from khep_twin.files.atomic import read_regular
from khep_twin.files.toml_files import show
from khep_twin.randomness import stream
from khep_twin.sweep.study import NetworkTable, StudyFile


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
        return np.loadtxt(io.StringIO(data.decode("utf-8-sig")), delimiter=",", ndmin=2)
    raise ValueError("expected a .npy or .csv file")
