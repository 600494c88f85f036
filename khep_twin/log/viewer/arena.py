"""Additions to the arena view: rays of the sensors, trails of the robots, light of the lamps, and events.

The log contains poses and readings. Ray lengths are computed in the log's scene, like those of rangefinders.
"""

# rerun's and MuJoCo's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportAttributeAccessIssue=false

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk

from khep_twin import playpen as playpens
from khep_twin.drawing.light_map import illumination
from khep_twin.errors import LogError
from khep_twin.log.attached import compile_shapes, playpen_of
from khep_twin.log.channels import BASE_FRAME, MAP
from khep_twin.log.description import led_positions
from khep_twin.log.reader import Label
from khep_twin.log.robot_models import models_of
from khep_twin.log.viewer.collected import Collector, Poses, Samples, time_column
from khep_twin.units import metres

Floats = NDArray[np.float64]

RAY_LIMIT = 0.06
"""Longest drawn ray [m]: slightly more than a sensor's range."""

TRAIL_POINTS = 20_000
"""Maximum number of points of a trail; longer ones are subsampled regularly."""

LABEL_LIMIT = 6
"""Maximum number of events with permanent texts in the arena; with more, texts are shown on hovering only."""

_N_RAYS = 5  # per sensor
_NO_HIT_RGBA, _FAR_RGB, _NEAR_RGB = (190, 190, 185, 255), np.array((150, 150, 150)), np.array((228, 30, 20))
TRAIL_COLOUR = (94, 53, 177)
"""Colour of a robot's trail."""

EVENT_PATH = "/event_marks"
"""Entity path of the event marks in the arena."""

_EVENT_COLOUR = (255, 183, 77)
_FLOOR_COLOUR, _GLOW_COLOUR = np.array((237.0, 235.0, 224.0)), np.array((255.0, 184.0, 31.0))
_HALF_GLOW_IRRADIANCE = 3e-4
"""Irradiance at half the maximum glow of the floor [W/mm^2], as on maps."""

_GLOW_PIXELS = 200  # along the longer side of the floor
_TRAIL_HEIGHT = 0.0015  # above the patches painted on the floor [m]
_STATE_LIMIT = 32
"""Maximum number of lamp combinations whose light is computed."""


