"""Paths of robots for drawings, and the types that are accepted as paths."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

_MAX_COORDINATE = 100.0
"""Largest coordinate that is accepted [m]; arenas are at most 10 m wide."""


@dataclass(frozen=True, slots=True)
class DrawnPath:
    """The path of one robot.

    Attributes:
        robot: Name of the robot, e.g. "khepera0"; empty for none.
        time_s: Times in ascending order (n,) [s]; None if they are unknown.
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
"""Paths that `draw` accepts: one or several `DrawnPath`s or arrays, or arrays by name."""


def drawn_paths(paths: Paths) -> list[DrawnPath]:
    """Return the paths with at least one point for a drawing; non-finite points are removed.

    Raises:
        ValueError: An array has another shape, or is not in metres.
    """
    drawn: list[DrawnPath] = []
    if isinstance(paths, Mapping):
        for name, positions in cast(Mapping[str, Positions], paths).items():
            drawn += _split_paths(name, positions)
    else:
        value = cast(Any, paths)
        try:
            items = [value] if isinstance(paths, DrawnPath | np.ndarray) else [*value]
        except TypeError:
            expected = "expected arrays of positions [m], or DrawnPaths"
            raise ValueError(f"paths: {type(value).__name__}; {expected}") from None
        for item in items:
            drawn += [item] if isinstance(item, DrawnPath) else _split_paths("", item)
    return [path for path in drawn if len(path.xy_mm)]


def _split_paths(name: str, positions: Positions) -> Iterator[DrawnPath]:
    """Yield the paths of an array of positions."""
    try:
        array = np.asarray(positions, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim < 2 or array.shape[-1] not in (2, 3):
        kind = f"{type(positions).__name__} of shape {array.shape}"
        raise ValueError(f"a path: {kind}; expected positions (n, 2) or poses (n, 3) [m], or a DrawnPath")
    for track in array.reshape(-1, *array.shape[-2:])[..., :2]:
        points = track[np.isfinite(track).all(axis=1)]
        if (largest := np.abs(points).max(initial=0)) > _MAX_COORDINATE:
            raise ValueError(f"a path with a coordinate of {largest:g} m; expected metres, as poses are in")
        yield DrawnPath(name, None, 1000 * points)
