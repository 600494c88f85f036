"""The commands of the Khepera Toolbox for Matlab, with its names, arguments and order.

    from khep_twin.toolbox.serial_commands import ports, rps, sms

    ports({2: "/dev/ttyUSB0"})          # or in the shell: export KHEP_PORT_2=/dev/ttyUSB0
    motors = rps(2) @ Intercon / 400 + speed
    sms(2, motors[0], motors[1])

`port_id` is 1 to 4, as in the toolbox; `ports` or the environment assigns a port to it. It may also be the
URL of a port or a `Khepera`. A row of Matlab, 1x2, 1x6 or 1x8, is a one-dimensional array here, so that
`motors(1)` is `motors[0]`; scipy's `savemat` converts it to a row. A number that is no integer is rounded,
halves away from zero, as in Matlab.

`khep_twin.toolbox` has these and all other functions of the toolbox, including the simulator's.
"""

import atexit
import math
import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import SupportsFloat

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import PortError, ProtocolError
from khep_twin.host.host_command import query
from khep_twin.host.khepera import Khepera
from khep_twin.host.opening import PORT_IDS, VARIABLE

__all__ = [
    "cls",
    "con",
    "cpid",
    "cspc",
    "kturret",
    "ports",
    "rad",
    "rls",
    "rmc",
    "rms",
    "robot_at",
    "rpc",
    "rps",
    "skp",
    "sms",
    "spc",
]

Port = int | str | Khepera
"""Number 1 to 4, the URL of a port, or a robot."""

Row = NDArray[np.int64]
"""Integers, one for each column of a row in Matlab."""

_assigned_ports: dict[int, str | Khepera] = {}
_open_robots: dict[str, Khepera] = {}


def ports(choice: Mapping[int, str | Khepera]) -> None:
    """Set the ports 1 to 4, and close the previous ones.

    A port is a URL, e.g. "/dev/ttyUSB0" or "khep://default?seed=1", or an open robot.

    Raises:
        PortError: A number is none of 1 to 4.
    """
    for number in choice:
        if number not in PORT_IDS:
            raise PortError(f"ports: {number!r}; expected a number from 1 to 4")
    for robot in _open_robots.values():
        robot.close()
    _open_robots.clear()
    _assigned_ports.clear()
    _assigned_ports.update(choice)


def robot_at(port_id: Port) -> Khepera:
    """Return the robot at a port, which is opened at first use.

    Raises:
        PortError: The number is none of 1 to 4, or has no port, or the port cannot be opened.
    """
    if isinstance(port_id, Khepera):
        return port_id
    port = port_id if isinstance(port_id, str) else _require_port(port_id)
    if isinstance(port, Khepera):
        return port
    if port not in _open_robots:
        _open_robots[port] = Khepera(port)
    return _open_robots[port]


@contextmanager
def assigned_port(robot: Khepera, port_id: int | None = None) -> Generator[int]:
    """Assign `port_id`, and all numbers without a port, to an open robot within the context.

    Yield a number of the robot: `port_id`, or without it the first free_numbers one.
    """
    saved = dict(_assigned_ports)
    free_numbers = [number for number in PORT_IDS if _find_port(number) is None]
    number = port_id or (free_numbers or PORT_IDS)[0]
    _assigned_ports.update(dict.fromkeys({*free_numbers, number}, robot))
    try:
        yield number
    finally:
        _assigned_ports.clear()
        _assigned_ports.update(saved)


def con(port_id: Port, Kp: SupportsFloat, Ki: SupportsFloat, Kd: SupportsFloat) -> None:
    """Set the gains of the speed controller; 3800, 800, 100 after a reset (command A)."""
    robot_at(port_id).configure_speed_controller(*_to_integers("con", Kp=Kp, Ki=Ki, Kd=Kd))


def skp(port_id: Port, pos_left: SupportsFloat, pos_right: SupportsFloat) -> None:
    """Move the wheels to positions [pulses of 0.08 mm], at most 2^23 - 2 from 0 (command C)."""
    robot_at(port_id).set_target(*_to_integers("skp", pos_left=pos_left, pos_right=pos_right))


def sms(port_id: Port, speed_left: SupportsFloat, speed_right: SupportsFloat) -> None:
    """Drive the wheels at speeds [pulses/10 ms = 8 mm/s], -127 to 127 (command D)."""
    robot_at(port_id).set_speed(*_to_integers("sms", speed_left=speed_left, speed_right=speed_right))


def rms(port_id: Port) -> Row:
    """Return the measured speed of the left and the right wheel (2,) [pulses/10 ms] (command E)."""
    return _to_row(robot_at(port_id).speed())


def cpid(port_id: Port, Kp: SupportsFloat, Ki: SupportsFloat, Kd: SupportsFloat) -> None:
    """Set the gains of the position controller; 3000, 20, 4000 after a reset (command F)."""
    robot_at(port_id).configure_position_controller(*_to_integers("cpid", Kp=Kp, Ki=Ki, Kd=Kd))


