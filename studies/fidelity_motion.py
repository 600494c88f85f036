"""Comparisons of odometry, motors and supply."""

import math
from pathlib import Path

import numpy as np

from khep_twin.board.battery import cell_voltage
from khep_twin.board.kernel import Board
from khep_twin.episodes.controllers import ConstantSpeed
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen
from studies.behaviour import motor_table
from studies.fidelity_comparison import Comparison, Outcome, columns
from studies.home_test import HOME_MM, ROBOTS, misses
from studies.infrared_fits import rms

_TABLE = "motor table of evorobot's simulator, whose scatter is not stated"
_MANUAL = "Khepera manual 5.02"
_COURSES = "reports of students' courses, Khepera II, Edinburgh"


def constant_speed_motion(left: int, right: int) -> tuple[float, float]:
    """Return way [m/s] and turn [rad/s] of the twin at constant speeds, once it has reached them."""
    episode = Episode(EpisodeSetup(Playpen.load("default")), ConstantSpeed(left, right))
    episode.begin(options=EpisodeOptions(noise=False, start=(100.0, 150.0, 0.0)))
    episode.run(0.5)
    first_pose = episode.pose
    episode.run(0.5)
    last_pose = episode.pose
    turned = math.remainder(last_pose[2] - first_pose[2], 2 * math.pi)
    return math.dist(first_pose[:2], last_pose[:2]) / 0.5, turned / 0.5


def way(folder: Path) -> Outcome:
    """Compare the way at equal speeds."""
    twin_speed, table = constant_speed_motion(5, 5)[0], 5 * motor_table(folder).speed
    # Webots' wheels have a radius of 7.5 mm, 600 pulses to a turn; Michel's step is 8 mm/s per unit.
    webots, michel = 5 * 2 * math.pi * 7.5e-3 / 600 * 100, 5 * 8e-3
    peers = {"Webots": _percent_error(webots, table), "Michel's simulator": _percent_error(michel, table)}
    note = "the manual has 0.08 mm per pulse, and 12 pulses per mm"
    return Outcome(_percent_error(twin_speed, table), None, peers, note)


def turn(folder: Path) -> Outcome:
    """Compare the turn at opposite speeds."""
    motion = motor_table(folder)
    twin_turn, table = constant_speed_motion(-3, 3)[1], 6 * motion.speed / motion.base
    webots, michel = 6 * 2 * math.pi * 7.5e-3 / 600 * 100 / 0.052, 6 * 8e-3 / 0.050
    peers = {"Webots": _percent_error(webots, table), "Michel's simulator": _percent_error(michel, table)}
    return Outcome(_percent_error(twin_turn, table), None, peers)


def home(folder: Path) -> Outcome:
    """Compare the part of varied robots that miss home by at most 100 mm."""
    missed = misses(ROBOTS, ROBOTS)
    share, published = float((missed <= HOME_MM).mean()), 20 / 25
    note = f"{share:.0%} for {published:.0%} of 25 runs; median {np.median(missed):.0f} mm for 50 to 100 mm"
    # Standard deviation of a part of 25 runs.
    return Outcome(abs(share - published) * 100, math.sqrt(published * (1 - published) / 25) * 100, note=note)


def current(folder: Path) -> Outcome:
    """Compare the mean current while driving with the cells' capacity over the autonomy."""
    episode = Episode(EpisodeSetup(Playpen.load("default")), ConstantSpeed(10, 10))
    episode.begin(options=EpisodeOptions(noise=False, start=(100.0, 150.0, 0.0)))
    readings: list[int] = []
    for _ in range(100):
        episode.run(0.02)
        readings.append(int(episode.registers[Board.CURRENT]))
    return Outcome(abs(float(np.mean(readings[50:])) - 240), note="180 mAh in 45 minutes; speed 10")


def battery(folder: Path) -> Outcome:
    """Compare the cells' voltage over their use."""
    table = columns(folder / "manual_data" / "k1_fig14_battery_discharge.csv")
    errors = np.array([cell_voltage(minutes) for minutes in table["time_min"]]) - table["battery_V"]
    # The figure's voltages have steps of 18 mV.
    return Outcome(rms([errors]), 0.018 / math.sqrt(12))


def _percent_error(value: float, reference: float) -> float:
    return abs(value / reference - 1) * 100


COMPARISONS = (
    Comparison("way at a speed", _TABLE, "predicted: the manual's 0.08 mm per pulse", "%", way),
    Comparison("turn at a speed", _TABLE, "predicted: wheel base of 52 mm", "%", turn),
    Comparison("robots at home after 30 s", _COURSES, "fitted: wheels' inequality", "% of robots", home),
)
"""Comparisons of odometry, in the page's order."""

SUPPLY = (
    Comparison("cells' voltage over 45 minutes (figure 14)", _MANUAL, "fitted: ten points", "V", battery),
    Comparison("current while driving", _MANUAL, "fitted: current at rest", "mA", current),
)
"""Comparisons of the supply, in the page's order."""
