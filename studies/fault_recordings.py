"""Recordings of stand-in robots with one fault each, with a random start and, if possible, an end."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.playpen import Block, Cylinder, Playpen
from khep_twin.randomness import stream
from khep_twin.units import BODY_RADIUS, N_SENSORS
from stand_ins.hidden_changes import Added, Change, LampMoved, LampOff, Lifted, Moved, Removed
from stand_ins.recordings import Truth
from studies.twin_runs import Recording, alternate

SIDES = ("left", "right")

KHEPERA4_PLAYPENS = "arena4", "arena4-room"
"""Playpens of all faults of a Khepera IV."""

GENERAL_PLAYPENS, OBJECT_PLAYPENS, LAMP_PLAYPENS = (
    ("workshop", "obstacles", "looping-maze"),
    ("workshop", "obstacles"),
    ("workshop", "light-seeking", "two-lamps"),
)
"""Playpens of all faults, of those of objects, and of those of lamps."""

ONSET_S = 12.0, 22.0
"""Range of the faults' start times [s]."""

DURATION_S, TAIL_S = 25.0, 13.0
"""Duration of faults, and of the recording after them [s]."""

_REACH_MM = 45.0
"""Distance from a Khepera's centre at which an object counts as reached: 17 mm from its edge."""

_FAR_MM = 5000.0
"""Offset of objects that `hidden_changes` has removed [mm]."""

STANDING = "dead motor or blocked wheel"


class Trial(NamedTuple):
    """A fault of one trial.

    Attributes:
        names: Right names of the alarm.
        fault: Fault of the robot; empty if it is one of its world.
        changes: Change of its world, and the one that ends it.
    """

    names: tuple[str, ...]
    fault: str = ""
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True, slots=True)
class _TrialSetting:
    """Inputs of a random trial: playpen, truth of the healthy robot, start and end of the fault [s]."""

    playpen: Playpen
    healthy_truth: Truth
    start_s: float
    end_s: float
    rng: np.random.Generator

    @property
    def scale(self) -> float:
        """Size of the robot, as a multiple of a Khepera's."""
        return self.playpen.robots[0].body.radius / BODY_RADIUS

    @property
    def suffix(self) -> str:
        return f"@{self.start_s:g}-{self.end_s:g}"

    def position_at(self, time_s: float) -> tuple[float, float]:
        """Return the healthy robot's position at a time [mm]."""
        x, y, _ = self.healthy_truth.poses[
            int(np.searchsorted(self.healthy_truth.times_ns, time_s * NS_PER_S))
        ].tolist()
        return x * 1e3, y * 1e3


def _draw_sensor_fault(setting: _TrialSetting, kind: str) -> Trial:
    sensor = int(setting.rng.integers(N_SENSORS - 2))
    names = (f"{kind} sensor {sensor}",)
    if kind == "stuck":
        names += (f"dead sensor {sensor}",)  # Right while it reads 0, see `_right`.
    return Trial(names, f"{kind}:{sensor}{setting.suffix}")


def _draw_wheel_fault(
    setting: _TrialSetting, kind: str, name: str, parts: tuple[float, float] | None = None
) -> Trial:
    side = SIDES[int(setting.rng.integers(2))]
    part = "" if parts is None else f":{setting.rng.uniform(*parts):.3f}"
    return Trial((f"{name} {side}",), f"{kind}:{side}{part}{setting.suffix}")


def _first_object(setting: _TrialSetting) -> tuple[str, Block | Cylinder] | None:
    """Return the first object that the robot reaches during the fault; None if it reaches none."""
    times = np.arange(setting.start_s + 1, setting.end_s - 5, 0.1)
    objects = {
        f"{kind}{i}": item for kind, items in _object_lists(setting.playpen) for i, item in enumerate(items)
    }
    for time_s in times.tolist():
        for name, item in objects.items():
            if _distance_mm(item, *setting.position_at(time_s)) < _REACH_MM * setting.scale:
                return name, item
    return None


def _draw_removed(setting: _TrialSetting) -> Trial | None:
    if (first_object := _first_object(setting)) is None:
        return None
    name, item = first_object
    back = Moved(setting.end_s, name, (_FAR_MM + item.x_mm, _FAR_MM + item.y_mm))
    return Trial((f"missing {name}",), "", (Removed(setting.start_s, name), back))