class Rays:
    """Rays of the sensors of a log's robots, cast in the log's scene."""

    def __init__(self, label: Label, source: object) -> None:
        self._model = compile_shapes(label.attachments, label.robots, source)
        self._models = models_of(label.attachments, label.robots)
        self._data = mujoco.MjData(self._model)
        self._qpos_addresses = {
            self._model.body(self._model.jnt_bodyid[joint]).name: int(self._model.jnt_qposadr[joint])
            for joint in np.flatnonzero(self._model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        }

    def chunks(self, robot: str, samples: Samples, poses: Poses) -> list[Chunk]:
        """Return rays at the times of samples, coloured by the reading, up to the first hit.

        `poses` contains the poses of all bodies at these times, or at more.
        """
        rows = poses.rows_at(samples.times_ns)
        if rows is None or not len(rows):
            return []
        ends, hits = self._cast(robot, poses, rows)
        n, names = len(rows), self._models[robot].body.cameras
        strips = np.empty((n, len(names), _N_RAYS, 2, 3), np.float32)
        starts = [self._model.camera(f"{robot}/{name}").pos for name in names]
        strips[..., 0, :], strips[..., 1, :] = np.array(starts)[None, :, None], ends
        intensity = np.sqrt(np.clip(samples.proximity / self._models[robot].bars["proximity"].full, 0, 1))[
            ..., None
        ]
        colours = np.empty((n, len(names), _N_RAYS, 4), np.uint8)
        colours[..., :3] = (_FAR_RGB + intensity * (_NEAR_RGB - _FAR_RGB))[:, :, None]
        colours[..., 3] = 255
        colours[~hits] = _NO_HIT_RGBA
        path, n_lines = f"/obstacles/{robot}_sensors", len(names) * _N_RAYS
        lines = strips.reshape(-1, 2, 3), colours.reshape(-1, 4)
        return line_chunks(
            path, BASE_FRAME.format(robot), samples.times_ns, *lines, radius=0.0004, n_lines=n_lines
        )

    def led_positions(self, robot: str) -> Floats:
        """Return the positions of a robot's LEDs in its frame (n, 3) [m]."""
        return led_positions(self._model, robot)

    def _cast(self, robot: str, poses: Poses, rows: NDArray[np.intp]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the ends of rays in the robot's frame (n, sensors, rays, 3) [m], and a mask of the hits."""
        model, data = self._model, self._data
        base = model.body(f"{robot}/base").id
        is_robot_body = model.body_rootid == base
        cameras = [model.camera(f"{robot}/{name}").id for name in self._models[robot].body.cameras]
        angles = np.arctan(np.linspace(-1, 1, _N_RAYS))
        # A camera looks along its negative z axis, with x to the right.
        ray_directions = np.column_stack((np.sin(angles), np.zeros(_N_RAYS), -np.cos(angles)))
        ends = np.empty((len(rows), len(cameras), _N_RAYS, 3))
        hits = np.zeros((len(rows), len(cameras), _N_RAYS), bool)
        geoms, lengths = np.zeros(_N_RAYS, np.int32), np.zeros(_N_RAYS)
        for index, row in enumerate(rows.tolist()):
            for name, address in self._qpos_addresses.items():
                if name in poses.bodies:
                    data.qpos[address : address + 7] = poses.bodies[name][row, [0, 1, 2, 6, 3, 4, 5]]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            rotation, origin = data.xmat[base].reshape(3, 3), data.xpos[base]
            for channel, camera in enumerate(cameras):
                rays = ray_directions @ data.cam_xmat[camera].reshape(3, 3).T
                eye = data.cam_xpos[camera]
                mujoco.mj_multiRay(
                    model, data, eye, rays.ravel(), None, True, base, geoms, lengths, None, _N_RAYS, RAY_LIMIT
                )
                hit = (geoms >= 0) & (lengths >= 0) & (lengths <= RAY_LIMIT)
                hit &= ~is_robot_body[model.geom_bodyid[geoms]]
                hits[index, channel] = hit
                ray_lengths = np.where(hit, lengths, RAY_LIMIT)[:, None]
                ends[index, channel] = (eye + ray_lengths * rays - origin) @ rotation
        return ends, hits


def trail_chunks(
    entity_path: str,
    times_ns: NDArray[np.int64],
    points: Floats,
    colour: tuple[int, int, int],
    last_pose: Floats | None,
) -> list[Chunk]:
    """Return a trail through points (n, 3) [m] on the floor, one line per time, from `last_pose` on."""
    stride = slice(None, None, -(-len(points) // TRAIL_POINTS) or 1)
    points, times_ns = np.array(points[stride]), times_ns[stride]
    points[:, 2] = _TRAIL_HEIGHT
    if last_pose is not None:
        points = np.vstack((last_pose[:3] * (1, 1, 0) + (0, 0, _TRAIL_HEIGHT), points))
    else:
        times_ns = times_ns[1:]
    if len(points) < 2:
        return []
    strips = np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)
    colours = np.tile(np.array([colour], np.uint8), (len(strips), 1))
    return line_chunks(entity_path, MAP, times_ns, strips, colours, radius=0.0015, n_lines=1)


def line_chunks(
    path: str, frame: str, times_ns: NDArray[np.int64], strips: Any, colours: Any, radius: float, n_lines: int
) -> list[Chunk]:
    """Return lines at an entity path, in a coordinate frame, `n_lines` at each time; `radius` is in m."""
    n = len(times_ns)
    radii = np.full(n * n_lines, radius, np.float32)
    lines = rr.LineStrips3D.columns(strips=strips, colors=colours, radii=radii).partition([n_lines] * n)
    return [frame_chunk(path, frame), Chunk.from_columns(path, [time_column(times_ns)], lines)]


def trail_path(robot: str) -> str:
    """Return the entity path of a robot's trail."""
    return f"/trails/{robot}"


def event_chunks(
    label: Label, collector: Collector, poses: Poses | None, last_poses: Mapping[str, Floats]
) -> list[Chunk]:
    """Return marks of events: at 0 in curves; in the arena at the robot's pose, else that of `last_poses`."""
    times_ns, texts = collector.events()
    if not len(texts):
        return []
    times = time_column(times_ns)
    zeros = rr.Scalars.columns(scalars=np.zeros(len(texts)))
    chunks = [Chunk.from_columns(f"/{robot}/events", [times], zeros) for robot in label.robots]
    positions: list[Floats] = []
    for time_ns, text in zip(times_ns, texts, strict=True):
        robot = _robot_of_event(text, label.robots)
        if poses is not None and (name := f"{robot}/base") in poses.bodies:
            row = min(np.searchsorted(poses.times_ns, time_ns), len(poses.times_ns) - 1)
            positions.append(poses.bodies[name][row, :3])
        elif robot in last_poses:
            positions.append(last_poses[robot][:3])
        else:
            return chunks
    points = rr.Points3D.columns(
        positions=np.array(positions) + np.array((0, 0, 0.003)),
        radii=[0.004] * len(texts),
        colors=[_EVENT_COLOUR] * len(texts),
        labels=texts,
        show_labels=[len(texts) <= LABEL_LIMIT] * len(texts),
    )
    return [*chunks, frame_chunk(EVENT_PATH, MAP), Chunk.from_columns(EVENT_PATH, [times], points)]


class FloorLight:
    """Light of the lamps on the floor over time."""

    def __init__(self, label: Label, source: object) -> None:
        self._source = source
        self._playpen = playpen_of(label.attachments, source)
        self._powers_w = np.array([lamp.power_w * lamp.dim for lamp in self._playpen.lamps])
        self._paths_by_lamps: dict[tuple[bool, ...], str] = {}
        self._is_constant = not any((lamp.on_s or lamp.blink_period_s) for lamp in self._playpen.lamps)
        self._is_constant &= self._playpen.lighting.mode == "all"

    def chunks(self, collector: Collector) -> Iterator[Chunk]:
        """Yield the floor for each new combination of lamps, and the times at which it is visible."""
        times_ns, powers = collector.lamps()
        if not self._powers_w.any() or (powers is None and (self._paths_by_lamps or not self._is_constant)):
            return
        if powers is not None and powers.shape[1] != len(self._powers_w):
            actual = f"{powers.shape[1]} powers in /lamps"
            expected = f"expected {len(self._powers_w)}, as playpen.toml has lamps"
            raise LogError(f"{self._source}: {actual}; {expected}")
        is_on = np.ones((1, len(self._powers_w)), bool) if powers is None else powers > self._powers_w / 2
        changed_rows = np.flatnonzero(np.any(is_on != np.roll(is_on, 1, axis=0), axis=1))
        changed_rows = np.union1d(0, changed_rows)
        shown_paths: list[str] = []
        for row in is_on[changed_rows]:
            lamps_on = tuple(map(bool, row))
            if lamps_on not in self._paths_by_lamps and len(self._paths_by_lamps) < _STATE_LIMIT:
                path = self._paths_by_lamps[lamps_on] = f"/light/{len(self._paths_by_lamps)}"
                yield frame_chunk(path, MAP)
                yield Chunk.from_columns(path, [], _floor_columns(self._playpen, lamps_on))
            # Beyond `_STATE_LIMIT` combinations, the first one is shown.
            shown_paths.append(self._paths_by_lamps.get(lamps_on, "/light/0"))
        if powers is None:
            return
        times = time_column(times_ns[changed_rows])
        for path in self._paths_by_lamps.values():
            # Invisible light has scale 0.
            scales = [(float(shown_path == path),) * 3 for shown_path in shown_paths]
            poses = rr.InstancePoses3D.columns(scales=scales)
            yield Chunk.from_columns(path, [times], poses)


def _floor_columns(playpen: playpens.Playpen, lamps_on: Sequence[bool]) -> Any:
    """Return the floor in the light of the lamps that are on, as columns of rerun."""
    width_mm, height_mm = playpen.arena.width_mm, playpen.arena.height_mm
    pixel_mm = max(width_mm, height_mm) / _GLOW_PIXELS
    columns, rows = max(round(width_mm / pixel_mm), 2), max(round(height_mm / pixel_mm), 2)
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) * width_mm / columns, (np.arange(rows) + 0.5) * height_mm / rows
    )
    lamps = tuple(lamp for lamp, is_on in zip(playpen.lamps, lamps_on, strict=True) if is_on)
    light = illumination(playpen.model_copy(update={"lamps": lamps}), x, y)[..., None]
    colours = _FLOOR_COLOUR + 0.75 * light / (light + _HALF_GLOW_IRRADIANCE) * (_GLOW_COLOUR - _FLOOR_COLOUR)
    width, depth, z = metres(width_mm), metres(height_mm), 0.0004
    mesh = rr.Mesh3D(
        vertex_positions=[[0, 0, z], [width, 0, z], [width, depth, z], [0, depth, z]],
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_normals=[[0, 0, 1]] * 4,
        vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
        albedo_texture=colours.astype(np.uint8),
    )
    batches = mesh.as_component_batches()
    return [batch.partition([len(batch.as_arrow_array())]) for batch in batches]


def _robot_of_event(text: str, robots: Sequence[str]) -> str:
    """Return the robot of an event; the first one for events of the world."""
    match = re.match(r"\[([^\]]*)\]", text)
    return match[1] if match is not None and match[1] in robots else robots[0]


def old_frame_chunks(robots: Sequence[str]) -> list[Chunk]:
    """Return the chunks that join the frames of a log of version 1.0 to those of later ones."""
    frames = [("world", MAP), *((f"{robot}/base", BASE_FRAME.format(robot)) for robot in robots)]
    names = zip(*frames, strict=True)
    parents, children = ([[name] for name in column] for column in names)
    columns = rr.Transform3D.columns(
        translation=[[0.0, 0.0, 0.0]] * len(frames), parent_frame=parents, child_frame=children
    )
    times = time_column(np.zeros(len(frames), np.int64))
    return [Chunk.from_columns("/frames", [times], columns)]


def frame_chunk(entity_path: str, frame: str) -> Chunk:
    """Return the chunk that assigns a coordinate frame to an entity."""
    return Chunk.from_columns(entity_path, [], rr.CoordinateFrame.columns(frame=[frame]))
