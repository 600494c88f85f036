"""The episode in a plane compiled by numba; `rollout.compiled` is its counterpart in MuJoCo.

Imported only where numba is installed.
"""

# numba is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from types import ModuleType

from numba import njit

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.board.compiled_kernel import compiled_copy
from khep_twin.rollout import compiled_casting, fitness, networks, stepping
from khep_twin.rollout.compiled import SOURCES, announce_compilation, stamped
from khep_twin.rollout.planar import casting, contact_solver, motion, plane, rays, shadows
from khep_twin.rollout.stepping import Advance, ControllerState, RobotState, StepInputs
from khep_twin.sensing import optics


def _copy(module: ModuleType, **others: ModuleType) -> ModuleType:
    return compiled_copy(module, others, "compiled in a plane", inlined=True)


_FLAT = _copy(plane)
_MOTION = _copy(motion, flat=_FLAT, contact_solver=_copy(contact_solver, flat=_FLAT))
_CASTING = _copy(casting, flat=_FLAT, motion=_MOTION, planar_rays=_copy(rays), shadows=_copy(shadows))
# Here, too, a controller is called by its address.
setattr(_CASTING, "decide", compiled_casting.decide)  # noqa: B010
_EPISODE = _copy(
    stepping,
    kernel=_copy(kernel),
    units=_copy(units),
    fitness=_copy(fitness),
    networks=_copy(networks),
    raycast=_CASTING,
    optics=_copy(optics, raycast=_CASTING),
)


def _advance(robot: RobotState, controller: ControllerState, inputs: StepInputs, n_steps: int) -> int:
    return _EPISODE.advance(robot, controller, inputs, n_steps)


_SOURCES = (*SOURCES, casting, motion, contact_solver, rays, shadows, plane)

advance: Advance = announce_compilation(
    njit(nogil=True, cache=True, _nrt=False, error_model="numpy")(stamped(_advance, _SOURCES))
)
"""`stepping.advance` in a plane, compiled."""
