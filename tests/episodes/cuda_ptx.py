"""Compile the kernel to PTX (NVIDIA's intermediate code) without a GPU: python cuda_ptx.py STAMP PLAYPEN.

Print the stamp of the sources, and the size of the PTX unless STAMP is that stamp.
"""

import gc
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import cuda, types
from numba.cuda import dispatcher
from numba.cuda.typing.typeof import typeof

from khep_twin import ConstantSpeed, Playpen, rollout
from khep_twin.episodes import device
from khep_twin.episodes.cuda import kernel
from khep_twin.simulation.compiled import digest_of

GPU = SimpleNamespace(compute_capability=(9, 0), MULTIPROCESSOR_COUNT=1)


class GpuArray(np.ndarray):
    """Array that replaces one on a GPU."""

    def copy_to_host(self, to: Any = None) -> Any:
        return np.array(self)


class Compiler:
    """Kernel that is compiled and not launched."""

    def __init__(self, capacity: int, model: str) -> None:
        self._capacity = capacity

    def __getitem__(self, configuration: object) -> Any:
        return self._compile

    def _compile(self, *arguments: Any) -> None:
        signature = types.void(*map(type_of, arguments))
        run = kernel.make_run(self._capacity)
        # `cuda.compile` calls the function of this name in another module.
        sys.modules["numba.cuda.compiler"].compile_cuda = dispatcher.compile_cuda
        ptx, _ = cuda.compile(run, signature, cc=(9, 0), device=False, abi="numba", opt=False)
        assert ".visible .entry" in ptx
        print(STAMP, len(ptx))
        sys.exit()


def type_of(value: Any) -> Any:
    if isinstance(value, tuple):
        kinds = [type_of(item) for item in value]
        return types.NamedTuple(kinds, type(value)) if hasattr(value, "_fields") else types.Tuple(kinds)
    return typeof(value.view(np.ndarray) if isinstance(value, GpuArray) else value)


FAMILY = Playpen.load(PLAYPEN := sys.argv[2]).robots[0].robot_model.family
STAMP = f"{kernel.stamp_of(FAMILY)}-{digest_of([Path(__file__)])}"

if __name__ == "__main__":
    if sys.argv[1] == STAMP:
        print(STAMP)
        sys.exit()
    gc.disable()  # a tenth of the time
    dispatcher.get_current_device = cuda.get_current_device = lambda: GPU
    cuda.to_device = lambda array: np.ascontiguousarray(array).view(GpuArray)
    cuda.device_array = lambda shape, dtype: np.zeros(shape, dtype).view(GpuArray)
    kernel.kernel, device.find_gpu_error = Compiler, lambda: ""
    rollout(PLAYPEN, ConstantSpeed(9, 9), range(2), 0.04, planar=True, device="cuda")
    raise SystemExit("the kernel was not launched")
