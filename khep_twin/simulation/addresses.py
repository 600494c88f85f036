"""Private addresses of MuJoCo's objects and functions, for compiled code that calls MuJoCo without Python.

The addresses of models and states are private attributes of mujoco's Python module; no other file uses
them. The tests compare the memory at these addresses with the arrays of the module.

A fatal error of MuJoCo, such as insufficient memory, ends the process when MuJoCo is called by address.
Errors that a run can cause, bad states and full buffers, are warnings, which MuJoCo only counts.
"""

import ctypes
from functools import cache
from pathlib import Path

import mujoco


def object_address(owner: mujoco.MjModel | mujoco.MjData) -> int:
    """Return the memory address of a model or a state."""
    return int(owner._address)  # pyright: ignore


@cache
def function_address(name: str) -> int:
    """Return the memory address of a function of MuJoCo's library.

    Raises:
        ImportError: The mujoco package has no library, or more than one.
    """
    folder = Path(mujoco.__file__).parent
    libraries = sorted({*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib")})
    if len(libraries) != 1:
        raise ImportError(f"{folder}: {len(libraries)} MuJoCo libraries; expected one")
    # The library is already loaded; this call returns the same one.
    library = ctypes.CDLL(str(libraries[0]))
    return int(ctypes.cast(library[name], ctypes.c_void_p).value or 0)
