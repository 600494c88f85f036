"""Braitenberg vehicle of letter A (library); the firmware's has the gain of its configuration (assumed)."""

from dataclasses import replace

from khep_twin.robots.vehicle import Vehicle

VEHICLE = Vehicle(
    left=(2, 2, 2, 5, -12, -4, -2, 2, 4),
    right=(2, -2, -4, -12, 5, 2, 2, 2, 4),
    threshold=100,
    saturation=1000,
    divisor=30 * 12,
    forward=20,
    min_speed=10,
    turn=50,
    moved_pulses=700,
    front=slice(3, 5),
    unit=256,
    gain=12,  # at power-up (manual)
    waits=True,
)
SERVER_VEHICLE = replace(VEHICLE, left=(0, *VEHICLE.left), right=(0, *VEHICLE.right), is_unsigned=True)
"""That of kh3server, which passes the readings 1 to 9: the last is that of the right ground sensor."""
