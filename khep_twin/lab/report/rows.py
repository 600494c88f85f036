"""Statistics of a report as text rows: name, and rounded value with unit."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin.lab.experiment import run_statistics as statistics
from khep_twin.lab.experiment.run_statistics import NEAR_COUNTS, Intervals
from khep_twin.lab.experiment.wire_statistics import wire
from khep_twin.log.channels import TextLine
from khep_twin.log.reader import TimeSeries
from khep_twin.robots.body import Body
from khep_twin.robots.framing import Framing
from khep_twin.robots.registry import default_model, installed_models

Row = tuple[str, str]
"""Name, and value with its unit."""


def definitions() -> tuple[Row, ...]:
    """Return the definitions of the rows."""
    models = [model for model in installed_models().values() if model.family != default_model().family]
    near_counts = "".join(f", of a {model.title} {model.body.near_counts}" for model in models)
    wheels = "".join(
        f", of a {model.title} {1000 * model.body.pulse_length:.4f} mm and "
        f"{1000 * model.body.wheel_base:g} mm"
        for model in models
    )
    return (
        (
            "Distance",
            "path length of the centre, measured in steps of 1 mm; its mean speed includes standing",
        ),
        ("Largest speed", "between two samples, 20 ms apart"),
        ("Turned", "sum of all turns to either side; net is their difference, positive counter-clockwise"),
        (
            "Near something",
            f"any of the sensors around reads a proximity above {NEAR_COUNTS} counts{near_counts}",
        ),
        (
            "Collisions",
            "the robot's round body is nearer than 1 mm to a wall or a fixed object, as the playpen has them;"
            " contacts less than 0.1 s apart are one. Turrets, other robots and movable objects are left out",
        ),
        ("Light gained", "depth of an ambient light reading below the dark level; lamps lower it"),
        (
            "By counters",
            "path and heading computed from the wheels' pulses, at 0.08 mm each and 52 mm between the wheels"
            f"{wheels}; slip, and wheels of another size, make them differ from the truth",
        ),
        ("Reply time", "from the last byte of a command to the last byte of its reply"),
        ("Unanswered", "commands without a reply of their letter, or a refusal, by the end of the log"),
    )


def motion_rows(pose: TimeSeries) -> Iterator[Row]:
    """Yield the rows on a robot's motion."""
    motion = statistics.motion(pose.times_ns / 1e9, pose.values.astype(np.float64))
    yield "Distance", _format_length(motion.distance)
    yield "Mean speed", f"{1000 * motion.mean_speed:.1f} mm/s"
    yield "Largest speed", f"{1000 * motion.top_speed:.0f} mm/s"
    left, right = (turn / (2 * math.pi) for turn in (motion.left_turn, motion.right_turn))
    net_deg = math.degrees(motion.left_turn - motion.right_turn)
    yield "Turned", f"{left:.2f} turns left, {right:.2f} turns right; net {_format_signed(net_deg, 0)}°"


def collision_rows(contacts: Intervals) -> Iterator[Row]:
    """Yield the row on a robot's collisions."""
    text = "none"
    if len(contacts.times_s):
        first_s = contacts.times_s[0, 0]
        text = f"{len(contacts.times_s)}, {contacts.total_s:.2f} s in touch; the first at {first_s:.1f} s"
    yield "Collisions", text


def near_rows(intervals: Intervals) -> Iterator[Row]:
    """Yield the row on the time in which a sensor detected something."""
    text = f"{intervals.total_s:.1f} s, {100 * intervals.share:.0f} % of the time"
    yield "Near something", f"{text}; longest {intervals.longest_s:.1f} s"


def slip_rows(pose: TimeSeries, pulses: NDArray[np.int64], body: Body) -> Iterator[Row]:
    """Yield the rows on the difference between odometry, by pulses (n, 2), and ground truth."""
    times_s, truth = pose.times_ns / 1e9, pose.values.astype(np.float64)
    slip = statistics.slip(times_s, truth, pulses, body)
    true_length = statistics.path_length(truth[:, :2])
    difference = f", {_format_signed(100 * (slip.distance / true_length - 1), 1)} %" if true_length else ""
    yield "Distance by counters", f"{_format_length(slip.distance)}{difference}"
    heading = _format_signed(math.degrees(slip.heading), 1)
    yield "Heading by counters", f"at most {heading}° off, at {slip.heading_s:.1f} s"
    yield "End by counters", f"{1000 * slip.end:.0f} mm off"


def light_rows(ambient: TimeSeries, dark: float, names: Sequence[str], n_around: int) -> Iterator[Row]:
    """Yield the rows on the light received from lamps, below a dark level [counts]."""
    dark_levels = np.full(n_around, float(dark))
    counts = ambient.values[:, :n_around].astype(np.int64)
    light = statistics.light(ambient.times_ns / 1e9, counts, dark_levels)
    yield "Light gained", f"{light.mean:.1f} counts in the mean of all sensors"
    sensor = names[light.sensor]
    yield "Brightest moment", f"{light.brightest:.0f} counts, sensor {sensor}, at {light.time_s:.1f} s"


def wire_rows(lines: Sequence[TextLine], duration_s: float, framing: Framing) -> Iterator[Row]:
    """Yield the rows on the serial line."""
    stats = wire(lines, framing)
    if not stats.count:
        yield "Commands", "none"
        return
    rate = f", {stats.count / duration_s:.1f} per second" if duration_s else ""
    letters = list(stats.commands.items())
    counts = ", ".join(f"{letter} {count}" for letter, count in letters[:12])
    yield "Commands", f"{stats.count}{rate}: {counts}{', …' if len(letters) > 12 else ''}"
    if stats.replies:
        yield "Reply time", f"{1e3 * stats.mean_s:.1f} ms in the mean, {1e3 * stats.longest_s:.1f} ms at most"
    yield "Unanswered", f"{stats.unanswered}; refused {stats.refused}"


def _format_length(length: float) -> str:
    return f"{length:.2f} m" if length >= 1 else f"{1000 * length:.0f} mm"


def _format_signed(value: float, digits: int) -> str:
    text = f"{value:+.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) else text[1:]
