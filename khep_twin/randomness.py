"""Random streams, each from a seed and a name.

Nothing in khep_twin draws from a global generator. Random streams are passed as arguments; each is determined
by the run's seed and a name, so that a new one never changes the draws of the others.
"""

import hashlib

import numpy as np

SEED_LIMIT = 2**63
"""Upper limit of seeds, exclusive: every file format and language can hold smaller ones."""


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Return the generator named `names` of the run with this `seed`.

    The same seed and names give the same draws in any process, whatever other streams exist.

    Raises:
        ValueError: The seed is negative or too large, or no name is given.
    """
    if not 0 <= seed < SEED_LIMIT:
        raise ValueError(f"seed = {seed}; expected an integer from 0 to 2**63-1")
    if not names:
        raise ValueError("a stream needs a name")
    # SHA-256, because Python salts hash() in each process.
    digest = hashlib.sha256("\0".join(map(str, names)).encode()).digest()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, int.from_bytes(digest)])))
