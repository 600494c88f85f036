"""Shape of a robot as the page draws it."""

import math
from collections.abc import Sequence
from dataclasses import asdict

from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.robots.model import RobotModel
from khep_twin.sensing import calibration
from khep_twin.web.messages import RobotShape


def robot_shape(
    model: RobotModel, calibration_name: str, heading_deg: Sequence[float] | None = None
) -> RobotShape:
    """Return a robot's shape for drawing: [mm] and [deg]; by default with the headings of its calibration."""
    body = model.body
    headings = calibration.read(calibration_name)[0].heading_deg if heading_deg is None else heading_deg
    poses = zip(body.sensor_positions, headings, strict=True)
    sonar = body.sonar.places if body.sonar else []
    wheels = (body.wheel_base, body.wheel_radius, body.wheel_width)
    return {
        "model": model.name,
        "title": model.title,
        "programs": list(BUILT_IN) if model.vehicle else [],  # they are vehicles
        "speed_unit": model.channels["speed"][0][1],
        "radius_mm": body.radius * 1e3,
        "sensors": [[round(x * 1e3, 2), round(y * 1e3, 2), heading] for (x, y), heading in poses],
        "names": body.sensors,
        "n_ground": len(body.ground_positions),
        "wheels_mm": [round(1e3 * length, 3) for length in wheels],
        "sonar": [[*(round(1e3 * x, 2) for x in place), math.degrees(angle)] for *place, angle in sonar],
        "sonar_unit_mm": 1e3 * model.sonar_unit,
        "sonar_codes": body.sonar.codes if body.sonar else (),
        "bars": {name: asdict(bar) for name, bar in model.bars.items()},
    }
