"""The card of this machine, as numba-cuda finds it.

Imported only where numba-cuda is installed.
"""

# numba-cuda is not typed.
# pyright: basic, reportMissingTypeStubs=false

from functools import cache

from numba import cuda

FILLING = 256
"""Episodes for each multiprocessor of a card that fill it: one for each thread, of 255 registers."""


@cache
def trouble() -> str:
    """Return why there is no card that runs kernels; empty if there is one."""
    if cuda.is_available():
        return ""
    reason = str(cuda.cuda_error() or "no device").strip().partition("\n")[0].rstrip(".: ")
    return f"no NVIDIA card: {reason}; expected a card and its driver"


def n_processors() -> int:
    """Return the number of its multiprocessors, of which numba's simulator has one."""
    return getattr(cuda.get_current_device(), "MULTIPROCESSOR_COUNT", 1)
