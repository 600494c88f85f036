"""Chance, always from a seed and a name.

Nothing in khep_twin draws from a global generator. Whoever needs chance is handed a stream, and a stream
is known by the run's seed and a name, so adding a new one never changes what the others draw.
"""

import hashlib

import numpy as np

SEED_LIMIT = 2**63
"""Seeds run from 0 to one less than this: what every file format and language can hold."""


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """The generator named `names` of the run with this `seed`.

    The same seed and names give the same draws in any process, whatever other streams exist.

    Raises:
        ValueError: the seed is negative or too large, or no name is given.
    """
    if not 0 <= seed < SEED_LIMIT:
        raise ValueError(f"seed {seed} is outside 0 to 2**63-1")
    if not names:
        raise ValueError("a stream needs a name")
    # A hash and not hash(): Python salts the latter anew in each process.
    digest = hashlib.sha256("\0".join(map(str, names)).encode()).digest()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, int.from_bytes(digest)])))
