"""Simulated pseudo-terminals as Linux has them, in raw mode only: nothing is echoed, edited or translated.

A terminal's path is that of an empty file in the simulation's folder, so that links and `exists` work.
"""

# ruff: noqa: D102

import copy
import errno
import fcntl
import os
import struct
import termios
import tty
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

from tools.simulate.inotify import SimulatedCtypes, Watches
from tools.simulate.kernel import Kernel, OpenFile, Process
from tools.simulate.proc import SimulatedProcesses
from tools.simulate.system import Shim, System

READY = 4095
"""Most bytes that wait for a reader; Linux's N_TTY."""

TRANSIT = 12_288
"""Most bytes in transit, so that some 16 kB are accepted each way (measured 13.8 to 20.9 kB)."""

_TRANSIT_NS = 1_000, 80_000
"""Shortest and longest usual transit of written bytes [ns] (assumed)."""

_CLOSING_NS = 500, 40_000
"""Shortest and longest usual time from the report of a closing to its effect [ns] (assumed)."""

_TIOCGEXCL = getattr(termios, "TIOCGEXCL", 0x80045440)


class Terminals:
    """All pseudo-terminals of a simulation.

    Args:
        system: System to which they are added.
        folder: Folder of the simulation.

    Attributes:
        by_number: Terminals that exist, by number.
        watches: Watches of inotify on them.
    """

    def __init__(self, system: System, folder: Path) -> None:
        shim: Any = system.modules["os"]
        self.kernel: Kernel = shim.kernel
        self.by_number: dict[int, Terminal] = {}
        self.devices = system.devices
        self.folder = folder / "dev" / "pts"
        self.folder.mkdir(parents=True)
        self.watches = Watches(self.kernel, str(self.folder))
        shim.openpty, shim.ttyname = self.openpty, self.ttyname
        system.modules["tty"] = SimulatedTty(self.kernel, system)
        system.modules["ctypes"] = SimulatedCtypes(self.kernel, self.watches)
        processes = SimulatedProcesses(self.kernel, _link_of)
        shim.readlink = processes.readlink
        system.patches["khep_twin.ports.holders._PROCESSES"] = processes

    def openpty(self) -> tuple[int, int]:
        if self.kernel.current is None:
            return os.openpty()
        process = self.kernel.called()
        number = next(each for each in count() if each not in self.by_number)
        terminal = self.by_number[number] = Terminal(self, number)
        terminal.device.touch(mode=0o600)
        self.devices[terminal.name] = terminal
        return process.opened(terminal.master), process.opened(terminal.open(process, os.O_RDWR))

    def ttyname(self, descriptor: int) -> str:
        if self.kernel.current is None:
            return os.ttyname(descriptor)
        file = self.kernel.called().file(descriptor)
        if not isinstance(file, HostSide) or file.terminal.gone:
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        return file.terminal.name


class Line:
    """Bytes on their way to one side.

    Attributes:
        transit: Bytes that have been written.
        ready: Bytes that a read returns next.
        stopped: True while the writer's side has stopped its output.
    """

    def __init__(self, kernel: Kernel, changed: Callable[[], object]) -> None:
        self._kernel, self._changed = kernel, changed
        self.transit, self.ready = bytearray(), bytearray()
        self.stopped = self._due = False

    def room(self) -> int:
        return 0 if self.stopped else TRANSIT - len(self.transit)

    def write(self, data: bytes) -> int:
        taken = data[: self.room()]
        if data and not taken:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self.transit += taken
        self._push_later()
        return len(taken)

    def read(self, limit: int) -> bytes:
        # A read without anything ready waits for what is in transit, another one does not.
        if not self.ready:
            self._push()
        taken = bytes(self.ready[:limit])
        del self.ready[:limit]
        if self.transit:
            self._push_later()
        return taken

    def _push_later(self) -> None:
        if not self._due:
            self._due = True
            delay_ns = self._kernel.delays.randrange(*_TRANSIT_NS)
            self._kernel.at(self._kernel.now_ns + delay_ns, self._pushed)

    def _pushed(self) -> None:
        self._due = False
        self._push()

    def _push(self) -> None:
        moved = self.transit[: READY - len(self.ready)]
        self.ready += moved
        del self.transit[: len(moved)]
        self._changed()

    def __len__(self) -> int:
        return len(self.ready) + len(self.transit)


