"""Private addresses of MuJoCo's objects and functions, for compiled code that calls MuJoCo without Python.

The addresses of models and states are private attributes of mujoco's Python module; no other file uses
them. Its tests compare the memory at these addresses with what the module shows.

MuJoCo's fatal errors, such as insufficient memory, end the process when it is called like this. Errors that
a run can cause, bad states and full buffers, are warnings, which are counted instead.
"""

import ctypes
from functools import cache
from pathlib import Path

import mujoco


def object_address(of: mujoco.MjModel | mujoco.MjData) -> int:
    """Return the memory address of a model or a state."""
    return int(of._address)  # pyright: ignore


@cache
def function_address(name: str) -> int:
    """Return the memory address of a function of MuJoCo's library.

    Raises:
        ImportError: The mujoco package has no library, or more than one.
    """
    folder = Path(mujoco.__file__).parent
    found = sorted({*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib")})
    if len(found) != 1:
        raise ImportError(f"{folder}: {len(found)} MuJoCo libraries; expected one")
    # The library is loaded already; this returns the same one.
    library = ctypes.CDLL(str(found[0]))
    return int(ctypes.cast(library[name], ctypes.c_void_p).value or 0)
