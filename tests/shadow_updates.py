"""Updates of a shadow, made by hand: a robot that drives ahead, with an alarm from 1 s to 2 s."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from khep_twin.log.shadow_channels import Alarm, PoseState, Suspicion
from khep_twin.playpen import Playpen
from khep_twin.shadow.pose_estimate import Floats, PoseEstimate
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import ShadowLog
from khep_twin.shadow.update import Residuals, Update

MS = 1_000_000
ALARM = Alarm("stuck sensor 2", "proximity", 800 * MS, 1000 * MS, 0.975)
SUSPICION = Suspicion(("stuck sensor 2", "dead sensor 2"), "proximity", 800 * MS, 0.6)


def updates(n_sensors: int = 8) -> Iterator[Update]:
    """Yield an update every 50 ms for 3 s, of a robot with this number of sensors around."""
    nothing: Floats = np.full(n_sensors, np.nan)
    expected: Floats = np.arange(0.0, 100.0 * n_sensors, 100.0)
    measured: Floats = np.arange(0.0, 101.0 * n_sensors, 101.0)
    for time_ns in range(0, 3001 * MS, 50 * MS):
        x = 0.2 + 0.02 * time_ns * 1e-9
        covariance = np.array([[4e-6, 1e-6, 0], [1e-6, 9e-6, 0], [0, 0, 1e-3]])
        particles = np.tile((x, 0.15, math.pi / 2), (250, 1)) + np.linspace(-0.01, 0.01, 250)[:, None]
        has_light = time_ns % (100 * MS) == 0
        proximity = np.arange(float(n_sensors)) if has_light else nothing
        yield Update(
            time_ns,
            PoseEstimate(time_ns, (x, 0.15, 0.25), covariance),
            (x + 0.01, 0.16, 0.5),
            particles,
            expected,
            nothing if time_ns == 0 else measured,
            Residuals(proximity, nothing, np.array([1.0, -2.0]), 0.001 if has_light else math.nan),
            PoseState.FOLLOWED if time_ns < 2000 * MS else PoseState.UNSURE,
            (SUSPICION,) if 800 * MS <= time_ns < 1000 * MS else (),
            (ALARM,) if 1000 * MS <= time_ns < 2000 * MS else (),
            (ALARM,) if time_ns == 2000 * MS else (),
        )


def written(path: Path, parent: Path | None = None, playpen: Playpen | None = None) -> Path:
    """Write a log of these updates in a playpen, by default `obstacles`; return its path."""
    playpen = playpen or Playpen.load("obstacles")
    log = ShadowLog(path, playpen, ShadowSettings(seed=7), parent=parent)
    for update in updates(len(playpen.robots[0].body.sensor_positions)):
        log.write(update)
    log.close()
    return path
