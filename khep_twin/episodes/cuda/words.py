"""Words of an episode in a thread's local memory, and its constants, as the CPU prepares them."""

from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.cuda.kernel import LocalMemory
from khep_twin.episodes.cuda.views import N_LIVE
from khep_twin.episodes.planar import planar_world
from khep_twin.episodes.planar import plane as flat

Given = tuple[Any, ...]
"""Arguments of the plane's compiled code for one episode, as of `Episode.joint_arguments`."""

Words = NDArray[np.int64]

BUFFERS = "contacts", "hidden"
"""Fields of the record of the plane that are buffers."""

LIVE = {
    "robot": ("registers", "processor", "sensor_states", "strengths", "voltage", "noise"),
    "plane": tuple(name for name in planar_world.LIVE if name not in BUFFERS),
}
"""Fields of the records of the robot and of the plane that each episode has of its own."""

_NOT_IN_ROBOTS = frozenset({*LIVE["robot"], "sensors.proximity.table", "sensors.proximity.found"})
_NOT_IN_PLANES = frozenset({*LIVE["plane"], *BUFFERS})
"""Fields that the records of constants are without."""

_LEAST_WORDS = 1024
"""Least number of words of local memory (assumed); a power of two, so that few kernels are compiled."""


class EpisodeWords:
    """Layout of the words of episodes of one shape: the parts of `kernel.LocalMemory`, one after the other.

    Args:
        given: Arguments of one of the episodes.

    Attributes:
        like: Array of each part of it.
        first: Index of the first word of each.
        n_kept: Number of words that are kept between launches.
        capacity: Number of words of local memory.
        controllers: Controllers of that episode.
        told: Indices of the words of joint positions, impulses and sums, by "joints", "grips" and "sums", and
            of the movable objects, "things".
    """

    def __init__(self, given: Given) -> None:
        controllers, (_, order, near, bodies, touches, planes), *_ = given
        live, fields = list(_live(given)), dict[str, list[Any]]()
        for path, array in live:
            fields.setdefault(path[0], []).append((path[-1], array.dtype, array.shape))
        kept = [
            (name, np.dtype(parts, align=True)) if name in LIVE else parts[0]
            for name, parts in fields.items()
        ]
        found = given[6]["sensors"]["proximity"]["found"]
        plane = np.dtype([(name, planes.dtype[name]) for name in BUFFERS], align=True)
        seen = np.dtype([("found", found.dtype, found.shape[1:])])
        self._n_fixed, self._n_movable = len(order), len(bodies)
        self._shape, self.controllers = _shape_of(given), controllers
        n_own = self._n_fixed * N_LIVE + self._n_movable * flat.N_COLUMNS
        self.like = LocalMemory(
            np.zeros(1, np.dtype(kept, align=True)),
            controllers.memory,
            np.zeros(n_own),
            order,
            bodies,
            np.zeros(1, np.dtype([("plane", plane), ("proximity", seen)], align=True)),
            controllers.values,
            near,
            touches[: len(touches) if len(bodies) else 0],
        )
        ends = np.cumsum([array.nbytes // 8 for array in self.like]).tolist()
        self.first = LocalMemory(0, *ends[:-1])
        self.n_kept = self.first.buffers
        self.capacity = max(_LEAST_WORDS, 1 << (ends[-1] - 1).bit_length())
        starts = np.cumsum([0, *(array.size for _, array in live)]).tolist()
        places = {path: range(*ends) for (path, _), ends in zip(live, pairwise(starts), strict=True)}
        self.told = {
            "joints": places["plane", "joints"],
            "grips": places["plane", "grips"],
            "sums": places[("sums",)],
            "things": range(self.first.things + self._n_fixed * N_LIVE, self.first.order),
        }

    def fits(self, given: Given) -> bool:
        """Return whether an episode has as many obstacles, and the same kind of controller and line."""
        return _shape_of(given) == self._shape

    def take(self, given: Given) -> Words:
        """Return the words of an episode that are kept (n_kept,)."""
        things = given[1][0]
        changing = things[: self._n_fixed, flat.DISTANCE : flat.ACROSS + 1], things[self._n_fixed :]
        own = np.concatenate([part.ravel() for part in changing])
        return np.concatenate([part.reshape(-1).view(np.int64) for part in self._kept(given, own)])

    def put(self, words: Words, given: Given) -> None:
        """Set an episode's own arrays to its words (n_kept,)."""
        things, own = given[1][0], self.like.things.copy()
        parts = list(self._kept(given, own))
        for part, of_it in zip(
            parts, np.split(words, np.cumsum([part.size for part in parts])[:-1]), strict=True
        ):
            part[...] = of_it.view(part.dtype).reshape(part.shape)
        n_words = self._n_fixed * N_LIVE
        things[: self._n_fixed, flat.DISTANCE : flat.ACROSS + 1] = own[:n_words].reshape(-1, N_LIVE)
        things[self._n_fixed :] = own[n_words:].reshape(-1, flat.N_COLUMNS)

    def objects(self, things: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return x, y [m] and heading [rad] of the movable objects (n, n_objects, 3).

        Args:
            things: Numbers of the movable objects of n episodes (n_words, n).
        """
        rows = things.reshape(self._n_movable, flat.N_COLUMNS, things.shape[1])
        headings = np.arctan2(rows[:, flat.SINE], rows[:, flat.COSINE])
        return np.stack([rows[:, flat.CENTRE_X], rows[:, flat.CENTRE_Y], headings], axis=-1).swapaxes(0, 1)

    def _kept(self, given: Given, own: NDArray[np.float64]) -> Iterator[NDArray[Any]]:
        """Yield the arrays of an episode that are kept, with the obstacles' changing numbers."""
        controllers, (_, order, _, bodies, _, _), *_ = given
        yield from (array for _, array in _live(given))
        yield from (controllers.memory, own, order, bodies)


def constants_of(given: Given) -> dict[str, NDArray[Any]]:
    """Return the constants of an episode by the fields of `kernel.Constants` that have rows."""
    controllers, (things, _, _, _, _, planes), timing, law, bulbs, hidden, robots, _, powers, tables = given
    return {
        "tables": tables,
        "genes": controllers.genes,
        "home": controllers.home,
        "things": things,
        "table": robots["sensors"]["proximity"]["table"][0],
        "timing": timing,
        "law": law,
        "bulbs": bulbs,
        "hidden": hidden,
        "powers": powers,
        "robots": _without(robots[0], _NOT_IN_ROBOTS),
        "planes": _without(planes[0], _NOT_IN_PLANES),
    }


def _shape_of(given: Given) -> tuple[object, ...]:
    """Return what all episodes of a batch have in common."""
    controllers, (_, order, _, bodies, _, _), *_ = given
    of_network = controllers.sizes.tolist(), controllers.recurrent, controllers.top_speed
    return len(order), len(bodies), controllers.kind, *of_network, controllers.line.tolist()


def _live(given: Given) -> Iterator[tuple[tuple[str, ...], NDArray[Any]]]:
    """Yield an episode's own arrays of a fixed size, each after its path in the record of them."""
    controllers, (*_, planes), *_ = given
    for part, records in (("robot", given[6]), ("plane", planes)):
        for name in LIVE[part]:
            yield (part, name), records[name][0]
    for name in ("sums", "events", "seen"):
        yield (name,), getattr(controllers, name)
    yield ("counters",), given[7]


def _without(record: Any, paths: frozenset[str]) -> Any:
    """Return a record without the fields at some paths, of names with points between them."""
    made: Any = np.zeros((), _type_without(record.dtype, paths))
    for name in made.dtype.names:
        part = record[name]
        made[name] = _without(part, _below(paths, name)) if part.dtype.names else part
    return made


@cache
def _type_without(kind: Any, paths: frozenset[str]) -> Any:
    fields = {name: kind[name] for name in kind.names if name not in paths}
    fields = {
        name: _type_without(field, _below(paths, name)) if field.names else field
        for name, field in fields.items()
    }
    return np.dtype(list(fields.items()), align=True)


def _below(paths: frozenset[str], name: str) -> frozenset[str]:
    return frozenset(path.partition(".")[2] for path in paths if path.startswith(f"{name}."))
