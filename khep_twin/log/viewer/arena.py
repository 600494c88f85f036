"""Additions to the scene in the arena view: rays of the sensors, paths, the lamps' light, and events.

The log has poses and readings. Lengths of rays are computed in the log's own scene, as by the rangefinders.
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
from khep_twin.log.attached import bodies_of, playpen_of, shapes_of
from khep_twin.log.reader import Label
from khep_twin.log.viewer.collected import Collector, Poses, Samples, time_column
from khep_twin.units import COUNTS_LIMIT, metres

Floats = NDArray[np.float64]

REACH = 0.06
"""Longest ray that is drawn [m]: a little more than a sensor's range."""

TRAIL_POINTS = 20_000
"""Most points of a path; longer ones are thinned out evenly."""

LABELS = 6
"""Most events with permanent texts in the arena; with more, a text is shown on hovering only."""

_RAYS = 5
_UNLIT_RAY, _NOTHING, _NEAR = (190, 190, 185, 255), np.array((150, 150, 150)), np.array((228, 30, 20))
TRAIL = (94, 53, 177)
"""Colour of a robot's path."""

_EVENT = (255, 183, 77)
_FLOOR, _GLOW = np.array((237.0, 235.0, 224.0)), np.array((255.0, 184.0, 31.0))
_HALF_GLOW = 3e-4
"""Light at which the floor has half its glow [W/mm^2], as on maps."""

_GLOW_PIXELS = 200
_STATES = 32
"""Most combinations of lamps whose light is computed."""


