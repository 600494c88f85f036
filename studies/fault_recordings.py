"""Recordings of stand-in robots with one fault each, which begins at a random time and ends where it can."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from khep_twin.clock import NS_PER_S
from khep_twin.playpen import Block, Cylinder, Playpen
from khep_twin.randomness import stream
from khep_twin.units import N_SENSORS
from stand_ins.hidden_changes import Added, Change, Gone, LampMoved, LampOff, Lifted, Moved
from stand_ins.recordings import Truth
from studies.twin_runs import Recording, alternating

SIDES = ("left", "right")

OPEN, FURNISHED, LIT = (
    ("workshop", "obstacles", "looping-maze"),
    ("workshop", "obstacles"),
    ("workshop", "light-seeking", "two-lamps"),
)
"""Playpens of all faults, of those of things, and of those of lamps."""

BEGINS_S = 12.0, 22.0
"""Times at which faults begin [s]."""

LASTS_S, AFTER_S = 25.0, 13.0
"""How long they last, and how long the recording goes on [s]."""

_MET_MM = 45.0
"""Distance from the robot's centre at which a thing is met: 17 mm from its edge."""

_FAR_MM = 5000.0
"""Where `hidden_changes` has what is gone."""

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
class _Scene:
    """What a trial is drawn for: the playpen, the way of the healthy robot, the fault's begin and end [s]."""

    playpen: Playpen
    way: Truth
    at_s: float
    until_s: float
    rng: np.random.Generator

    @property
    def suffix(self) -> str:
        return f"@{self.at_s:g}-{self.until_s:g}"

    def at(self, time_s: float) -> tuple[float, float]:
        """Return the healthy robot's position at a time [mm]."""
        x, y, _ = self.way.poses[int(np.searchsorted(self.way.times_ns, time_s * NS_PER_S))].tolist()
        return x * 1e3, y * 1e3


def _sensor(scene: _Scene, kind: str) -> Trial:
    sensor = int(scene.rng.integers(N_SENSORS - 2))
    names = (f"{kind} sensor {sensor}",)
    if kind == "stuck":
        names += (f"dead sensor {sensor}",)  # Right while it reads 0, see `_right`.
    return Trial(names, f"{kind}:{sensor}{scene.suffix}")


def _wheel(scene: _Scene, kind: str, name: str, parts: tuple[float, float] | None = None) -> Trial:
    side = SIDES[int(scene.rng.integers(2))]
    part = "" if parts is None else f":{scene.rng.uniform(*parts):.3f}"
    return Trial((f"{name} {side}",), f"{kind}:{side}{part}{scene.suffix}")


def _thing(scene: _Scene) -> tuple[str, Block | Cylinder] | None:
    """Return the thing that the robot meets first while the fault lasts; None if it meets none."""
    times = np.arange(scene.at_s + 1, scene.until_s - 5, 0.1)
    found = {f"{kind}{i}": each for kind, items in _things(scene.playpen) for i, each in enumerate(items)}
    for time_s in times.tolist():
        for name, item in found.items():
            if _away(item, *scene.at(time_s)) < _MET_MM:
                return name, item
    return None


def _gone(scene: _Scene) -> Trial | None:
    if (met := _thing(scene)) is None:
        return None
    name, item = met
    back = Moved(scene.until_s, name, (_FAR_MM + item.x_mm, _FAR_MM + item.y_mm))
    return Trial((f"missing {name}",), "", (Gone(scene.at_s, name), back))


def _moved(scene: _Scene) -> Trial | None:
    if (met := _thing(scene)) is None:
        return None
    name, _ = met
    by, way = scene.rng.uniform(25, 40), scene.rng.uniform(0, math.tau)
    dx, dy = round(by * math.cos(way), 1), round(by * math.sin(way), 1)
    return Trial(
        (f"moved {name}",), "", (Moved(scene.at_s, name, (dx, dy)), Moved(scene.until_s, name, (-dx, -dy)))
    )


def _added(scene: _Scene) -> Trial | None:
    radius = round(scene.rng.uniform(8, 20), 1)
    for time_s in np.arange(scene.at_s + 3, scene.until_s - 8, 0.5).tolist():
        x, y = scene.at(time_s)
        if math.dist((x, y), scene.at(scene.at_s)) > 60 + radius:
            can = Cylinder(x_mm=round(x, 1), y_mm=round(y, 1), radius_mm=radius, height_mm=50)
            return Trial(("unexpected thing",), "", (Added(scene.at_s, can),))
    return None


def _lamp_off(scene: _Scene) -> Trial:
    lamp = int(scene.rng.integers(len(scene.playpen.lamps)))
    return Trial((f"{_lamp_name(scene, lamp)} off",), "", (LampOff(scene.at_s, lamp),))


