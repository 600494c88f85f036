"""Episodes in a plane compiled by numba.

Imported only where numba is installed.
"""

# numba is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from khep_twin.rollout import stepping
from khep_twin.rollout.compiled import EPISODE_SOURCES
from khep_twin.rollout.planar import casting, contact_solver, motion, plane, rays, shadows
from khep_twin.rollout.planar.plane import Plane
from khep_twin.rollout.stepping import Controllers
from khep_twin.sensing import scene
from khep_twin.simulation.compiled import compiled
from khep_twin.simulation.foreign import implements
from khep_twin.step import Simulated, StepInputs

for query in casting.QUERIES:
    implements(getattr(scene, query.__name__), Plane)(query)


def _run(simulated: Simulated, controllers: Controllers, inputs: StepInputs, until: int, stops: int) -> int:
    return stepping.run(simulated, controllers, inputs, until, stops)


run = compiled(_run, (*EPISODE_SOURCES, casting, contact_solver, motion, plane, rays, shadows))
"""`stepping.run` in a plane, compiled."""
