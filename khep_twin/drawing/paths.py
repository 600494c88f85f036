"""Paths of robots for drawings, and what is taken for them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

_FARTHEST = 100.0
"""Largest coordinate that is taken for metres; arenas have 10 at most."""


@dataclass(frozen=True, slots=True)
class DrawnPath:
    """The path of one robot.

    Attributes:
        robot: Name of the robot, e.g. "khepera0"; empty for none.
        time_s: Times, rising (n,) [s]; None if they are unknown.
        xy_mm: Positions in the playpen (n, 2) [mm].
    """

    robot: str
    time_s: NDArray[np.float64] | None
    xy_mm: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check the shapes and values.

        Raises:
            ValueError: The shapes are not (n,) and (n, 2), or a number is not finite.
        """
        times = np.zeros(len(self.xy_mm)) if self.time_s is None else self.time_s
        if times.ndim != 1 or self.xy_mm.shape != (len(times), 2):
            raise ValueError(f"shapes {times.shape} and {self.xy_mm.shape} are not (n,) and (n, 2)")
        if not (np.isfinite(times).all() and np.isfinite(self.xy_mm).all()):
            raise ValueError(f"the track of {self.robot} holds a number that is not finite")


Positions = NDArray[np.float64]
"""Positions x, y, or poses x, y and heading, along a path (n, 2 or 3) or several (..., n, 2 or 3) [m]."""

Paths = DrawnPath | Positions | Mapping[str, Positions] | Iterable[DrawnPath | Positions]
"""Paths as `draw` takes them: one or several `DrawnPath`s or arrays, or arrays by name."""


def drawn_paths(paths: Paths) -> list[DrawnPath]:
    """Return paths for a drawing, those of at least one point; points that are not finite are left out.

    Raises:
        ValueError: An array has another shape, or is not in metres.
    """
    found: list[DrawnPath] = []
    if isinstance(paths, Mapping):
        for name, positions in cast(Mapping[str, Positions], paths).items():
            found += _named(name, positions)
    else:
        given = cast(Any, paths)
        try:
            several = [given] if isinstance(paths, DrawnPath | np.ndarray) else [*given]
        except TypeError:
            wanted = "expected arrays of positions [m], or DrawnPaths"
            raise ValueError(f"paths: {type(given).__name__}; {wanted}") from None
        for each in several:
            found += [each] if isinstance(each, DrawnPath) else _named("", each)
    return [path for path in found if len(path.xy_mm)]


def _named(name: str, positions: Positions) -> Iterator[DrawnPath]:
    """Yield the paths of an array of positions."""
    try:
        array = np.asarray(positions, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim < 2 or array.shape[-1] not in (2, 3):
        given = f"{type(positions).__name__} of shape {array.shape}"
        raise ValueError(f"a path: {given}; expected positions (n, 2) or poses (n, 3) [m], or a DrawnPath")
    for each in array.reshape(-1, *array.shape[-2:])[..., :2]:
        there = each[np.isfinite(each).all(axis=1)]
        if (farthest := np.abs(there).max(initial=0)) > _FARTHEST:
            raise ValueError(f"a path with a coordinate of {farthest:g} m; expected metres, as poses are in")
        yield DrawnPath(name, None, 1000 * there)
