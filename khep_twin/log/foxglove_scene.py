"""The scene as foxglove_msgs/SceneUpdate, which Foxglove shows without configuration.

One message contains all shapes. Each shape of a fixed body is an entity in the frame "map"; a moving body is
an entity locked to its frame of /tf.
"""

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin.log.cdr import encode
from khep_twin.log.channels import MAP, SCENE
from khep_twin.log.description import Shape, shapes
from khep_twin.log.frames import frame_name
from khep_twin.log.message_types import MessageFields

_IDENTITY = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])  # position, quaternion w, x, y, z


def scene_update(model: mujoco.MjModel) -> bytes:
    """Return the scene as one message; lengths in m."""
    entities: list[MessageFields] = []
    for body in range(model.nbody):
        is_moving = bool(model.body_weldid[body])
        frame = frame_name(model, body) if is_moving else MAP
        pose = _IDENTITY if is_moving else _world_pose(model, body)
        primitives: dict[str, list[MessageFields]] | None = None
        for shape in shapes(model, body):
            # Fixed bodies are not in /tf: each of their shapes is a separate entity, posed in the map.
            if primitives is None or not is_moving:
                name = frame if is_moving else f"{MAP}/{shape.name}"
                primitives = {"cubes": [], "spheres": [], "cylinders": []}
                # The timestamp is the start of the run; without a lifetime it has no end.
                entities.append({"frame_id": frame, "id": name, "frame_locked": True, **primitives})
            _add(primitives, shape, *compose(*pose, shape.position, shape.quaternion))
    return encode(SCENE, {"entities": entities})


def _world_pose(model: mujoco.MjModel, body: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose of a fixed body in the world: position and quaternion w, x, y, z."""
    position, quaternion = _IDENTITY
    while body:
        position, quaternion = compose(model.body_pos[body], model.body_quat[body], position, quaternion)
        body = int(model.body_parentid[body])
    return position, quaternion


def compose(
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    inner_position: NDArray[np.float64],
    inner_quaternion: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compose two poses."""
    origin, rotation = np.zeros(3), np.zeros(4)
    mujoco.mju_mulPose(origin, rotation, position, quaternion, inner_position, inner_quaternion)
    return origin, rotation


def _add(
    primitives: dict[str, list[MessageFields]],
    shape: Shape,
    position: NDArray[np.float64],
    quaternion: NDArray[np.float64],
) -> None:
    """Add a shape to the primitives of an entity; a capsule is a cylinder with a sphere at either end."""
    width, _, length = shape.size

    def add(kind: str, centre: NDArray[np.float64], size: tuple[float, ...], **scales: float) -> None:
        pose = {"position": _components("xyz", centre), "orientation": _components("wxyz", quaternion)}
        sizes, colour = _components("xyz", np.array(size)), _components("rgba", shape.rgba)
        primitives[kind].append({"pose": pose, "size": sizes, "color": colour, **scales})

    if shape.kind == "box":
        add("cubes", position, shape.size)
    elif shape.kind == "sphere":
        add("spheres", position, shape.size)
    else:
        # Both ends are as wide as the middle.
        add("cylinders", position, shape.size, bottom_scale=1.0, top_scale=1.0)
    if shape.kind == "capsule":
        for end in (-1, 1):
            end_centre, _ = compose(position, quaternion, np.array([0, 0, end * length / 2]), _IDENTITY[1])
            add("spheres", end_centre, (width, width, width))


def _components(names: str, values: NDArray[np.floating]) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))
