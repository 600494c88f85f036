"""Random streams, each from a seed and a name.

Nothing in khep_twin draws from a global generator. Random streams are passed as arguments; each is determined
by the run's seed and a name, so that a new one never changes the draws of the others.
"""

import hashlib
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from khep_twin.errors import SeedError

SEED_LIMIT = 2**63
"""Upper limit of seeds, exclusive: every file format and language can hold smaller ones."""


class StreamState(NamedTuple):
    """Position in a random stream of numpy's PCG64.

    Attributes:
        state: State of the generator.
        increment: Increment of the generator, which distinguishes streams.
        halves: Number of stored 32-bit halves of a draw, 0 or 1.
        half: NetworkContent half.
    """

    state: Annotated[int, Field(ge=0, lt=2**128)]
    increment: Annotated[int, Field(ge=0, lt=2**128)]
    halves: Annotated[int, Field(ge=0, le=1)]
    half: Annotated[int, Field(ge=0, lt=2**32)]


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Return the generator named `names` of the run with this `seed`.

    The same seed and names give the same draws in any process, independent of all other streams.

    Raises:
        SeedError: The seed is negative or too large.
        ValueError: No name is given.
    """
    if not 0 <= seed < SEED_LIMIT:
        raise SeedError(f"seed = {seed}; expected an integer from 0 to 2**63-1")
    if not names:
        raise ValueError("a stream needs a name")
    # SHA-256, because Python salts hash() in each process.
    digest = hashlib.sha256("\0".join(map(str, names)).encode()).digest()
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, int.from_bytes(digest)])))


def key(seed: int, *names: str | int) -> int:
    """Return a key of 64 bits for a counter-based generator; names and errors are those of `stream`."""
    return int(stream(seed, *names).integers(1 << 64, dtype=np.uint64))


def position(rng: np.random.Generator) -> StreamState:
    """Return the position in a random stream."""
    state = rng.bit_generator.state
    inner = state["state"]
    return StreamState(inner["state"], inner["inc"], state["has_uint32"], state["uinteger"])


def resume(rng: np.random.Generator, position: StreamState) -> None:
    """Set a random stream to a position."""
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": position.state, "inc": position.increment},
        "has_uint32": position.halves,
        "uinteger": position.half,
    }
