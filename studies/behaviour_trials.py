"""Trials of `studies.behaviour`: controllers, start poses and compared measures."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.units import BODY_RADIUS
from studies.behaviour_controllers import (
    avoider,
    light_follower,
    light_stop,
    networks,
    proportional_stop,
    threshold_stop,
    wall_follower,
)
from studies.one_object import CYLINDER, LAMP, PERIOD_S, WALL, Controller, Floats, Target, Track

Deviation = Callable[[Track, Track], Floats]
"""Function of two tracks that returns a number for each robot (n,); NaN for one that does not count."""

ARRIVED = 0.02
"""Distance from the robot's edge to the bulb's glass at which it has arrived at a lamp [m]."""

NEAREST = 0.005
"""Distance of the nearest samples of wall and cylinder [m]."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A controller, its start poses and the compared measures.

    Attributes:
        target: Object.
        controller: Controller.
        starts: Start poses (n, 3) [m, rad].
        seconds: Duration [s].
        measures: Deviations by name; the name ends with its unit in brackets.
    """

    target: Target
    controller: Controller
    starts: Floats
    seconds: float
    measures: Mapping[str, Deviation]


def stopping_difference(track: Track, other: Track) -> Floats:
    """Return the difference of the distances at which robots stop, means of the last half second [mm]."""
    last = round(0.5 / PERIOD_S)
    return (track.gaps[-last:].mean(axis=0) - other.gaps[-last:].mean(axis=0)) * 1e3


def turning_difference(track: Track, other: Track) -> Floats:
    """Return the difference of the robots' turns from start to end, positive to the left [deg]."""
    return np.degrees(track.poses[-1, :, 2] - other.poses[-1, :, 2])


def path_distance(track: Track, other: Track) -> Floats:
    """Return the distance between two paths at the same time, root mean square [mm].

    The comparison stops where one robot is nearer than any sample (`NEAREST`), as the tables end there.
    """
    squares = ((track.poses[..., :2] - other.poses[..., :2]) ** 2).sum(axis=-1)
    is_valid = np.logical_and.accumulate((track.gaps >= NEAREST) & (other.gaps >= NEAREST))
    return np.sqrt((squares * is_valid).sum(axis=0) / is_valid.sum(axis=0)) * 1e3


def following_difference(track: Track, other: Track) -> Floats:
    """Return the difference of the mean distances from the object in the second half [mm]."""
    half = len(track.gaps) // 2
    return (track.gaps[half:].mean(axis=0) - other.gaps[half:].mean(axis=0)) * 1e3


def arrival_difference(track: Track, other: Track) -> Floats:
    """Return the difference of the arrival times [s]; a missing arrival counts as one at the end."""
    times = [
        np.where(near.any(axis=0), near.argmax(axis=0), len(near)) * PERIOD_S
        for near in (track.gaps < ARRIVED, other.gaps < ARRIVED)
    ]
    return times[0] - times[1]


def trials() -> list[Trial]:
    """Return all trials."""
    all_trials: list[Trial] = []
    stop: dict[str, Deviation] = {"stopping distance [mm]": stopping_difference}
    path: dict[str, Deviation] = {"path [mm]": path_distance}
    for target in (WALL, CYLINDER):
        forward_starts = heading_for(
            target, 60, np.arange(-60, 61, 10) if target is WALL else np.arange(-12, 13, 2)
        )
        backward_starts = heading_for(
            target, 60, np.arange(140, 221, 10) if target is WALL else np.arange(172, 189, 2)
        )
        all_trials += [
            Trial(target, threshold_stop(level), forward_starts, 5.0, stop) for level in (300, 900)
        ]
        all_trials.append(Trial(target, threshold_stop(600, -1), backward_starts, 4.0, stop))
        all_trials.append(Trial(target, proportional_stop(), forward_starts, 6.0, stop))
        offsets = np.arange(-60, 61, 5) if target is WALL else np.arange(-30, 31, 2.5)
        avoider_starts = heading_for(target, 60, offsets)
        all_trials.append(
            Trial(target, avoider(), avoider_starts, 3.0, {"turn [deg]": turning_difference, **path})
        )
        for side, sign in (("right", 1), ("left", -1)):
            follower_starts = np.concatenate(
                [heading_for(target, gap, sign * np.arange(75, 106, 10)) for gap in (8, 15, 22)]
            )
            measures: dict[str, Deviation] = {"following distance [mm]": following_difference, **path}
            all_trials.append(Trial(target, wall_follower(side), follower_starts, 6.0, measures))
        network_starts = np.concatenate([heading_for(target, gap, np.arange(0, 360, 45)) for gap in (12, 24)])
        all_trials += [Trial(target, controller, network_starts, 4.0, path) for controller in networks(4)]
    lamp_starts = np.concatenate([heading_for(LAMP, gap, np.arange(-120, 121, 30)) for gap in (150, 300)])
    all_trials.append(Trial(LAMP, light_stop(), lamp_starts, 9.0, stop))
    all_trials.append(Trial(LAMP, light_follower(), lamp_starts, 1.5, {"turn [deg]": turning_difference}))
    arrival: dict[str, Deviation] = {"arrival [s]": arrival_difference, **path}
    all_trials.append(Trial(LAMP, light_follower(), lamp_starts, 9.0, arrival))
    network_starts = np.concatenate([heading_for(LAMP, gap, np.arange(0, 360, 45)) for gap in (120, 240)])
    return [*all_trials, *(Trial(LAMP, controller, network_starts, 4.0, path) for controller in networks(4))]


def heading_for(target: Target, gap_mm: float, offsets_deg: NDArray[Any]) -> Floats:
    """Return poses before an object, with headings at these angles to its left (n, 3)."""
    distance = gap_mm / 1e3 + BODY_RADIUS + target.radius
    offsets = np.radians(np.asarray(offsets_deg, np.float64))
    return np.column_stack([np.full(len(offsets), -distance), np.zeros(len(offsets)), offsets])