class Terminal:
    """One pseudo-terminal, which is the device of its path.

    Attributes:
        name: Path.
        master: Open file of the far side.
        hosts: Open files of the host side, in the order of their openings.
        hung_up: True if the host side was closed everywhere.
        gone: True if the far side was closed.
        attributes: Attributes, those of the host side for both.
    """

    def __init__(self, terminals: Terminals, number: int) -> None:
        self.terminals, self.kernel = terminals, terminals.kernel
        self.number = number
        self.device = terminals.folder / str(number)
        self.name = str(self.device)
        self.hosts: list[HostSide] = []
        self.hung_up = self.gone = self.exclusive = False
        self.attributes = copy.deepcopy(_FRESH)
        self.to_master, self.to_hosts = (Line(self.kernel, self.changed) for _ in range(2))
        self.master = MasterSide(self)
        self.locks: dict[OpenFile, int] = {}

    def open(self, process: Process, flags: int) -> "HostSide":
        if self.gone:
            raise OSError(errno.EIO, os.strerror(errno.EIO), self.name)
        if self.exclusive:  # only root passes
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), self.name)
        file = HostSide(self, writes=bool(flags & (os.O_RDWR | os.O_WRONLY)))
        self.hosts.append(file)
        self.hung_up = False
        self.terminals.watches.opened(self.name)
        return file

    def changed(self) -> None:
        self.master.changed()
        for each in self.hosts:
            each.changed()

    def left(self, file: "HostSide") -> None:
        """Complete the closing of a host side."""
        self.hosts.remove(file)
        self.locks.pop(file, None)
        if not self.hosts:
            self.hung_up = True
            self.master.changed()

    def vanish(self) -> None:
        """Hang up: the far side was closed; what hosts have not read is lost."""
        self.gone = True
        self.to_hosts.transit.clear()
        self.to_hosts.ready.clear()
        del self.terminals.by_number[self.number], self.terminals.devices[self.name]
        self.device.unlink()
        for each in self.hosts:
            each.changed()


class _Side(OpenFile):
    """Open file of a terminal, with what both sides have."""

    def __init__(self, terminal: Terminal, incoming: Line, outgoing: Line) -> None:
        super().__init__(terminal.kernel)
        self.terminal, self.incoming, self.outgoing = terminal, incoming, outgoing

    def readable(self) -> bool:
        return len(self.incoming) > 0

    def writable(self) -> bool:
        return self.outgoing.room() > 0

    def write(self, data: bytes) -> int:
        return self.outgoing.write(data)

    def check(self) -> None:
        """Raise an error where the terminal has gone."""

    def tcgetattr(self) -> list[Any]:
        self.check()
        return copy.deepcopy(self.terminal.attributes)

    def tcsetattr(self, when: int, attributes: list[Any]) -> None:
        self.check()
        if when == termios.TCSAFLUSH:
            self.incoming.ready.clear()
        new = copy.deepcopy(attributes)
        # The driver has neither parity nor other sizes of bytes.
        new[2] = (new[2] & ~(termios.CSIZE | termios.PARENB)) | termios.CS8 | termios.CREAD
        new[4] = new[4] or new[5]
        is_raw = not new[3] & termios.ICANON
        for place, each in enumerate(new[6]):
            number = each if isinstance(each, int) else each[0]
            is_number = is_raw and place in (termios.VMIN, termios.VTIME)
            new[6][place] = number if is_number else bytes([number])
        self.terminal.attributes = new

    def tcflush(self, queue: int) -> None:
        self.check()
        if queue in (termios.TCIFLUSH, termios.TCIOFLUSH):
            self.incoming.transit.clear()
            self.incoming.ready.clear()
        if queue in (termios.TCOFLUSH, termios.TCIOFLUSH):
            self.outgoing.transit.clear()
        self.terminal.changed()

    def tcflow(self, action: int) -> None:
        self.check()
        if action in (termios.TCIOFF, termios.TCION):
            self.write(b"\x13" if action == termios.TCIOFF else b"\x11")
            return
        self.outgoing.stopped = action == termios.TCOOFF
        self.terminal.changed()

    def tcdrain(self) -> None:
        self.check()

    def tcsendbreak(self, duration: int) -> None:
        self.check()

    def ioctl(self, request: int, argument: Any) -> Any:
        self.check()
        terminal = self.terminal
        if request in (termios.TIOCEXCL, termios.TIOCNXCL):
            if isinstance(self, HostSide):
                terminal.exclusive = request == termios.TIOCEXCL
            return argument
        answers = {
            termios.FIONREAD: len(self.incoming.ready),
            termios.TIOCOUTQ: 0,
            _TIOCGEXCL: int(terminal.exclusive and isinstance(self, HostSide)),
        }
        if request not in answers:
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        return struct.pack("i", answers[request])

    def flock(self, operation: int) -> None:
        locks = self.terminal.locks
        wanted = operation & (fcntl.LOCK_SH | fcntl.LOCK_EX)
        locks.pop(self, None)
        if not wanted:
            return
        if any(fcntl.LOCK_EX in (wanted, held) for held in locks.values()):
            if not operation & fcntl.LOCK_NB:
                raise NotImplementedError("locks that wait")
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        locks[self] = wanted


