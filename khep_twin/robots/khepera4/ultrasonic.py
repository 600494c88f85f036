"""Ultrasonic sensors of the Khepera IV, by the law of `sensing.sonar`.

Walls turned by 55 degrees or more are missed beyond some 0.4 m.
"""

from khep_twin.robots.khepera4.channels import ULTRASONIC_CODES
from khep_twin.robots.khepera4.model import SONAR
from khep_twin.sensing.sonar import Sonar

PERIOD_NS = 20_000_000
"""Time from one burst to the next [ns]: enabled sensors alternate (manual)."""

_, NO_ECHO, DISABLED = ULTRASONIC_CODES


def make_sonar() -> Sonar:
    """Return the sensors; noise assumed; the manual states an error of 2 cm."""
    return Sonar.of(SONAR, SONAR.reach, SONAR.nearest, SONAR.exponent, noise_cm=0.4)
