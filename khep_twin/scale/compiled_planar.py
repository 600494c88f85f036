"""The episode in a plane compiled by numba, as `compiled` has it in MuJoCo.

Only imported where numba is installed.
"""

# numba is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from types import ModuleType
from typing import Any

from numba import njit

from khep_twin import fitness, kernel, optics, units
from khep_twin.compiled_kernel import compiled_copy
from khep_twin.scale import (
    compiled_casting,
    episode,
    networks,
    planar_casting,
    planar_motion,
    planar_pushes,
    planar_rays,
    planar_shadows,
    plane,
)
from khep_twin.scale.compiled import SOURCES, announce_compilation, stamped


def _copy(module: ModuleType, **others: ModuleType) -> ModuleType:
    return compiled_copy(module, others, "compiled in a plane", counted=False, within=True)


_FLAT = _copy(plane)
_MOTION = _copy(planar_motion, flat=_FLAT, planar_pushes=_copy(planar_pushes, flat=_FLAT))
_CASTING = _copy(
    planar_casting,
    flat=_FLAT,
    planar_motion=_MOTION,
    planar_rays=_copy(planar_rays),
    planar_shadows=_copy(planar_shadows),
)
# A controller is called by its address here as there.
setattr(_CASTING, "decide", compiled_casting.decide)  # noqa: B010
_EPISODE = _copy(
    episode,
    kernel=_copy(kernel),
    units=_copy(units),
    fitness=_copy(fitness),
    networks=_copy(networks),
    casting=_CASTING,
    optics=_copy(optics, casting=_CASTING),
)


def _advance(body, mind, span, n_steps):
    return _EPISODE.advance(body, mind, span, n_steps)


_SOURCES = (*SOURCES, planar_casting, planar_motion, planar_pushes, planar_rays, planar_shadows, plane)

advance: Any = announce_compilation(
    njit(nogil=True, cache=True, _nrt=False, error_model="numpy")(stamped(_advance, _SOURCES))
)
"""`episode.advance` in a plane, compiled."""
