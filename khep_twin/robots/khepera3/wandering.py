"""Rounds of the Braitenberg vehicle of letter A (library); with ultrasonic sensors: assumed."""

from collections.abc import Sequence

from khep_twin.robots.khepera3.channels import RING
from khep_twin.robots.khepera3.state import LAST_LEFT, LAST_RIGHT, N_STILL, TURNING
from khep_twin.robots.khepera3.vehicle import vehicle_speeds
from khep_twin.sensing.buffers import Vector

TURN_SPEEDS, _BLOCKED, _N_STUCK, _MOVED_PULSES = (12_800, -12_800), 250, 5, 700
"""Speeds of a turn in place; it lasts while a front reading is above 250, and starts after more than five
rounds in which the wheels moved by less than 700 pulses."""

ECHO_SENSORS = 1, 2, 3, 3, 4, 5
"""Number of the ultrasonic sensor in place of each infrared one, from the left to the right one."""

_FAR_CM, _COUNTS_PER_CM = 70, 20
"""Distance of an echo with a reading of 0, and its rise, to 1000 at 20 cm."""

_FRONT = RING.index("front left")


def next_speeds(
    vehicle: Vector[int],
    readings: Sequence[int],
    positions: tuple[int, int],
    gain: int,
    is_server: bool,
) -> tuple[int, int] | None:
    """Run a round; return the speeds of the wheels, None while they turn in place.

    Args:
        vehicle: State of the vehicle, changed in place.
        readings: Readings of the infrared sensors.
        positions: Positions of the wheels [pulses].
        gain: Gain of the configuration.
        is_server: True for kh3server, which has a fixed gain, compares positions as unsigned numbers, and
            drives by the readings from the second one on.
    """
    if vehicle[TURNING] and max(readings[_FRONT : _FRONT + 2]) > _BLOCKED:
        return None
    last_positions = int(vehicle[LAST_LEFT]), int(vehicle[LAST_RIGHT])
    pairs = zip(positions, last_positions, strict=True)
    is_still = all(_is_near(position, last, is_server) for position, last in pairs)
    vehicle[N_STILL] = vehicle[N_STILL] + 1 if is_still else 0
    vehicle[TURNING] = vehicle[N_STILL] > _N_STUCK
    if vehicle[TURNING] or not is_still:
        vehicle[N_STILL], vehicle[LAST_LEFT], vehicle[LAST_RIGHT] = 0, *positions
    if vehicle[TURNING]:
        return TURN_SPEEDS
    return (
        vehicle_speeds(readings[1 : len(RING) + 1])
        if is_server
        else vehicle_speeds(readings[: len(RING)], gain)
    )


def _is_near(position: int, last_position: int, is_unsigned: bool) -> bool:
    """Return whether a wheel has moved by less than 700 pulses."""
    numbers = last_position - _MOVED_PULSES, position, last_position + _MOVED_PULSES
    low, present, high = (number % 2**32 for number in numbers) if is_unsigned else numbers
    return low < present < high


def echo_readings(echoes: Sequence[Sequence[int]]) -> Sequence[int]:
    """Return the readings of the vehicle by the dsPIC's replies for `ECHO_SENSORS`."""
    readings = [_COUNTS_PER_CM * (_FAR_CM - distance) if count else 0 for count, distance, *_ in echoes]
    return [0, *(max(reading, 0) for reading in readings), *[0] * 4]
