"""Episodes in a plane compiled by numba; imported only where numba is installed."""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from collections.abc import Callable
from functools import cache

from khep_twin.episodes import stepping
from khep_twin.episodes.compiled import EPISODE_SOURCES
from khep_twin.episodes.planar import casting, contact_solver, motion, plane, pushing, shadows
from khep_twin.episodes.planar.plane import Plane
from khep_twin.sensing import scene
from khep_twin.sensing.light import Light
from khep_twin.sensing.simulated import Simulated, StepInputs
from khep_twin.simulation.compiled import compiled, named, sources_of
from khep_twin.simulation.foreign import implements, relocate
from khep_twin.step import Reason

PLANE_SOURCES = *EPISODE_SOURCES, casting, contact_solver, motion, plane, pushing, shadows
"""Modules that are compiled, besides those of `sources_of`."""

for query in casting.QUERIES:
    implements(getattr(scene, query.__name__), Plane)(query)


def _run(arguments, end_step, stops, slots):
    reason = Reason.DONE.value  # an integer, which numba returns faster
    for i in range(max(len(slots.indices), 1)):
        arrays = relocate(arguments, slots.addresses, slots.indices[i]) if len(slots.indices) else arguments
        episode = stepping.EpisodeArguments(*arrays)
        light = Light(episode.law[0], episode.bulbs, episode.hidden)
        obstacles, fixed_by_distance, near, bodies, obstacle_contacts, paint, robots = episode.scene
        scene = Plane(obstacles, fixed_by_distance, near, bodies, obstacle_contacts, paint, robots[0])
        simulated = Simulated(scene, episode.timing[0], light, episode.groups, episode.counters)
        inputs = StepInputs(episode.powers, episode.tables)
        reason = stepping.run_slot(episode.controllers, simulated, inputs, end_step, stops, slots, i)
    return reason


@cache
def run_of(model: str) -> Callable[..., int]:
    """Return `stepping.run_slot` in a plane for robots of a family, compiled, for one episode or many."""
    return compiled(named(_run, "run", model), (*sources_of(model), *PLANE_SOURCES))