def _lamp_moved(scene: _Scene) -> Trial:
    lamp = int(scene.rng.integers(len(scene.playpen.lamps)))
    bulb, arena = scene.playpen.lamps[lamp], scene.playpen.arena
    inwards = math.atan2(arena.height_mm / 2 - bulb.y_mm, arena.width_mm / 2 - bulb.x_mm)
    dx = dy = math.inf
    while not (0 <= bulb.x_mm + dx <= arena.width_mm and 0 <= bulb.y_mm + dy <= arena.height_mm):
        by, way = scene.rng.uniform(80, 150), inwards + scene.rng.uniform(-0.8, 0.8)
        dx, dy = round(by * math.cos(way), 1), round(by * math.sin(way), 1)
    return Trial(
        (f"{_lamp_name(scene, lamp)} moved",),
        "",
        (LampMoved(scene.at_s, lamp, (dx, dy)), LampMoved(scene.until_s, lamp, (-dx, -dy))),
    )


def _lamp_name(scene: _Scene, lamp: int) -> str:
    return scene.playpen.lamps[lamp].name or f"lamp{lamp}"


FAULTS: Mapping[str, tuple[tuple[str, ...], Callable[[_Scene], Trial | None]]] = {
    "stuck sensor": (OPEN, lambda scene: _sensor(scene, "stuck")),
    "dead sensor": (OPEN, lambda scene: _sensor(scene, "dead")),
    "dead motor": (OPEN, lambda scene: _wheel(scene, "dead", STANDING)),
    "blocked wheel": (OPEN, lambda scene: _wheel(scene, "blocked", STANDING)),
    "weak motor": (OPEN, lambda scene: _wheel(scene, "weak", "weak motor", (0.1, 0.15))),
    "slipping wheel": (OPEN, lambda scene: _wheel(scene, "slip", "slipping wheel", (0.0, 0.03))),
    "thing gone": (FURNISHED, _gone),
    "thing moved": (FURNISHED, _moved),
    "thing added": (OPEN, _added),
    "lamp off": (LIT, _lamp_off),
    "lamp moved": (LIT, _lamp_moved),
    "robot lifted": (OPEN, lambda scene: Trial(("robot lifted",), "", (Lifted(scene.at_s),))),
    "brown-out": (OPEN, lambda scene: Trial(("restart",), f"brown-out@{scene.at_s:g}")),
    "line losing bytes": (OPEN, lambda scene: Trial(("line losing bytes",), f"drop:0.03{scene.suffix}")),
}
"""Faults by name: their playpens, and what draws a trial; None where there is none for its seed."""


class Made(NamedTuple):
    """A recorded trial whose fault is noticeable.

    Attributes:
        trial: Its fault.
        room: Name of its playpen.
        path: Path of the log.
        truth: Truth of the recording, whose first hidden thing is the fault.
        ended_ns: End of the fault [ns]; -1 if it does not end.
        over_ns: Arrival of the first reply that its end changes noticeably [ns]; -1 if none is.
    """

    trial: Trial
    room: str
    path: Path
    truth: Truth
    ended_ns: int
    over_ns: int


def made(fault: str, seed: int, folder: Path, hosts: Sequence[str], times: str) -> Made | None:
    """Make the recording of a trial; return None if its fault is not noticeable.

    Args:
        fault: One of FAULTS.
        seed: Seed of the trial.
        folder: Folder of recordings.
        hosts: Hosts that alternate; without any, those of the seed.
        times: Times of the line.
    """
    rooms, draw = FAULTS[fault]
    room = rooms[seed % len(rooms)]
    rng = stream(seed, "fault trial", fault)
    at_s = round(float(rng.uniform(*BEGINS_S)), 2)
    light, host = rooms is LIT, alternating(hosts, seed // 3) if hosts else ""
    sound = Recording("sound" + "_light" * light, room, seed, BEGINS_S[1] + LASTS_S, host, asks_light=light)
    way = Truth.load(sound.path(folder).with_suffix(".npz"))
    trial = draw(_Scene(Playpen.load(room), way, at_s, at_s + LASTS_S, rng))
    if trial is None:
        return None
    faulty = Recording(
        fault.replace(" ", "_"),
        room,
        seed,
        round(at_s + LASTS_S + AFTER_S),
        host,
        asks_light=light,
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
    return Made(trial, room, path, truth, ended_ns, over_ns)


def _things(playpen: Playpen) -> list[tuple[str, tuple[Block | Cylinder, ...]]]:
    return [("block", playpen.blocks), ("cylinder", playpen.cylinders)]


def _away(item: Block | Cylinder, x_mm: float, y_mm: float) -> float:
    """Return the distance of a position from a thing [mm]."""
    dx, dy = x_mm - item.x_mm, y_mm - item.y_mm
    if isinstance(item, Cylinder):
        return math.hypot(dx, dy) - item.radius_mm
    angle = math.radians(item.angle_deg)
    along = abs(dx * math.cos(angle) + dy * math.sin(angle)) - item.length_mm / 2
    across = abs(dy * math.cos(angle) - dx * math.sin(angle)) - item.width_mm / 2
    return math.hypot(max(along, 0), max(across, 0))
