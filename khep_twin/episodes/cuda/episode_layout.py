"""Memory layout of episodes on a GPU, and their constants, as the CPU prepares them.

A thread's local memory is an array of 64-bit words, which holds the parts of `kernel.LocalMemory` one after
the other. The parts before the buffers are the episode's state, which is stored between launches.
"""

from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.cuda.kernel import LocalMemory
from khep_twin.episodes.cuda.views import N_STATE_COLUMNS
from khep_twin.episodes.planar import planar_world
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.plane import Plane
from khep_twin.episodes.stepping import EpisodeArguments
from khep_twin.robots.core import core_of_fields

State = NDArray[np.int64]
"""State of an episode (n_words,), or of several (n_words, n), as 64-bit words."""

BUFFERS = "contacts", "hidden"
"""Fields of the plane's record that are buffers."""

PLANE_FIELDS = tuple(name for name in planar_world.STATE_FIELDS if name not in BUFFERS)
"""Fields of the plane's record that belong to an episode's state; of the robot's, see `robot_fields`."""

_NOT_IN_ROBOTS = "sensors.proximity.table", "sensors.proximity.surfaces"
_NOT_IN_PLANES = frozenset({*PLANE_FIELDS, *BUFFERS})
"""Fields that the records of constants leave out, besides the robot's state."""

_MIN_WORDS = 1024
"""Smallest size of local memory in words (assumed); a power of two, so that few kernels are compiled."""


