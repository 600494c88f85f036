"""Braitenberg vehicle of kh4server (library); speeds in pulses/10 ms."""

from khep_twin.robots.vehicle import Vehicle

VEHICLE = Vehicle(
    left=(2, 3, 4, -7, -4, -3, -2, 1),
    right=(-2, -3, -4, -9, 4, 3, 2, 1),
    threshold=80,
    saturation=500,
    divisor=3,
    forward=200,
    least=10,
    turn=120,
    moved_pulses=4424,
    front=slice(3, 4),
)
