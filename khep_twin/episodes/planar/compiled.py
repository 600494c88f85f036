"""Episodes in a plane compiled by numba.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from khep_twin.episodes import stepping
from khep_twin.episodes.compiled import EPISODE_SOURCES
from khep_twin.episodes.planar import casting, contact_solver, motion, plane, pushing, shadows
from khep_twin.episodes.planar.plane import Plane
from khep_twin.sensing import scene
from khep_twin.sensing.light import Light
from khep_twin.simulation.compiled import compiled
from khep_twin.simulation.foreign import implements, moved
from khep_twin.step import Simulated, StepInputs

PLANE_SOURCES = (*EPISODE_SOURCES, casting, contact_solver, motion, plane, pushing, shadows)
"""Modules that are compiled."""

for query in casting.QUERIES:
    implements(getattr(scene, query.__name__), Plane)(query)


def _run(given, until, stops, joint):
    reason = stepping.DONE
    for turn in range(max(len(joint.rows), 1)):
        own = moved(given, joint.addresses, joint.rows[turn]) if len(joint.rows) else given
        controllers, scene, timing, law, bulbs, hidden, robots, counters, powers, tables = own
        things, order, near, bodies, touches, records = scene
        flat, light = Plane(things, order, near, bodies, touches, records[0]), Light(law[0], bulbs, hidden)
        simulated = Simulated(flat, timing[0], light, robots, counters)
        reason = stepping.run_in_turn(
            controllers, simulated, StepInputs(powers, tables), until, stops, joint, turn
        )
    return reason


run = compiled(_run, PLANE_SOURCES)
"""`stepping.run` in a plane, compiled, of one episode or of many."""