class EpisodeLayout:
    """Memory layout of all episodes of one shape.

    Args:
        arguments: Arguments of one of the episodes.

    Attributes:
        templates: For each part, an array of its shape and type.
        offsets: For each part, the index of its first word.
        n_state: Number of words of the state.
        capacity: Number of words of local memory.
        controllers: Controllers of that episode.
        outputs: Indices of the state's words that each launch returns: "joints", "impulses", "sums", and
            "objects" for the movable objects.
    """

    def __init__(self, arguments: EpisodeArguments) -> None:
        controllers, plane = arguments.controllers, _plane(arguments)
        state_arrays, fields_by_record = list(_state_arrays(arguments)), dict[str, list[Any]]()
        for path, array in state_arrays:
            shape = () if array.dtype.names else array.shape
            fields_by_record.setdefault(path[0], []).append((path[-1], array.dtype, shape))
        state_fields = [
            (name, np.dtype(parts, align=True)) if name in ("robot", "plane") else parts[0]
            for name, parts in fields_by_record.items()
        ]
        surfaces = arguments.groups[0]["sensors"]["proximity"]["surfaces"]
        plane_buffers = np.dtype([(name, plane.robot.dtype[name]) for name in BUFFERS], align=True)
        proximity = np.dtype([("surfaces", surfaces.dtype, surfaces.shape[1:])])
        self._n_fixed, self._n_movable = len(plane.fixed_by_distance), len(plane.bodies)
        self._shared_properties = _shared_properties(arguments)
        self.controllers = controllers
        self.templates = LocalMemory(
            np.zeros(1, np.dtype(state_fields, align=True)),
            controllers.memory,
            np.zeros(self._n_fixed * N_STATE_COLUMNS + self._n_movable * planar.N_COLUMNS),
            plane.fixed_by_distance,
            plane.bodies,
            np.zeros(1, np.dtype([("plane", plane_buffers), ("proximity", proximity)], align=True)),
            controllers.neurons,
            plane.near,
            plane.obstacle_contacts[: len(plane.obstacle_contacts) if len(plane.bodies) else 0],
        )
        ends = np.cumsum([array.nbytes // 8 for array in self.templates]).tolist()
        self.offsets = LocalMemory(0, *ends[:-1])
        self.n_state = self.offsets.buffers
        self.capacity = max(_MIN_WORDS, 1 << (ends[-1] - 1).bit_length())
        starts = np.cumsum([0, *(array.nbytes // 8 for _, array in state_arrays)]).tolist()
        words = {path: range(*pair) for (path, _), pair in zip(state_arrays, pairwise(starts), strict=True)}
        self.outputs = {
            "joints": words["plane", "joints"],
            "impulses": words["plane", "impulses"],
            "sums": words[("sums",)],
            "objects": range(
                self.offsets.obstacles + self._n_fixed * N_STATE_COLUMNS, self.offsets.fixed_by_distance
            ),
        }

    def matches(self, arguments: EpisodeArguments) -> bool:
        """Return whether an episode has as many obstacles, and the same kind of controller and line."""
        return _shared_properties(arguments) == self._shared_properties

    def pack(self, arguments: EpisodeArguments) -> State:
        """Return the state of an episode from its arrays (n_state,)."""
        obstacles = arguments.scene[0]
        fixed, movable = (
            obstacles[: self._n_fixed, planar.DISTANCE : planar.TANGENT_IMPULSE + 1],
            obstacles[self._n_fixed :],
        )
        columns = np.concatenate([fixed.ravel(), movable.ravel()])
        return np.concatenate([part.reshape(-1).view(np.int64) for part in self._parts(arguments, columns)])

    def unpack(self, state: State, arguments: EpisodeArguments) -> None:
        """Set an episode's arrays to its state (n_state,)."""
        obstacles, columns = arguments.scene[0], self.templates.obstacles.copy()
        parts = list(self._parts(arguments, columns))
        ends = np.cumsum([part.nbytes // 8 for part in parts])[:-1]
        for part, words in zip(parts, np.split(state, ends), strict=True):
            part[...] = words.view(part.dtype).reshape(part.shape)
        n_words = self._n_fixed * N_STATE_COLUMNS
        fixed = columns[:n_words].reshape(-1, N_STATE_COLUMNS)
        obstacles[: self._n_fixed, planar.DISTANCE : planar.TANGENT_IMPULSE + 1] = fixed
        obstacles[self._n_fixed :] = columns[n_words:].reshape(-1, planar.N_COLUMNS)

    def objects(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return x, y [m] and heading [rad] of the movable objects (n, n_objects, 3).

        Args:
            columns: Columns of the movable objects of n episodes (n_words, n).
        """
        rows = columns.reshape(self._n_movable, planar.N_COLUMNS, columns.shape[1])
        headings = np.arctan2(rows[:, planar.SINE], rows[:, planar.COSINE])
        x, y = rows[:, planar.CENTRE_X], rows[:, planar.CENTRE_Y]
        return np.stack([x, y, headings], axis=-1).swapaxes(0, 1)

    def _parts(self, arguments: EpisodeArguments, columns: NDArray[np.float64]) -> Iterator[NDArray[Any]]:
        """Yield the arrays of an episode's state, with the obstacles' changing columns."""
        plane = _plane(arguments)
        yield from (array for _, array in _state_arrays(arguments))
        yield from (arguments.controllers.memory, columns, plane.fixed_by_distance, plane.bodies)


def robot_fields(arguments: EpisodeArguments) -> tuple[str, ...]:
    """Return the fields of the robot's record that belong to an episode's state."""
    core = core_of_fields(arguments.groups[0].dtype.names)
    return *(core.changing if core else ()), "noise"


def episode_constants(arguments: EpisodeArguments) -> dict[str, NDArray[Any]]:
    """Return an episode's constants by the names of `kernel.Constants`, from `tables` on."""
    controllers, robots, plane = arguments.controllers, arguments.groups[0], _plane(arguments)
    return {
        "tables": arguments.tables,
        "genes": controllers.genes,
        "home": controllers.home,
        "obstacles": plane.obstacles,
        "table": robots["sensors"]["proximity"]["table"][0],
        "timing": arguments.timing,
        "law": arguments.law,
        "bulbs": arguments.bulbs,
        "hidden": arguments.hidden,
        "powers": arguments.powers,
        "paint": plane.paint,
        "robots": _remove_fields(robots[0], frozenset({*robot_fields(arguments), *_NOT_IN_ROBOTS})),
        "planar_robots": _remove_fields(plane.robot[0], _NOT_IN_PLANES),
    }


def _plane(arguments: EpisodeArguments) -> Any:
    """Return the plane of an episode, with arrays as fields."""
    return Plane(*arguments.scene)


def _shared_properties(arguments: EpisodeArguments) -> tuple[object, ...]:
    """Return the properties that all episodes of a batch must share."""
    controllers, plane = arguments.controllers, _plane(arguments)
    network = controllers.sizes.tolist(), controllers.recurrent, controllers.top_speed
    terms = controllers.terms.tolist()
    counts = len(plane.fixed_by_distance), len(plane.bodies)
    return *counts, controllers.kind, *network, terms, controllers.line.tolist()


def _state_arrays(arguments: EpisodeArguments) -> Iterator[tuple[tuple[str, ...], NDArray[Any]]]:
    """Yield the state's arrays of a fixed size, each after its path in the state's record."""
    robot, plane = (arguments.groups[0], robot_fields(arguments)), (_plane(arguments).robot, PLANE_FIELDS)
    for record_name, (records, names) in (("robot", robot), ("plane", plane)):
        for name in names:
            yield (record_name, name), records[name] if records[name].dtype.names else records[name][0]
    for name in ("sums", "events", "host_registers"):
        yield (name,), getattr(arguments.controllers, name)
    yield ("counters",), arguments.counters


def _remove_fields(record: Any, paths: frozenset[str]) -> Any:
    """Return a record without the fields at some paths, names joined by points (`sensors.noise`)."""
    reduced: Any = np.zeros((), _remove_from_type(record.dtype, paths))
    for name in reduced.dtype.names:
        part = record[name]
        reduced[name] = _remove_fields(part, _subpaths(paths, name)) if part.dtype.names else part
    return reduced


@cache
def _remove_from_type(record_type: Any, paths: frozenset[str]) -> Any:
    fields = {name: record_type[name] for name in record_type.names if name not in paths}
    fields = {
        name: _remove_from_type(field, _subpaths(paths, name)) if field.names else field
        for name, field in fields.items()
    }
    return np.dtype(list(fields.items()), align=True)


def _subpaths(paths: frozenset[str], name: str) -> frozenset[str]:
    return frozenset(path.partition(".")[2] for path in paths if path.startswith(f"{name}."))