class Rays:
    """Rays of the sensors of a log's robots, cast in the log's scene."""

    def __init__(self, label: Label, source: object) -> None:
        self._model = shapes_of(label.attachments, label.robots, source)
        self._bodies = bodies_of(label.attachments, label.robots, source)
        self._data = mujoco.MjData(self._model)
        self._free = {
            self._model.body(self._model.jnt_bodyid[joint]).name: int(self._model.jnt_qposadr[joint])
            for joint in np.flatnonzero(self._model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        }

    def chunks(self, robot: str, track: Samples, poses: Poses) -> list[Chunk]:
        """Return rays at the times of samples, coloured by the reading and ending at the first hit.

        The poses of all bodies are those of the same times, or of more.
        """
        rows = poses.rows_at(track.times_ns)
        if rows is None or not len(rows):
            return []
        ends, seen = self._cast(robot, poses, rows)
        n, names = len(rows), self._bodies[robot].cameras
        strips = np.empty((n, len(names), _RAYS, 2, 3), np.float32)
        starts = [self._model.camera(f"{robot}/{name}").pos for name in names]
        strips[..., 0, :], strips[..., 1, :] = np.array(starts)[None, :, None], ends
        part = np.sqrt(np.clip(track.proximity / COUNTS_LIMIT, 0, 1))[..., None]
        colours = np.empty((n, len(names), _RAYS, 4), np.uint8)
        colours[..., :3] = (_NOTHING + part * (_NEAR - _NOTHING))[:, :, None]
        colours[..., 3] = 255
        colours[~seen] = _UNLIT_RAY
        place, each = f"/obstacles/{robot}_sensors", len(names) * _RAYS
        lines = strips.reshape(-1, 2, 3), colours.reshape(-1, 4)
        return line_chunks(place, f"{robot}/base", track.times_ns, *lines, 0.0004, each)

    def leds(self, robot: str) -> Floats:
        """Return the places of a robot's LEDs in its frame (n, 3) [m]."""
        model = self._model
        sites = [model.site(index) for index in range(model.nsite)]
        return np.array([site.pos for site in sites if re.fullmatch(rf"{robot}/led_\d+", site.name)])

    def _cast(self, robot: str, poses: Poses, rows: NDArray[np.intp]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the ends of rays in the robot's frame (n, sensors, rays, 3) [m], and which of them hit."""
        model, data = self._model, self._data
        base = model.body(f"{robot}/base").id
        own = model.body_rootid == base
        cameras = [model.camera(f"{robot}/{name}").id for name in self._bodies[robot].cameras]
        angles = np.arctan(np.linspace(-1, 1, _RAYS))
        # A camera looks against its third axis, with its first to the right.
        fan = np.column_stack((np.sin(angles), np.zeros(_RAYS), -np.cos(angles)))
        ends = np.empty((len(rows), len(cameras), _RAYS, 3))
        seen = np.zeros((len(rows), len(cameras), _RAYS), bool)
        geoms, lengths = np.zeros(_RAYS, np.int32), np.zeros(_RAYS)
        for index, row in enumerate(rows.tolist()):
            for name, address in self._free.items():
                if name in poses.bodies:
                    data.qpos[address : address + 7] = poses.bodies[name][row, [0, 1, 2, 6, 3, 4, 5]]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            turn, origin = data.xmat[base].reshape(3, 3), data.xpos[base]
            for channel, camera in enumerate(cameras):
                ways = fan @ data.cam_xmat[camera].reshape(3, 3).T
                start = data.cam_xpos[camera]
                mujoco.mj_multiRay(
                    model, data, start, ways.ravel(), None, True, base, geoms, lengths, None, _RAYS, REACH
                )
                hit = (geoms >= 0) & (lengths >= 0) & (lengths <= REACH)
                hit &= ~own[model.geom_bodyid[geoms]]
                seen[index, channel] = hit
                reach = np.where(hit, lengths, REACH)[:, None]
                ends[index, channel] = (start + reach * ways - origin) @ turn
        return ends, seen


def path_chunks(
    place: str,
    times_ns: NDArray[np.int64],
    points: Floats,
    colour: tuple[int, int, int],
    before: Floats | None,
) -> list[Chunk]:
    """Return a path as one short line for each time, on the floor.

    Of its points (n, 3) [m] heights do not count; `before` is the last one of the piece before.
    """
    thin = slice(None, None, -(-len(points) // TRAIL_POINTS) or 1)
    points, times_ns = np.array(points[thin]), times_ns[thin]
    points[:, 2] = 0.0015  # just above the patches painted on the floor
    if before is not None:
        points, times_ns = np.vstack((before[:3] * (1, 1, 0) + (0, 0, 0.0015), points)), times_ns
    else:
        times_ns = times_ns[1:]
    if len(points) < 2:
        return []
    strips = np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)
    colours = np.tile(np.array([colour], np.uint8), (len(strips), 1))
    return line_chunks(place, "world", times_ns, strips, colours, 0.0015, 1)


def line_chunks(
    place: str, frame: str, times_ns: NDArray[np.int64], strips: Any, colours: Any, radius: float, each: int
) -> list[Chunk]:
    """Return lines in a coordinate frame, `each` of them at each time."""
    n = len(times_ns)
    radii = np.full(n * each, radius, np.float32)
    lines = rr.LineStrips3D.columns(strips=strips, colors=colours, radii=radii).partition([each] * n)
    return [in_frame(place, frame), Chunk.from_columns(place, [time_column(times_ns)], lines)]


def trail(robot: str) -> str:
    """Return the entity path of a robot's trail in a recording."""
    return f"/trails/{robot}"


EVENTS = "/event_marks"
"""Entity path of the arena's marks of events in a recording."""


def event_chunks(
    label: Label, collected: Collector, poses: Poses | None, before: Mapping[str, Floats]
) -> list[Chunk]:
    """Return marks of events: in the arena at the robot's position, in the curves at 0.

    Of a log that comes in pieces, `before` has the last pose of each robot in the pieces before.
    """
    times_ns, texts = collected.events()
    if not len(texts):
        return []
    times = time_column(times_ns)
    zeros = rr.Scalars.columns(scalars=np.zeros(len(texts)))
    chunks = [Chunk.from_columns(f"/{robot}/events", [times], zeros) for robot in label.robots]
    places: list[Floats] = []
    for time_ns, text in zip(times_ns, texts, strict=True):
        robot = _subject(text, label.robots)
        if poses is not None and (name := f"{robot}/base") in poses.bodies:
            row = min(np.searchsorted(poses.times_ns, time_ns), len(poses.times_ns) - 1)
            places.append(poses.bodies[name][row, :3])
        elif robot in before:
            places.append(before[robot][:3])
        else:
            return chunks
    points = rr.Points3D.columns(
        positions=np.array(places) + np.array((0, 0, 0.003)),
        radii=[0.004] * len(texts),
        colors=[_EVENT] * len(texts),
        labels=texts,
        show_labels=[len(texts) <= LABELS] * len(texts),
    )
    return [*chunks, in_frame(EVENTS, "world"), Chunk.from_columns(EVENTS, [times], points)]


class FloorLight:
    """Light of the lamps on the floor, as it changes."""

    def __init__(self, label: Label, source: object) -> None:
        self._source = source
        self._playpen = playpen_of(label.attachments, source)
        self._full = np.array([lamp.power_w * lamp.dim for lamp in self._playpen.lamps])
        self._states: dict[tuple[bool, ...], str] = {}
        self._steady = not any((lamp.on_s or lamp.blink_period_s) for lamp in self._playpen.lamps)
        self._steady &= self._playpen.lighting.mode == "all"

    def chunks(self, collected: Collector) -> Iterator[Chunk]:
        """Yield the floor for each new combination of lamps, and the times at which each is shown."""
        times_ns, powers = collected.lamps()
        if not self._full.any() or (powers is None and (self._states or not self._steady)):
            return
        if powers is not None and powers.shape[1] != len(self._full):
            found = f"{powers.shape[1]} powers in /lamps"
            raise LogError(f"{self._source}: {found}; expected {len(self._full)}, as playpen.toml has lamps")
        on = np.ones((1, len(self._full)), bool) if powers is None else powers > self._full / 2
        changed = np.flatnonzero(np.any(on != np.roll(on, 1, axis=0), axis=1))
        changed = np.union1d(0, changed)
        shown: list[str] = []
        for row in on[changed]:
            state = tuple(map(bool, row))
            if state not in self._states and len(self._states) < _STATES:
                place = self._states[state] = f"/light/{len(self._states)}"
                yield in_frame(place, "world")
                yield Chunk.from_columns(place, [], _lit_floor(self._playpen, state))
            # If lamps are switched in more combinations than that, the first one is shown.
            shown.append(self._states.get(state, "/light/0"))
        if powers is None:
            return
        times = time_column(times_ns[changed])
        for place in self._states.values():
            # Hidden light has no size.
            poses = rr.InstancePoses3D.columns(scales=[(float(each == place),) * 3 for each in shown])
            yield Chunk.from_columns(place, [times], poses)


def _lit_floor(playpen: playpens.Playpen, state: Sequence[bool]) -> Any:
    """Return the floor in the light of the lamps that are on, as columns."""
    width_mm, height_mm = playpen.arena.width_mm, playpen.arena.height_mm
    step = max(width_mm, height_mm) / _GLOW_PIXELS
    columns, rows = max(round(width_mm / step), 2), max(round(height_mm / step), 2)
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) * width_mm / columns, (np.arange(rows) + 0.5) * height_mm / rows
    )
    lamps = tuple(lamp for lamp, lit in zip(playpen.lamps, state, strict=True) if lit)
    light = illumination(playpen.model_copy(update={"lamps": lamps}), x, y)[..., None]
    colours = _FLOOR + 0.75 * light / (light + _HALF_GLOW) * (_GLOW - _FLOOR)
    width, height, level = metres(width_mm), metres(height_mm), 0.0004
    mesh = rr.Mesh3D(
        vertex_positions=[[0, 0, level], [width, 0, level], [width, height, level], [0, height, level]],
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_normals=[[0, 0, 1]] * 4,
        vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
        albedo_texture=colours.astype(np.uint8),
    )
    batches = mesh.as_component_batches()
    return [batch.partition([len(batch.as_arrow_array())]) for batch in batches]


def _subject(text: str, robots: Sequence[str]) -> str:
    """Return the robot that an event is about, the first one for events of the world."""
    found = re.match(r"\[([^\]]*)\]", text)
    return found[1] if found is not None and found[1] in robots else robots[0]


def in_frame(place: str, frame: str) -> Chunk:
    """Return the static coordinate frame of an entity."""
    return Chunk.from_columns(place, [], rr.CoordinateFrame.columns(frame=[frame]))
