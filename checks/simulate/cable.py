"""A serial cable from an adapter of the machine to a robot, which is no part of the machine.

Bytes to the robot leave the adapter one after another at the adapter's baud rate; the robot sends at its baud
rate. If the two differ, other bytes arrive. The cable loses, garbles, repeats and delays bytes, and is pulled
out and plugged in again: its device does not exist meanwhile.
"""

# The functions of open files are the system's, which documents them.
# ruff: noqa: D102

import errno
import os
import struct
import termios
from collections.abc import Sequence
from typing import Any

from checks.simulate.kernel import NS_PER_S, OpenFile, Process
from checks.simulate.simulation import Simulation
from khep_twin.board.uart import LineSettings
from khep_twin.ports.host_port import NOTHING, Received
from khep_twin.units import BITS_PER_BYTE

CAPACITY = 4096
"""Bytes that the adapter's driver takes before it is full [bytes]."""

_AT_ONCE = 8
"""Most bytes that arrive at the robot in one event."""

_BAD = 0.25
"""Share of cables that spoil bytes."""

_MAX_RATES = {"drop": 0.002, "garble": 0.002, "double": 0.002, "late": 0.01}
"""Highest probability of each fault of some bytes."""

_LATE_NS = 200_000_000
"""Longest delay of some bytes: shorter, both ways, than the silence that a relay takes for an end [ns]."""

_TRANSIT_NS = 100_000, 2_000_000
"""Shortest and longest transit from the robot, of a polled adapter (assumed) [ns]."""

_SILENCE_NS = NS_PER_S // 2
"""Silence after which a robot has answered the requests of an earlier program [ns]."""

_SPEEDS = {getattr(termios, f"B{baud}"): baud for baud in (300, 9600, 19200, 38400, 57600, 115200)}


class Account:
    """Bytes that one program at the adapter has exchanged with the cable.

    Attributes:
        sent: Bytes that it has handed to the adapter.
        received: Bytes that it has read.
    """

    def __init__(self) -> None:
        self.sent, self.received = bytearray(), bytearray()


class Cable:
    """A cable, and the device of its adapter.

    Args:
        simulation: Simulation.
        path: Path of the device.
        baud: Speed of the robot's line [baud].

    Attributes:
        adapter: Open file of the device; None for none.
        robot: The robot's end; None while the robot is off.
        accounts: Bytes that each program at the device has exchanged, the latest last.
        away_ns: Time at which it was pulled out; None while it is plugged in [ns].
    """

    def __init__(self, simulation: Simulation, path: str, baud: int) -> None:
        self.simulation, self.kernel, self.path, self.baud = simulation, simulation.kernel, path, baud
        self.adapter: Adapter | None = None
        self.robot: RobotEnd | None = None
        self.accounts: list[Account] = []
        self.away_ns: int | None = None
        self._underway = bytearray()
        self._is_sending = False
        self._arrivals_ns = {True: 0, False: 0}
        self._touched_ns, self._dirty = -NS_PER_S, False
        self._heard_ns, self._is_behind = -NS_PER_S, False
        self._rng = simulation.rng("cable")
        is_bad = self._rng.random() < _BAD
        self._max_rates = _MAX_RATES if is_bad else {"late": _MAX_RATES["late"]}
        simulation.system.devices[path] = self

    def open(self, process: Process, flags: int) -> OpenFile:
        """Open the device."""
        self.adapter = Adapter(self)
        self.accounts.append(self.adapter.account)
        return self.adapter

    @property
    def touched_ns(self) -> int:
        """Time until which lines differed from those sent, or replies were to an earlier program [ns]."""
        if self._is_behind and self.kernel.now_ns - self._heard_ns > _SILENCE_NS:
            self._is_behind = False
        if self._is_behind:
            self._touched_ns = self.kernel.now_ns
        return self.kernel.now_ns if self._dirty else self._touched_ns

    def touch(self) -> None:
        """Note that the current line may differ from the one that was sent."""
        self._dirty, self._touched_ns = True, self.kernel.now_ns

    def leave(self) -> None:
        """Note that a program has left the device: the robot may still answer it."""
        self._is_behind, self._heard_ns = True, self.kernel.now_ns

    def unplug(self) -> None:
        """Pull the cable out."""
        self.touch()
        self.away_ns = self.kernel.now_ns
        del self.simulation.system.devices[self.path]
        self._underway.clear()
        if self.adapter is not None:
            self.adapter.is_dead = True
            self.adapter.changed()
            self.adapter = None

    def plug(self) -> None:
        """Plug it in again."""
        self.away_ns = None
        self.simulation.system.devices[self.path] = self

    # Bytes ---------------------------------------------------------------------------------------------

    @property
    def unsent(self) -> int:
        """Number of bytes that have not left the adapter."""
        return len(self._underway)

    def send(self, data: bytes) -> int:
        """Take bytes to the robot; return the number that found room."""
        data = data[: CAPACITY - len(self._underway)]
        self._underway += data
        if not self._is_sending:
            self._next()
        return len(data)

    def _next(self) -> None:
        data = bytes(self._underway[:_AT_ONCE])
        self._is_sending = bool(data)
        if data:
            baud = self.adapter.baud if self.adapter is not None else self.baud
            duration_ns = len(data) * BITS_PER_BYTE * NS_PER_S // baud
            self.kernel.at(self.kernel.now_ns + duration_ns, lambda: self._sent(data, baud))

    def _sent(self, data: bytes, baud: int) -> None:
        if self.away_ns is None:
            del self._underway[: len(data)]
            self._carry(True, data, baud, 0)
            if self.adapter is not None:
                self.adapter.changed()
        self._next()

    def receive(self, data: bytes) -> None:
        """Take bytes of the robot."""
        if self._is_behind and self.touched_ns >= self.kernel.now_ns:
            self._heard_ns = self.kernel.now_ns
        baud = self.baud if self.adapter is None else self.adapter.baud
        self._carry(False, data, baud, self._rng.randrange(*_TRANSIT_NS))

    def _carry(self, to_robot: bool, data: bytes, baud: int, delay_ns: int) -> None:
        """Carry bytes to an end, in order, with the faults of the cable."""
        carried, delay_ns = self._disturbed("to robot" if to_robot else "from robot", data, delay_ns)
        if baud != self.baud:
            carried = self._rng.randbytes(len(data))
        if carried != data:
            self.touch()
        elif to_robot and self._dirty and (b"\n" in data or b"\r" in data):
            self._dirty, self._touched_ns = False, self.kernel.now_ns
        due_ns = max(self.kernel.now_ns + delay_ns, self._arrivals_ns[to_robot])
        self._arrivals_ns[to_robot] = due_ns
        self.kernel.at(due_ns, lambda: self._arrive(to_robot, carried))

    def _disturbed(self, name: str, data: bytes, delay_ns: int) -> tuple[bytes, int]:
        faults = self.simulation.faults
        for kind, max_rate in self._max_rates.items():
            if data and faults.happens(f"cable {kind}", name, max_rate):
                rng = faults.drawn(f"cable {kind}", name)
                at = rng.randrange(len(data))
                if kind == "late":
                    delay_ns += rng.randrange(_LATE_NS)
                else:
                    bits = data[at] ^ 1 << rng.randrange(8)
                    new = {"drop": b"", "garble": bytes([bits]), "double": data[at : at + 1] * 2}[kind]
                    data = data[:at] + new + data[at + 1 :]
        return data, delay_ns

    def _arrive(self, to_robot: bool, data: bytes) -> None:
        end = self.robot if to_robot else self.adapter
        if end is not None and self.away_ns is None:
            end.data += data
            end.changed()


