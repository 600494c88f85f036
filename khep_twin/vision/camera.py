"""Line cameras: their images by plain or compiled code, with the same greys."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.line_faces import (
    MovingFaces,
    Places,
    fixed_faces,
    most_faces,
    moving_faces,
    places,
    set_out,
)
from khep_twin.sensing.line_image import take_image
from khep_twin.sensing.line_scene import N_COLUMNS, N_RAYS, Eye, LineScene
from khep_twin.sensing.noise import TABLE_ARRAYS, TABLES, Tables
from khep_twin.simulation.ready import function_of, when_ready
from khep_twin.units import K213_PIXELS, ROOM_LUX

Lamp = tuple[float, float, float, float]
"""Position [m] and power [W] of a lamp: x, y, z, power."""

_CHECKS = 16
"""Number of images between two looks whether the compiled code is ready."""


class LineCamera:
    """A line camera among faces.

    Args:
        fixed: Faces that cannot move (n, N_COLUMNS).
        moving: What can move.
        at: Its positions, live.
        compiled: Compiled code, `see`; by default it is looked for when it is wanted.
    """

    def __init__(
        self,
        fixed: NDArray[np.float64],
        moving: MovingFaces,
        at: Places,
        compiled: Callable[..., int] | None = None,
    ) -> None:
        self._fixed, self._moving, self._at, self._compiled = fixed, moving, at, compiled
        self._n_lamps = -1
        self._key, self._taken = np.zeros(2, np.int64), 0
        self._prepare(0)

    def take(
        self,
        eye: Eye,
        pixels: NDArray[np.int64],
        lamps: Sequence[Lamp],
        room_lux: float,
        exposure_ms: int,
        key: tuple[int, int],
        number: int,
        *,
        noisy: bool = True,
        compiled: bool = False,
    ) -> int:
        """Take an image; return the reading of the light sensor.

        Args:
            eye: Place of the camera.
            pixels: Filled in with greys, 0 to 255, from the left to the right (64,).
            lamps: Lamps with their present powers.
            room_lux: Illuminance by the room's own light [lx].
            exposure_ms: Duration of the scan [ms]; 0 for that by the light of now.
            key: Words of the key of the random draws.
            number: Number of the image.
            noisy: Whether the image is noisy.
            compiled: Whether to use compiled code as soon as it is ready.
        """
        if len(lamps) != self._n_lamps:
            self._prepare(len(lamps))
        self._room[0] = room_lux
        self._lamps[:] = np.reshape(lamps, (-1, 4))
        self._key[:] = key
        if compiled and self._compiled is None and self._taken % _CHECKS == 0:
            self._compiled = when_ready("vision")
        self._taken += 1
        tables: Any = TABLES[noisy]
        if compiled and self._compiled is not None:
            arrays = TABLE_ARRAYS[noisy]
            return self._compiled(*self._arrays, tuple(eye), exposure_ms, arrays, self._key, number, pixels)
        return see(*self._plain, eye, exposure_ms, tables, self._key.data, number, pixels.data)

    def _prepare(self, n_lamps: int) -> None:
        """Make the buffers for a number of lamps."""
        self._n_lamps, n_fixed = n_lamps, len(self._fixed)
        faces = np.zeros((most_faces(self._moving, n_fixed, n_lamps), N_COLUMNS))
        faces[:n_fixed] = self._fixed
        whole = np.int64
        scene: tuple[Any, ...] = (
            faces,
            np.zeros(1, whole),
            np.zeros((n_lamps, 4)),
            np.zeros(1),
            np.zeros(N_RAYS),
            np.zeros(N_RAYS),
            np.zeros(N_RAYS, whole),
            np.zeros(n_lamps, whole),
            np.zeros((2, K213_PIXELS)),
        )
        self._lamps, self._room = scene[2], scene[3]
        self._arrays = scene, n_fixed, tuple(self._moving), tuple(self._at)
        self._plain = (
            LineScene(*_views(scene)),
            n_fixed,
            MovingFaces(*_views(self._moving)),
            Places(*_views(self._at)),
        )


def eye_of(data: mujoco.MjData, camera: int) -> Eye:
    """Return the place of a camera in MuJoCo's scene, which looks level."""
    x, y, height = data.cam_xpos[camera].tolist()
    turn = data.cam_xmat[camera].tolist()
    ahead, left = -turn[2], -turn[5]
    scale = 1 / max(math.sqrt(ahead * ahead + left * left), 1e-6)
    return Eye(x, y, height, ahead * scale, left * scale)


def take_one() -> int:
    """Take an image of nothing by compiled code, which compiles it; return the reading of the light sensor.

    Raises:
        MissingNumbaError: numba is not installed.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    nothing = moving_faces(model, 0), places(mujoco.MjData(model))
    camera = LineCamera(fixed_faces(model), *nothing, function_of("vision"))
    pixels, eye = np.zeros(K213_PIXELS, np.int64), Eye(0.0, 0.0, 0.0, 1.0, 0.0)
    return camera.take(eye, pixels, (), ROOM_LUX, 0, (0, 0), 0, compiled=True)


def see(
    scene: LineScene,
    n_fixed: int,
    moving: MovingFaces,
    at: Places,
    eye: Eye,
    exposure_ms: int,
    tables: Tables,
    key: Vector[int],
    number: int,
    pixels: Vector[int],
) -> int:
    """Take an image by plain code; arguments are those of `set_out` and `take_image`."""
    set_out(scene, n_fixed, moving, at, eye)
    return take_image(scene, eye, exposure_ms, tables, key, number, pixels)


def _views(values: Sequence[Any]) -> list[Any]:
    """Return values with memoryviews of their arrays, which plain code indexes faster."""
    return [value.data if isinstance(value, np.ndarray) else value for value in values]