class MasterSide(_Side):
    """Far side of a terminal."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__(terminal, terminal.to_master, terminal.to_hosts)

    def hung_up(self) -> bool:
        return self.terminal.hung_up

    def readable(self) -> bool:
        return len(self.incoming) > 0 or self.terminal.hung_up

    def read(self, limit: int) -> bytes:
        if data := self.incoming.read(limit):
            self.terminal.changed()
            return data
        number = errno.EIO if self.terminal.hung_up else errno.EAGAIN
        raise OSError(number, os.strerror(number))

    def closed(self) -> None:
        self.terminal.vanish()


class HostSide(_Side):
    """Host side of a terminal, opened once."""

    def __init__(self, terminal: Terminal, *, writes: bool) -> None:
        super().__init__(terminal, terminal.to_hosts, terminal.to_master)
        self.writes = writes

    def waits(self) -> bool:
        return self.blocking and self.terminal.attributes[6][termios.VMIN] != 0

    def readable(self) -> bool:
        return self.terminal.gone or super().readable()

    def writable(self) -> bool:
        return self.terminal.gone or super().writable()

    def hung_up(self) -> bool:
        return self.terminal.gone

    def read(self, limit: int) -> bytes:
        data = self.incoming.read(limit)
        if data:
            self.terminal.master.changed()
        elif not self.terminal.gone and self.terminal.attributes[6][termios.VMIN] != 0:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return data

    def write(self, data: bytes) -> int:
        self.check()
        if not self.writes:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        taken = super().write(data)
        self.terminal.terminals.watches.written(self.terminal.name)
        return taken

    def check(self) -> None:
        if self.terminal.gone:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def closed(self) -> None:
        """Report the closing; it takes effect a little later, which the process that closes waits for."""
        kernel, terminal = self.kernel, self.terminal
        terminal.terminals.watches.closed(terminal.name, self.writes)
        duration_ns = kernel.delays.randrange(*_CLOSING_NS)
        if kernel.faults.happens("slow_closing", terminal.device.name, 1e-2):
            draw = kernel.faults.drawn("slow_closing", terminal.device.name)
            duration_ns = round(10 ** draw.uniform(5, 8.5))
        self.released_ns = kernel.now_ns + duration_ns
        kernel.at(self.released_ns, lambda: terminal.left(self))


class SimulatedTty(Shim):
    """Module `tty`, whose functions use those of module `termios`."""

    def __init__(self, kernel: Kernel, system: System) -> None:
        super().__init__(tty, kernel)
        self._termios: Any = system.modules["termios"]

    def setraw(self, descriptor: int, when: int = termios.TCSAFLUSH) -> None:
        mode = self._termios.tcgetattr(descriptor)
        mode[0] &= ~(termios.BRKINT | termios.ICRNL | termios.INPCK | termios.ISTRIP | termios.IXON)
        mode[1] &= ~termios.OPOST
        mode[2] = (mode[2] & ~(termios.CSIZE | termios.PARENB)) | termios.CS8
        mode[3] &= ~(termios.ECHO | termios.ICANON | termios.IEXTEN | termios.ISIG)
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
        self._termios.tcsetattr(descriptor, when, mode)


def _link_of(file: OpenFile) -> tuple[str, str] | None:
    """Return what /proc shows of an open file, and the path of its device; None for other files."""
    if isinstance(file, HostSide) and not file.terminal.gone:
        return f"/dev/pts/{file.terminal.number}", file.terminal.name
    return ("/dev/ptmx", "/dev/null") if isinstance(file, MasterSide) else None


def _fresh() -> list[Any]:
    """Return the attributes of a new terminal of this machine."""
    sides = os.openpty()
    try:
        return termios.tcgetattr(sides[1])
    finally:
        for each in sides:
            os.close(each)


_FRESH = _fresh()
