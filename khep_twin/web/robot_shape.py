"""Shape of a robot as the page draws it."""

import math
from dataclasses import asdict

from khep_twin.khepera4.ultrasonic import HEADINGS_DEG, RADIUS
from khep_twin.sensing import calibration
from khep_twin.sensing.bars import bars_of
from khep_twin.units import BODIES
from khep_twin.web.messages import RobotShape


def robot_shape(model: str, calibration_name: str) -> RobotShape:
    """Return a robot's shape for drawing: [mm] and [deg]."""
    body = BODIES[model]
    poses = zip(body.sensor_positions, calibration.read(calibration_name)[0].heading_deg, strict=True)
    sonar_deg = () if body.in_core else HEADINGS_DEG
    rim_mm = 1e3 * RADIUS
    sonar = ((math.cos(math.radians(angle)), math.sin(math.radians(angle)), angle) for angle in sonar_deg)
    wheels = (body.wheel_base, body.wheel_radius, body.wheel_width)
    return {
        "radius_mm": body.radius * 1e3,
        "sensors": [[round(x * 1e3, 2), round(y * 1e3, 2), heading] for (x, y), heading in poses],
        "names": body.sensors,
        "n_ground": len(body.ground_positions),
        "wheels_mm": [round(1e3 * length, 3) for length in wheels],
        "sonar": [[round(rim_mm * x, 2), round(rim_mm * y, 2), angle] for x, y, angle in sonar],
        "bars": {name: asdict(bar) for name, bar in bars_of(body).items()},
    }
