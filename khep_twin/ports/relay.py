"""A tap on a real robot: a cable with a listener in the middle.

Host and robot speak with each other as if the relay were not there, at the speed that the host sets; what
either says is passed on as it comes, and noted with its time.
"""

# pyserial is not typed.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import os
import select
import time
from collections.abc import Callable
from typing import Any

import serial

from khep_twin.errors import PortError
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.ports.cable import IN_A_MOMENT, Cable
from khep_twin.ports.serve import LONGEST_WAIT, Flush
from khep_twin.uart import LineSettings

_CHUNK = 1024
"""Most bytes passed on at once."""

_POLL = 0.001
"""How often a port that cannot wake the loop is looked at [s]."""


class Device:
    """A robot's own port, as pyserial opens it.

    Args:
        url: a device such as /dev/ttyUSB0, or a URL of pyserial's.
        baud: speed of the robot's line.

    Attributes:
        url: what was opened.
        descriptor: for `select`; None where the port has none.

    Raises:
        PortError: it cannot be opened, or is no robot's.
    """

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        if url.startswith("khep:"):
            raise PortError(f"{url}: a twin needs no relay; right is khep-twin serve PLAYPEN")
        try:
            self._port: Any = serial.serial_for_url(
                url, baud, stopbits=serial.STOPBITS_TWO, timeout=0, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else error
            raise PortError(f"{url}: cannot open this port: {reason}") from error
        try:
            self.descriptor: int | None = self._port.fileno()
            self._port.write_timeout = 0
        except OSError:
            # Its writes return when all is sent.
            self.descriptor = None

    def follow(self, host: LineSettings) -> str:
        """Sets the line as the host has set its own; returns what is to be told of it, empty if nothing."""
        stop_bits = serial.STOPBITS_TWO if host.stop_bits == 2 else serial.STOPBITS_ONE
        if not host.baud or (host.baud, stop_bits) == (self._port.baudrate, self._port.stopbits):
            return ""
        try:
            self._port.baudrate, self._port.stopbits = host.baud, stop_bits
        except (serial.SerialException, OSError, ValueError) as error:
            return f"the robot's port cannot follow the host to {host.baud} baud: {error}"
        return f"the line is at {host.baud} baud with {host.stop_bits} stop bits, as the host has set it"

    def read(self) -> bytes:
        """What has come from the robot.

        Raises:
            PortError: the port has gone.
        """
        try:
            return self._port.read(_CHUNK if self.descriptor is not None else self._port.in_waiting)
        except (serial.SerialException, OSError) as error:
            raise PortError(f"{self.url}: the robot's port failed: {error}") from error

    def write(self, data: bytes) -> int:
        """Sends to the robot; returns how many bytes the port took.

        Raises:
            PortError: the port has gone.
        """
        try:
            return self._port.write(data) or 0
        except (serial.SerialException, OSError) as error:
            raise PortError(f"{self.url}: the robot's port failed: {error}") from error

    def close(self) -> None:
        """Gives it back."""
        self._port.close()


def relay(
    device: Device,
    cable: Cable,
    recorder: LineRecorder | None,
    *,
    stop: Callable[[], bool],
    tell: Callable[[str], None],
) -> None:
    """Lets a host talk to a robot until `stop` says so.

    Args:
        device: where the robot is.
        cable: where the host is.
        recorder: hears what both say.
        stop: asked once a turn.
        tell: takes what somebody should see.

    Raises:
        PortError: the robot's port failed.
    """

    def note(text: str) -> None:
        tell(f"{cable.path}: {text}")
        if recorder is not None:
            recorder.event(text)

    def hear(to_robot: bool, data: bytes) -> None:
        if recorder is not None:
            recorder.wire(to_robot, data)

    flush = Flush(recorder)
    waiting = b""
    while not stop():
        _wait(device, cable, bool(waiting))
        gone, notices = cable.look()
        for notice in notices:
            note(notice)
        if not waiting and (waiting := cable.read(_CHUNK)):
            settings = cable.settings()
            if settings is not None and (notice := device.follow(settings)):
                note(notice)
            hear(True, waiting)
        if waiting:
            waiting = waiting[device.write(waiting) :]
        if reply := device.read():
            hear(False, reply)
            if cable.occupied:
                cable.write(reply)
        if gone and not cable.clear():
            note(IN_A_MOMENT)
        flush()


def _wait(device: Device, cable: Cable, waiting: bool) -> None:
    """Waits until there is something to pass on, and room for it."""
    descriptors = list(cable.descriptors(not waiting))
    if device.descriptor is None:
        select.select(descriptors, [], [], _POLL)
    else:
        full = [device.descriptor] if waiting else []
        select.select([*descriptors, device.descriptor], full, [], LONGEST_WAIT)


def since_now() -> Callable[[], int]:
    """A clock of wall time that starts at 0 [ns]."""
    start_ns = time.monotonic_ns()
    return lambda: time.monotonic_ns() - start_ns