def spc(port_id: Port, pos_left: SupportsFloat, pos_right: SupportsFloat) -> None:
    """Set the position counters [pulses] (command G)."""
    robot_at(port_id).set_position(*_to_integers("spc", pos_left=pos_left, pos_right=pos_right))


def rpc(port_id: Port) -> Row:
    """Return the position counters, left and right (2,) [pulses], 12.5 per millimetre (command H)."""
    return _to_row(robot_at(port_id).position())


def cspc(
    port_id: Port,
    max_speed_left: SupportsFloat,
    acc_left: SupportsFloat,
    max_speed_right: SupportsFloat,
    acc_right: SupportsFloat,
) -> None:
    """Set the profile of `skp` (command J).

    Speeds [pulses/10 ms], accelerations [3.125 mm/s^2]; 20, 64 after a reset.
    """
    left = _to_integers("cspc", max_speed_left=max_speed_left, acc_left=acc_left)
    right = _to_integers("cspc", max_speed_right=max_speed_right, acc_right=acc_right)
    robot_at(port_id).configure_profile(*left, *right)


def rmc(port_id: Port) -> Row:
    """Return motion control of the left and the right wheel, [T, M, E, T, M, E] (6,) (command K).

    T is 1 on the target. M is 0 for speed, 1 for position and 2 for a fixed duty with ROM 5.02, and with the
    toolbox's ROM 4.06 it is 0 for position and 1 for speed. E is the controller's error.
    """
    # As the robot reports them: `Khepera.status` converts the modes of all ROMs to one form.
    (values,) = robot_at(port_id).burst(query("K", 6, tuple))
    return _to_row(values)


def rad(port_id: Port, channel_number: SupportsFloat) -> int:
    """Return one channel of the converter, 0 to 1023; 1024 would be 4.09 V (command I)."""
    return robot_at(port_id).converter(*_to_integers("rad", channel_number=channel_number))


def cls(port_id: Port, led_number: SupportsFloat, action_number: SupportsFloat) -> None:
    """Switch LED 0 or 1; action 0 off, 1 on, 2 toggle (command L)."""
    robot_at(port_id).set_led(*_to_integers("cls", led_number=led_number, action_number=action_number))


def rps(port_id: Port) -> Row:
    """Return proximity (8,), 0 to 1023 (command N).

    Left 90, 45, 10, right 10, 45, 90, back right, back left.
    """
    return _to_row(robot_at(port_id).proximity())


def rls(port_id: Port) -> Row:
    """Return ambient light (8,) in the order of `rps`; about 500 in the dark, less in light (command O)."""
    return _to_row(robot_at(port_id).ambient())


def kturret(port_id: Port, turret: SupportsFloat, message: str) -> Row:
    """Send a message to a turret; return the integers of its reply, e.g. 64 pixels for 2 and "N" (command T).

    The toolbox has no command for turrets; the name is that of K-Team's functions for Matlab.

    Raises:
        ProtocolError: The turret is absent, does not know the message, or replies with other than integers.
    """
    robot = robot_at(port_id)
    (number,) = _to_integers("kturret", turret=turret)
    answer = robot.turret(number, message)
    letter, *fields = answer.split(",")
    try:
        values = [int(field) for field in fields]
    except ValueError:
        letter, values = "", []
    if letter != message[:1].lower():
        raise ProtocolError(f"{robot.name}: turret {number} answered {message!r} with {answer!r}")
    return _to_row(tuple(values))


# Stop all robots when the program ends, also by Ctrl-C.
atexit.register(ports, {})


def _require_port(port_id: int) -> str | Khepera:
    """Return the port of a number."""
    if port_id not in PORT_IDS:
        raise PortError(key="port_id", value=port_id, expected="1 to 4, or a port such as '/dev/ttyUSB0'")
    port = _find_port(port_id)
    if port is None:
        raise PortError(
            f"port_id = {port_id}: no port is chosen; expected ports({{{port_id}: '/dev/ttyUSB0'}}), or "
            f"{VARIABLE}{port_id}=/dev/ttyUSB0 in the environment"
        )
    return port


def _find_port(port_id: int) -> str | Khepera | None:
    return _assigned_ports.get(port_id) or os.environ.get(f"{VARIABLE}{int(port_id)}")


def _to_integers(command: str, **values: SupportsFloat) -> list[int]:
    """Return integers, rounded with halves away from zero."""
    numbers: list[int] = []
    for name, value in values.items():
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not abs(number) < 2**31:
            raise ValueError(f"{command}: {name} = {number}; expected a number of less than 2^31")
        # Not trunc(x + 0.5), which rounds the largest number below a half to 1.
        integer = math.trunc(number)
        numbers.append(integer + int(math.copysign(abs(number - integer) >= 0.5, number)))
    return numbers


def _to_row(values: tuple[int, ...]) -> Row:
    return np.array(values, np.int64)
