"""Ultrasonic sensors of the Khepera IV, by the law of `sensing.sonar`.

The amplitude is 0.5 at 42.5 degrees off the axis (typical, assumed), so the beam's exponent is 2.27. Walls
turned by 55 degrees or more are missed beyond some 0.4 m.
"""

from khep_twin.robots.khepera4.channels import ULTRASONIC_CODES
from khep_twin.robots.khepera4.model import SONAR
from khep_twin.sensing.sonar import Sonar

PERIOD_NS = 20_000_000
"""Time from one burst to the next [ns]: enabled sensors alternate (manual)."""

_, NO_ECHO, DISABLED = ULTRASONIC_CODES


def make_sonar() -> Sonar:
    """Return the sensors: 0.25 to 2.5 m (manual), noise assumed; the manual states an error of 2 cm."""
    return Sonar.of(SONAR, reach=2.5, nearest=0.25, exponent=2.27, noise_cm=0.4)
