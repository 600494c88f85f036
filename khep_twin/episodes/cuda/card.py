"""The NVIDIA GPU of this machine, as numba-cuda finds it; imported only where numba-cuda is installed."""

# numba-cuda is not typed.
# pyright: basic, reportMissingTypeStubs=false

from functools import cache

from numba import cuda

EPISODES_PER_PROCESSOR = 256
"""Episodes per multiprocessor that fill a GPU: one for each thread, of 255 registers."""


@cache
def find_error() -> str:
    """Return why no GPU can run kernels; empty if one can."""
    if cuda.is_available():
        return ""
    reason = str(cuda.cuda_error() or "no device").strip().partition("\n")[0].rstrip(".: ")
    return f"no NVIDIA GPU: {reason}; expected a GPU and its driver"


def n_processors() -> int:
    """Return the number of multiprocessors; numba's simulator has one."""
    return getattr(cuda.get_current_device(), "MULTIPROCESSOR_COUNT", 1)
