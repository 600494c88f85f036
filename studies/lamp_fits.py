"""Fit of the model of lamps to a sampled robot's readings, and its residuals.

The tables come from the folder that KHEP_TWIN_REFERENCE_DATA names, as in `infrared_fits`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.lab.fit.lamp_fit import LampPositions, ambient_counts, fit_lamps
from khep_twin.lab.fit.placement import Placement, Readings, Ruler
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import AmbientCalibration
from khep_twin.units import BULB_RADIUS, N_SENSORS
from studies.infrared_fits import reference
from tools.command_table import command_line

Floats = NDArray[np.float64]

SET_UP_BEARING = np.radians(-4.4)
"""Correction of the sampled set-up's bearings of the lamp [rad]: it makes left and right sensors equal."""

FILAMENT_HEIGHT = 0.0016
"""Height of the sampled lamp above the sensors [m]: that of a playpen's lamp. It was not recorded; 47 mm
would leave smaller residuals near by (see main)."""

POWER = 2.0
"""Power of the sampled lamp [W]."""

FAR = 0.113
"""Smallest distance of the model [m]: nearer, the lamp saturates the sensors and the lobe is wrong."""

_THINNED = 4
"""Stride of the nearer readings used, so that they do not spoil the fit of the others."""

SAMPLED_LIMIT, COUNTS_AT_0 = 1023, 500
"""The samples have 1023 where the robot read 0, and 0 where it read 500."""


def sampled_lamp(folder: Path, height: float = FILAMENT_HEIGHT) -> tuple[Floats, Readings]:
    """Return the distances from the robot's edge to the bulb's glass (n,) [m], and the readings there."""
    rows = np.genfromtxt(folder / "data" / "evorobot_light_samples.csv", delimiter=",", skip_header=1)
    distances, counts = rows[:, 0] / 1e3, COUNTS_AT_0 * (1 - rows[:, 2:] / SAMPLED_LIMIT)
    return distances, readings(distances, SET_UP_BEARING - np.radians(rows[:, 1]), counts, POWER, height)


def readings(
    distances: Floats, bearings: Floats, counts: Floats, power: float, height: float = FILAMENT_HEIGHT
) -> Readings:
    """Return readings of a lamp at bearings, counter-clockwise [rad], from a robot that turns on the spot."""
    poses = np.column_stack([np.zeros((len(bearings), 2)), -bearings])
    return Readings("lamp", Placement(poses, distances, BULB_RADIUS), counts, power, height)


def residuals(test: Readings, ambient: AmbientCalibration) -> Floats:
    """Return model less robot (n, 8), on the samples' scale of 1023."""
    lamp = LampPositions.of(test)
    modelled = np.column_stack([ambient_counts(lamp, sensor, ambient) for sensor in range(N_SENSORS)])
    return (test.counts - modelled) / COUNTS_AT_0 * SAMPLED_LIMIT


def main() -> None:
    """Fit with several heights of the filament, and print the values of the calibration."""
    command_line(__doc__).parse_args()
    start = calibration.read("khepera1")[0]
    for height in (FILAMENT_HEIGHT, 0.03, 0.0468, 0.06):
        distances, test = sampled_lamp(reference(), height)
        far = distances >= FAR
        used = far | (np.arange(len(distances)) % _THINNED == 0)
        place = Placement(test.placement.poses[used], distances[used], BULB_RADIUS)
        thinned = replace(test, placement=place, counts=test.counts[used])
        # The set-up's bearings are corrected already.
        ambient = fit_lamps([thinned], start, Ruler(0, 0, 0)).calibration.ambient
        errors = residuals(test, ambient)
        parts = (np.sqrt(np.mean(errors[part] ** 2)) for part in (far, ~far))
        print("filament {:.1f} mm up: rms {:.1f} from 113 mm, {:.1f} nearer".format(height * 1e3, *parts))
        if height == FILAMENT_HEIGHT:
            print(ambient)
