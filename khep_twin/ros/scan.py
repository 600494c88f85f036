"""Scan of a robot's sensors of distances as that of a laser, for programs that know no other sensors."""

import math

import numpy as np

from khep_twin.log.cdr import Frame
from khep_twin.ros.distances import Beam, Floats

SCAN = "sensor_msgs/msg/LaserScan"

N_BEAMS = 72
"""Beams of a scan, one in 5 degrees."""


def scan_frame(frame_id: str, beams: list[Beam]) -> Frame:
    """Return the frame of scans around the origin of a coordinate frame."""
    level = [beam for beam in beams if not math.isnan(beam.heading)]
    radii = [math.hypot(*beam.position[:2]) for beam in level]
    message = {
        "header": {"frame_id": frame_id},
        "angle_min": -math.pi,
        "angle_max": math.pi - math.tau / N_BEAMS,
        "angle_increment": math.tau / N_BEAMS,
        "range_min": min(map(float.__add__, radii, (beam.nearest for beam in level)), default=0.0),
        "range_max": max(map(float.__add__, radii, (beam.reach for beam in level)), default=0.0),
        "ranges": np.zeros(N_BEAMS),
    }
    return Frame(SCAN, message, ["header.stamp", "ranges"])


def scan_ranges(beams: list[Beam], distances: Floats) -> Floats:
    """Return the ranges of a scan (n, N_BEAMS) [m] from those of beams (n, n_beams)."""
    rows = np.arange(len(distances))
    ranges = np.full((len(distances), N_BEAMS), np.inf)
    too_near = np.zeros(ranges.shape, bool)
    for beam, column in zip(beams, distances.T, strict=False):
        if math.isnan(beam.heading):
            continue
        is_measured = np.isfinite(column)
        length = np.where(is_measured, column, beam.nearest)
        x = beam.position[0] + length * math.cos(beam.heading)
        y = beam.position[1] + length * math.sin(beam.heading)
        bins = np.rint(np.arctan2(y, x) * (N_BEAMS / math.tau)).astype(int) + N_BEAMS // 2
        bins %= N_BEAMS
        radii = np.where(is_measured, np.hypot(x, y), np.inf)
        ranges[rows, bins] = np.minimum(ranges[rows, bins], radii)
        too_near[rows, bins] |= column == -np.inf
    # A measured distance is more than that another sensor is too near to measure.
    ranges[too_near & np.isinf(ranges)] = -np.inf
    return ranges