def _draw_moved(setting: _TrialSetting) -> Trial | None:
    if (first_object := _first_object(setting)) is None:
        return None
    name, _ = first_object
    length, direction = setting.scale * setting.rng.uniform(25, 40), setting.rng.uniform(0, math.tau)
    dx, dy = round(length * math.cos(direction), 1), round(length * math.sin(direction), 1)
    return Trial(
        (f"moved {name}",),
        "",
        (Moved(setting.start_s, name, (dx, dy)), Moved(setting.end_s, name, (-dx, -dy))),
    )


def _draw_added(setting: _TrialSetting) -> Trial | None:
    radius = round(setting.scale * setting.rng.uniform(8, 20), 1)
    for time_s in np.arange(setting.start_s + 3, setting.end_s - 8, 0.5).tolist():
        x, y = setting.position_at(time_s)
        if math.dist((x, y), setting.position_at(setting.start_s)) > 60 * setting.scale + radius:
            can = Cylinder(
                x_mm=round(x, 1), y_mm=round(y, 1), radius_mm=radius, height_mm=round(50 * setting.scale)
            )
            return Trial(("unexpected thing",), "", (Added(setting.start_s, can),))
    return None


def _draw_lamp_off(setting: _TrialSetting) -> Trial:
    lamp = int(setting.rng.integers(len(setting.playpen.lamps)))
    return Trial((f"{_lamp_name(setting, lamp)} off",), "", (LampOff(setting.start_s, lamp),))


def _draw_lamp_moved(setting: _TrialSetting) -> Trial:
    lamp = int(setting.rng.integers(len(setting.playpen.lamps)))
    bulb, arena = setting.playpen.lamps[lamp], setting.playpen.arena
    inwards = math.atan2(arena.height_mm / 2 - bulb.y_mm, arena.width_mm / 2 - bulb.x_mm)
    dx = dy = math.inf
    while not (0 <= bulb.x_mm + dx <= arena.width_mm and 0 <= bulb.y_mm + dy <= arena.height_mm):
        length, direction = setting.rng.uniform(80, 150), inwards + setting.rng.uniform(-0.8, 0.8)
        dx, dy = round(length * math.cos(direction), 1), round(length * math.sin(direction), 1)
    return Trial(
        (f"{_lamp_name(setting, lamp)} moved",),
        "",
        (LampMoved(setting.start_s, lamp, (dx, dy)), LampMoved(setting.end_s, lamp, (-dx, -dy))),
    )


def _lamp_name(setting: _TrialSetting, lamp: int) -> str:
    return setting.playpen.lamps[lamp].name or f"lamp{lamp}"


_Draw = Callable[[_TrialSetting], Trial | None]
_KHEPERA_FAULTS: dict[str, tuple[tuple[str, ...], _Draw]] = {
    "stuck sensor": (GENERAL_PLAYPENS, lambda setting: _draw_sensor_fault(setting, "stuck")),
    "dead sensor": (GENERAL_PLAYPENS, lambda setting: _draw_sensor_fault(setting, "dead")),
    "dead motor": (GENERAL_PLAYPENS, lambda setting: _draw_wheel_fault(setting, "dead", STANDING)),
    "blocked wheel": (GENERAL_PLAYPENS, lambda setting: _draw_wheel_fault(setting, "blocked", STANDING)),
    "weak motor": (
        GENERAL_PLAYPENS,
        lambda setting: _draw_wheel_fault(setting, "weak", "weak motor", (0.1, 0.15)),
    ),
    "slipping wheel": (
        GENERAL_PLAYPENS,
        lambda setting: _draw_wheel_fault(setting, "slip", "slipping wheel", (0.0, 0.03)),
    ),
    "object removed": (OBJECT_PLAYPENS, _draw_removed),
    "object moved": (OBJECT_PLAYPENS, _draw_moved),
    "object added": (GENERAL_PLAYPENS, _draw_added),
    "lamp off": (LAMP_PLAYPENS, _draw_lamp_off),
    "lamp moved": (LAMP_PLAYPENS, _draw_lamp_moved),
    "robot lifted": (
        GENERAL_PLAYPENS,
        lambda setting: Trial(("robot lifted",), "", (Lifted(setting.start_s),)),
    ),
    "brown-out": (GENERAL_PLAYPENS, lambda setting: Trial(("restart",), f"brown-out@{setting.start_s:g}")),
    "line losing bytes": (
        GENERAL_PLAYPENS,
        lambda setting: Trial(("line losing bytes",), f"drop:0.03{setting.suffix}"),
    ),
}
KHEPERA4_FAULTS = {
    f"Khepera IV, {name}": (KHEPERA4_PLAYPENS, draw)
    for name, (rooms, draw) in _KHEPERA_FAULTS.items()
    if rooms is not LAMP_PLAYPENS and name != "brown-out"
}
"""Faults of a Khepera IV; it has no banner, so that a restart is none of them."""

