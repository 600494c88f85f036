"""Private addresses of MuJoCo's objects and functions: for compiled code, which calls MuJoCo without Python.

The addresses of models and states are attributes that mujoco's Python module keeps to itself; no other file
uses them. Its tests check that what lies there is what the module shows.

MuJoCo's own fatal errors, such as memory that does not suffice, end the process when it is called like this.
What a run can bring about, bad states and full buffers, are warnings that are counted instead.
"""

import ctypes
from functools import cache
from pathlib import Path

import mujoco


def model_address(model: mujoco.MjModel) -> int:
    """Where a model lies in memory."""
    return int(model._address)  # pyright: ignore


def data_address(data: mujoco.MjData) -> int:
    """Where a state lies in memory."""
    return int(data._address)  # pyright: ignore


@cache
def function_address(name: str) -> int:
    """Where a function of MuJoCo's library lies in memory.

    Raises:
        ImportError: the mujoco package has no library, or more than one.
    """
    folder = Path(mujoco.__file__).parent
    found = sorted({*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib")})
    if len(found) != 1:
        raise ImportError(f"{folder}: {len(found)} libraries of MuJoCo; right is one")
    # It is loaded already: this is the same one again.
    library = ctypes.CDLL(str(found[0]))
    return int(ctypes.cast(library[name], ctypes.c_void_p).value or 0)
