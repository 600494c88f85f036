"""Particles of a filter: planar twins with weights, wheels and gains of their own."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.shadow.planes import Planes

Floats = NDArray[np.float64]


@dataclass(slots=True)
class Particles:
    """Particles of a filter.

    Attributes:
        planes: Their twins.
        logs: Logarithms of their weights (n,).
        wheels: Wheels' mean radius, ratio and base, as parts of the calibration's (n, 3).
        gains: Logarithms of each sensor's gain, over the calibration's (n, 8).
        variances: Their variances (n, 8).
        counted: Counters as replied last, less the twins' own (n, 2) [pulses]; NaN before the first reply.
    """

    planes: Planes
    logs: Floats
    wheels: Floats
    gains: Floats
    variances: Floats
    counted: Floats

    def taken(self, indices: NDArray[np.intp]) -> "Particles":
        """Return copies of particles at these indices, with equal weights."""
        logs = np.full(len(indices), -math.log(len(indices)))
        rest = (each[indices] for each in (self.wheels, self.gains, self.variances, self.counted))
        return Particles(self.planes.taken(indices), logs, *rest)

    def __len__(self) -> int:
        return len(self.logs)