FAULTS: Mapping[str, tuple[tuple[str, ...], _Draw]] = {**_KHEPERA_FAULTS, **KHEPERA4_FAULTS}
"""Faults by name: their playpens, and a function that draws a trial, or None if a seed has none."""

_STREAM_NAMES = {"object removed": "thing gone", "object moved": "thing moved", "object added": "thing added"}
"""Stream names that differ from those of their faults; the tables of docs/twin.md depend on them."""


class RecordedTrial(NamedTuple):
    """A recorded trial whose fault is noticeable.

    Attributes:
        trial: Its fault.
        room: Name of its playpen.
        path: Path of the log.
        truth: Truth of the recording; the fault is its first hidden change.
        ended_ns: End of the fault [ns]; -1 if it does not end.
        over_ns: Arrival of the first reply that its end changes noticeably [ns]; -1 if none is.
    """

    trial: Trial
    room: str
    path: Path
    truth: Truth
    ended_ns: int
    over_ns: int


def record_trial(
    fault: str, seed: int, folder: Path, hosts: Sequence[str], times: str
) -> RecordedTrial | None:
    """Record a trial; return None if its fault is not noticeable.

    Args:
        fault: One of FAULTS.
        seed: Seed of the trial.
        folder: Folder of recordings.
        hosts: Hosts that alternate; without any, those of the seed.
        times: Times of the line.
    """
    rooms, draw = FAULTS[fault]
    room = rooms[seed % len(rooms)]
    rng = stream(seed, "fault trial", _STREAM_NAMES.get(fault, fault))
    start_s = round(float(rng.uniform(*ONSET_S)), 2)
    light, host = rooms is LAMP_PLAYPENS, alternate(hosts, seed // 3) if hosts else ""
    asks = {"asks_light": light, "asks_counters": rooms is KHEPERA4_PLAYPENS}
    healthy = Recording("sound" + "_light" * light, room, seed, ONSET_S[1] + DURATION_S, host, **asks)
    healthy_truth = Truth.load(healthy.path(folder).with_suffix(".npz"))
    trial = draw(_TrialSetting(Playpen.load(room), healthy_truth, start_s, start_s + DURATION_S, rng))
    if trial is None:
        return None
    faulty = Recording(
        fault.replace(", ", "_").replace(" ", "_"),
        room,
        seed,
        round(start_s + DURATION_S + TAIL_S),
        host,
        **asks,
        faults=[trial.fault] if trial.fault else [],
        changes=trial.changes,
        times=times,
    )
    path = faulty.path(folder)
    truth = Truth.load(path.with_suffix(".npz"))
    is_undone = len(trial.changes) > 1
    ended_ns = int(truth.changed_ns[1] if is_undone else truth.ended_ns[0])
    over_ns = int(truth.noticeable_ns[1] if is_undone else truth.over_ns[0])
    if truth.noticeable_ns[0] < truth.changed_ns[0] or (ended_ns >= 0 and truth.noticeable_ns[0] > ended_ns):
        return None
    return RecordedTrial(trial, room, path, truth, ended_ns, over_ns)


def _object_lists(playpen: Playpen) -> list[tuple[str, tuple[Block | Cylinder, ...]]]:
    return [("block", playpen.blocks), ("cylinder", playpen.cylinders)]


def _distance_mm(item: Block | Cylinder, x_mm: float, y_mm: float) -> float:
    """Return the distance of a position from an object [mm]."""
    dx, dy = x_mm - item.x_mm, y_mm - item.y_mm
    if isinstance(item, Cylinder):
        return math.hypot(dx, dy) - item.radius_mm
    angle = math.radians(item.angle_deg)
    along = abs(dx * math.cos(angle) + dy * math.sin(angle)) - item.length_mm / 2
    across = abs(dy * math.cos(angle) - dx * math.sin(angle)) - item.width_mm / 2
    return math.hypot(max(along, 0), max(across, 0))