class Adapter(OpenFile):
    """One open file of the device.

    Attributes:
        data: Bytes that can be read.
        is_dead: True if the device has gone.
        account: Bytes that are exchanged by it.
    """

    def __init__(self, cable: Cable) -> None:
        super().__init__(cable.kernel)
        self._cable = cable
        self.data = bytearray()
        self.is_dead = False
        self.account = Account()
        characters: list[bytes | int] = [b"\0"] * 32
        self._settings: list[Any] = [0, 0, termios.CS8, 0, termios.B9600, termios.B9600, characters]

    @property
    def baud(self) -> int:
        """Speed that is set [baud]."""
        return _SPEEDS.get(self._settings[5], 1)

    def readable(self) -> bool:
        return bool(self.data) or self.is_dead

    def writable(self) -> bool:
        return self.is_dead or self._cable.unsent < CAPACITY

    def hung_up(self) -> bool:
        return self.is_dead

    def read(self, limit: int) -> bytes:
        data = b"" if self.is_dead else bytes(self.data[:limit])
        del self.data[: len(data)]
        self.account.received += data
        return data

    def write(self, data: bytes) -> int:
        self._check()
        if not (count := self._cable.send(data)):
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self.account.sent += data[:count]
        return count

    def ioctl(self, request: int, argument: Any) -> Any:
        """Answer requests of pyserial's: the bytes at both ends, and modem lines, which nothing reads."""
        self._check()
        if request == termios.FIONREAD:
            return struct.pack("I", len(self.data))
        if request == termios.TIOCOUTQ:
            return struct.pack("I", self._cable.unsent)
        if request in (termios.TIOCMBIS, termios.TIOCMBIC):
            return 0
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    def tcgetattr(self) -> list[Any]:
        self._check()
        return [*self._settings[:6], [*self._settings[6]]]

    def tcsetattr(self, _: int, settings: list[Any]) -> None:
        self._check()
        self._settings = [*settings[:6], [*settings[6]]]

    def tcflush(self, queue: int) -> None:
        self._check()
        if queue == termios.TCIFLUSH:
            self.data.clear()

    def flock(self, operation: int) -> None:
        """Lock the device, which no other program opens."""

    def closed(self) -> None:
        if self._cable.adapter is self:
            self._cable.adapter = None
        self._cable.leave()

    def _check(self) -> None:
        if self.is_dead:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


class RobotEnd(OpenFile):
    """The robot's end of the cable, a `HostPort` of the process that plays the robot.

    Attributes:
        data: Bytes that have come.
    """

    path, dropped, occupied = "robot", 0, True

    def __init__(self, cable: Cable, process: Process) -> None:
        super().__init__(cable.kernel)
        self._cable = cable
        self.data = bytearray()
        self._descriptor = process.opened(self)
        cable.robot = self

    def readable(self) -> bool:
        return bool(self.data)

    def descriptors(self, has_room: bool) -> Sequence[int]:
        """Return the descriptor that becomes readable when bytes come."""
        return [self._descriptor] if has_room else []

    def set_baud(self, baud: int) -> None:
        """Do nothing: the baud rate is the host's."""

    def settings(self) -> LineSettings | None:
        """Return None: a robot cannot see the other end."""
        return None

    def receive(self, limit: int, is_answered: bool = False) -> Received:
        """Return the received bytes; the robot cannot detect changes of the host."""
        data = bytes(self.data[:limit])
        del self.data[:limit]
        return Received(data) if data else NOTHING

    def write(self, data: bytes, is_end: bool = False) -> int:
        """Send to the cable."""
        self._cable.receive(data)
        return len(data)

    def close(self) -> None:
        """Do nothing: a robot that is switched off closes it."""

    def closed(self) -> None:
        if self._cable.robot is self:
            self._cable.robot = None
            self._cable.touch()
