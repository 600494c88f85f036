"""Line cameras: their images by plain or compiled code, with the same greys."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.line_faces import (
    FacePoses,
    MovingFaces,
    fixed_faces,
    max_faces,
    moving_faces,
    place_faces,
    read_poses,
)
from khep_twin.sensing.line_image import take_image
from khep_twin.sensing.line_scene import N_COLUMNS, N_RAYS, Eye, LineScene
from khep_twin.sensing.noise import Tables, compiled_tables, plain_tables
from khep_twin.simulation.ready import function_of, when_ready
from khep_twin.units import K213_PIXELS, ROOM_LUX

Lamp = tuple[float, float, float, float]
"""Position [m] and power [W] of a lamp: x, y, z, power."""

_CHECK_INTERVAL = 16
"""Number of images after which to check again whether the compiled code is ready."""


class LineCamera:
    """A line camera among faces.

    Args:
        fixed: Faces that cannot move (n, N_COLUMNS).
        moving: Movable geoms and stripes.
        poses: Positions and orientations of the scene, which MuJoCo updates.
        compiled: Compiled `capture`; by default it is loaded when an image requests it and it is ready.
    """

    def __init__(
        self,
        fixed: NDArray[np.float64],
        moving: MovingFaces,
        poses: FacePoses,
        compiled: Callable[..., int] | None = None,
    ) -> None:
        self._fixed = fixed
        self._moving = moving
        self._poses = poses
        self._compiled = compiled
        self._n_lamps = -1
        self._key = np.zeros(2, np.int64)
        self._n_images = 0
        self._prepare(0)

    def take(
        self,
        eye: Eye,
        pixels: NDArray[np.int64],
        lamps: Sequence[Lamp],
        room_lux: float,
        exposure_ms: int,
        noise_key: tuple[int, int],
        image_number: int,
        *,
        noise: float = True,
        compiled: bool = False,
    ) -> int:
        """Take an image; return the reading of the light sensor.

        Args:
            eye: Pose of the camera.
            pixels: Buffer for the greys, 0 to 255, from left to right (64,).
            lamps: Lamps with their current powers.
            room_lux: Illuminance by the room's lighting [lx].
            exposure_ms: Duration of the scan [ms]; 0 to choose it by the current light.
            noise_key: Words of the key of the random draws.
            image_number: Number of the image, which selects its draws.
            noise: Whether the image is noisy, or a scale of its noise.
            compiled: Whether to use compiled code as soon as it is ready.
        """
        if len(lamps) != self._n_lamps:
            self._prepare(len(lamps))
        self._room_lux[0] = room_lux
        self._lamps[:] = np.reshape(lamps, (-1, 4))
        self._key[:] = noise_key
        if compiled and self._compiled is None and self._n_images % _CHECK_INTERVAL == 0:
            self._compiled = when_ready("vision")
        self._n_images += 1
        if compiled and self._compiled is not None:
            tables: Any = compiled_tables(noise)
            return self._compiled(
                *self._compiled_args, tuple(eye), exposure_ms, tables, self._key, image_number, pixels
            )
        tables = plain_tables(noise)
        return capture(*self._plain_args, eye, exposure_ms, tables, self._key.data, image_number, pixels.data)

    def _prepare(self, n_lamps: int) -> None:
        """Make the buffers for a number of lamps."""
        self._n_lamps, n_fixed = n_lamps, len(self._fixed)
        faces = np.zeros((max_faces(self._moving, n_fixed, n_lamps), N_COLUMNS))
        faces[:n_fixed] = self._fixed
        self._lamps = np.zeros((n_lamps, 4))
        self._room_lux = np.zeros(1)
        scene = LineScene(
            faces=faces,
            n_faces=np.zeros(1, np.int64),
            lamps=self._lamps,
            room_lux=self._room_lux,
            depths=np.zeros(N_RAYS),
            luminances=np.zeros(N_RAYS),
            face_index=np.zeros(N_RAYS, np.int64),
            visible_lamps=np.zeros(n_lamps, np.int64),
            weighted_sums=np.zeros((2, K213_PIXELS)),
        )
        self._compiled_args = tuple(scene), n_fixed, tuple(self._moving), tuple(self._poses)
        self._plain_args = (
            LineScene(*_views(scene)),
            n_fixed,
            MovingFaces(*_views(self._moving)),
            FacePoses(*_views(self._poses)),
        )


def eye_of(data: mujoco.MjData, camera: int) -> Eye:
    """Return the pose of a camera in MuJoCo's scene; its pitch is ignored."""
    x, y, height = data.cam_xpos[camera].tolist()
    rotation = data.cam_xmat[camera].tolist()
    dx, dy = -rotation[2], -rotation[5]
    scale = 1 / max(math.sqrt(dx * dx + dy * dy), 1e-6)
    return Eye(x, y, height, dx * scale, dy * scale)


def take_test_image() -> int:
    """Compile the code and take an image of an empty scene; return the reading of the light sensor.

    Raises:
        MissingNumbaError: numba is not installed.
    """
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    empty = moving_faces(model, 0), read_poses(mujoco.MjData(model))
    camera = LineCamera(fixed_faces(model), *empty, function_of("vision"))
    pixels, eye = np.zeros(K213_PIXELS, np.int64), Eye(0.0, 0.0, 0.0, 1.0, 0.0)
    return camera.take(eye, pixels, (), ROOM_LUX, 0, (0, 0), 0, compiled=True)


def capture(
    scene: LineScene,
    n_fixed: int,
    moving: MovingFaces,
    poses: FacePoses,
    eye: Eye,
    exposure_ms: int,
    tables: Tables,
    noise_key: Vector[int],
    image_number: int,
    pixels: Vector[int],
) -> int:
    """Take an image by plain code; the arguments are those of `place_faces` and `take_image`."""
    place_faces(scene, n_fixed, moving, poses, eye)
    return take_image(scene, eye, exposure_ms, tables, noise_key, image_number, pixels)


def _views(values: Sequence[Any]) -> list[Any]:
    """Return values with memoryviews in place of arrays; plain code indexes them faster."""
    return [value.data if isinstance(value, np.ndarray) else value for value in values]
