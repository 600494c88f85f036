"""Simulated pseudo-terminals with the semantics of Linux, in raw mode.

Written bytes are in transit for a while, in which a flush of the writer's side removes them; a reader that
finds no other bytes takes them immediately. A closing is reported by inotify first, and takes effect later.
The last closing of the host side hangs the master up until the next opening. Numbers are reused immediately.
There are no echo and no lines: khep_twin makes its terminals raw before it names them.
"""

# The functions of open files are the system's, which documents them.
# ruff: noqa: D102

import errno
import fcntl
import os
import shutil
import struct
import termios
import tty
from collections import defaultdict
from collections.abc import Generator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

from checks.simulate.inotify import IN_CLOSE_NOWRITE, IN_CLOSE_WRITE, IN_MODIFY, IN_OPEN, Notices
from checks.simulate.kernel import OpenFile, Process
from checks.simulate.simulation import Simulation
from checks.simulate.system import Shim
from khep_twin.ports import event_sources, port_users, pty

CAPACITY = 16512
"""Bytes that one direction takes before it is full, as measured with small writes [bytes]."""

READY = 4095
"""Bytes of them that are ready for the reader immediately; the rest stays in transit, as measured [bytes]."""

_TRANSIT_NS = 200, 60_000
"""Shortest and longest usual time of written bytes in transit [ns] (assumed)."""

_CLOSING_NS = 200, 40_000
"""Shortest and longest usual time from the report of a closing to its effect [ns] (assumed)."""

MOST_SLOW = 1e-3
"""Highest probability that a transit or a closing takes up to 20 ms."""

_TIOCGEXCL = getattr(termios, "TIOCGEXCL", 0x80045440)

_SPEED = termios.B38400


class Way:
    """Bytes from one side of a terminal to the other.

    Attributes:
        ready: Bytes that can be read.
        transit: Bytes that are on their way.
        stopped: True while its writer's side has stopped its output.
    """

    def __init__(self) -> None:
        self.ready, self.transit = bytearray(), bytearray()
        self.stopped = False

    @property
    def room(self) -> int:
        """Number of bytes that can be written."""
        return 0 if self.stopped else CAPACITY - len(self.ready) - len(self.transit)

    def arrive(self) -> None:
        """End the transit of as many bytes as there is room for."""
        n_moved = READY - len(self.ready)
        self.ready += self.transit[:n_moved]
        del self.transit[:n_moved]

    def discard(self) -> None:
        """Discard everything."""
        self.ready.clear()
        self.transit.clear()

    def read(self, limit: int) -> bytes:
        """Take the bytes that are ready, or those in transit if there are none."""
        if not self.ready:
            self.arrive()
        data = bytes(self.ready[:limit])
        del self.ready[:limit]
        return data

    def __bool__(self) -> bool:
        return bool(self.ready or self.transit)


class Terminal:
    """A pseudo-terminal.

    Attributes:
        number: Number of it.
        path: Path of its host side.
        to_host: Bytes to the host side.
        to_master: Bytes to the master.
        settings: Settings, in the form of `termios.tcgetattr`.
        hosts: Open files of the host side whose closing has not taken effect.
        openings: Processes that have opened the host side, in order.
        met: Processes that had it open at the same time as each process.
        exclusive: True if it is locked by TIOCEXCL.
        locked_by: Open file that has it locked by flock; None without.
    """

    def __init__(self, terminals: "Terminals", number: int) -> None:
        self.terminals, self.kernel, self.number = terminals, terminals.kernel, number
        self.path = terminals.folder / str(number)
        self.to_host, self.to_master = Way(), Way()
        control = termios.CS8 | termios.CREAD
        characters: list[bytes | int] = [b"\0"] * 32
        self.settings: list[Any] = [0, 0, control, 0, _SPEED, _SPEED, characters]
        self.hosts: list[HostSide] = []
        self.openings: list[Process] = []
        self.met = defaultdict[Process, set[Process]](set)
        self.exclusive = False
        self.locked_by: HostSide | None = None
        self.master = Master(self)

    def open(self, process: Process, flags: int) -> OpenFile:
        """Open the host side."""
        if self.exclusive:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        file = HostSide(self, process.leader, writes=bool(flags & (os.O_WRONLY | os.O_RDWR)))
        for host in self.hosts:
            self.met[host.process].add(process.leader)
            self.met[process.leader].add(host.process)
        self.hosts.append(file)
        self.openings.append(process.leader)
        self.report(IN_OPEN)
        return file

    def report(self, kind: int) -> None:
        """Report an event of a host."""
        self.terminals.notices.report(str(self.path), kind)

    def send(self, way: Way, data: bytes, reader: "Master | None") -> int:
        """Write bytes of one side; return the number that found room."""
        if not way.room:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        sent = data[: way.room]
        way.transit += sent
        self.push(way, reader)
        return len(sent)

    def push(self, way: Way, reader: "Master | None") -> None:
        """Let bytes in transit arrive after a delay."""

        def arrive() -> None:
            way.arrive()
            for side in self.hosts if reader is None else [reader]:
                side.changed()

        self.kernel.at(self.kernel.now_ns + self.terminals.delay_ns("transit", _TRANSIT_NS), arrive)

    def ioctl(self, request: int, argument: Any) -> Any:
        """Answer a request to the host side."""
        if request == termios.TIOCOUTQ:
            return struct.pack("i", 0)
        if request in (termios.TIOCEXCL, termios.TIOCNXCL):
            self.exclusive = request == termios.TIOCEXCL
            return 0
        if request == _TIOCGEXCL:
            return struct.pack("i", self.exclusive)
        raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))

    def tcgetattr(self) -> list[Any]:
        """Return a copy of the settings."""
        return [*self.settings[:6], [*self.settings[6]]]

    def tcsetattr(self, settings: list[Any]) -> None:
        """Set the settings immediately; the driver has eight bits without parity alone."""
        control = (settings[2] & ~(termios.CSIZE | termios.PARENB)) | termios.CS8 | termios.CREAD
        self.settings = [*settings[:2], control, *settings[3:6], [*settings[6]]]


class _Side(OpenFile):
    """Either side of a terminal."""

    def __init__(self, terminal: Terminal, incoming: Way, outgoing: Way) -> None:
        super().__init__(terminal.kernel)
        self.terminal, self.incoming, self.outgoing = terminal, incoming, outgoing

    def tcgetattr(self) -> list[Any]:
        """Return the settings."""
        return self.terminal.tcgetattr()

    def tcsetattr(self, when: int, settings: list[Any]) -> None:
        """Set the settings."""
        self.terminal.tcsetattr(settings)
        if when == termios.TCSAFLUSH:  # that of the host side, as the settings are its, on either side
            self.terminal.to_host.ready.clear()
            self.terminal.push(self.terminal.to_host, None)

    def tcflow(self, action: int) -> None:
        """Stop the output of this side, or start it again; that stays when the side is closed."""
        assert action in (termios.TCOOFF, termios.TCOON), "only output is simulated"
        self.outgoing.stopped = action == termios.TCOOFF
        self.changed()

    def tcflush(self, queue: int) -> None:
        """Discard all received bytes, or those in transit that this side has written, as Linux does."""
        if queue in (termios.TCIFLUSH, termios.TCIOFLUSH):
            self.incoming.discard()
        if queue in (termios.TCOFLUSH, termios.TCIOFLUSH):
            self.outgoing.transit.clear()

    def tcdrain(self) -> None:
        """Return immediately, as terminals without a wire do."""

    def tcsendbreak(self, _: int) -> None:
        """Do nothing: the other side cannot see it."""

    def ioctl(self, request: int, argument: Any) -> Any:
        """Answer a request."""
        if request == termios.FIONREAD:
            return struct.pack("i", len(self.incoming.ready))
        return self.terminal.ioctl(request, argument)


class Master(_Side):
    """Side of the terminal that belongs to the program that made it."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__(terminal, terminal.to_master, terminal.to_host)

    def readable(self) -> bool:
        return bool(self.terminal.to_master)

    def writable(self) -> bool:
        return self.terminal.to_host.room > 0

    def hung_up(self) -> bool:
        return not self.terminal.hosts

    def read(self, limit: int) -> bytes:
        terminal = self.terminal
        if data := terminal.to_master.read(limit):
            if terminal.to_master.transit:
                terminal.push(terminal.to_master, self)
            for host in terminal.hosts:
                host.changed()
            return data
        if not terminal.hosts:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    def write(self, data: bytes) -> int:
        return self.terminal.send(self.terminal.to_host, data, None)

    def closed(self) -> None:
        self.terminal.terminals.remove(self.terminal)
        for host in self.terminal.hosts:
            host.changed()


class HostSide(_Side):
    """One open file of the host side.

    Attributes:
        process: Process that has opened it.
    """

    def __init__(self, terminal: Terminal, process: Process, writes: bool) -> None:
        super().__init__(terminal, terminal.to_host, terminal.to_master)
        self.process = process
        self._writes = writes

    @property
    def _is_dead(self) -> bool:
        return self.terminal.master.references == 0

    def readable(self) -> bool:
        return bool(self.terminal.to_host) or self._is_dead

    def writable(self) -> bool:
        return self.terminal.to_master.room > 0 or self._is_dead

    def hung_up(self) -> bool:
        return self._is_dead

    def read(self, limit: int) -> bytes:
        if self._is_dead:
            return b""
        if data := self.terminal.to_host.read(limit):
            if self.terminal.to_host.transit:
                self.terminal.push(self.terminal.to_host, None)
            self.terminal.master.changed()
            return data
        if self.terminal.settings[6][termios.VMIN] in (0, b"\0"):
            return b""
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    def write(self, data: bytes) -> int:
        self._check()
        sent = self.terminal.send(self.terminal.to_master, data, self.terminal.master)
        self.terminal.report(IN_MODIFY)
        return sent

    def ioctl(self, request: int, argument: Any) -> Any:
        self._check()
        return super().ioctl(request, argument)

    def tcgetattr(self) -> list[Any]:
        self._check()
        return super().tcgetattr()

    def tcsetattr(self, when: int, settings: list[Any]) -> None:
        self._check()
        super().tcsetattr(when, settings)

    def tcflush(self, queue: int) -> None:
        self._check()
        super().tcflush(queue)

    def tcflow(self, action: int) -> None:
        self._check()
        super().tcflow(action)

    def flock(self, operation: int) -> None:
        """Lock the device for this open file, or unlock it."""
        terminal = self.terminal
        if operation & fcntl.LOCK_UN:
            terminal.locked_by = None if terminal.locked_by is self else terminal.locked_by
        elif terminal.locked_by not in (None, self):
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        else:
            terminal.locked_by = self

    def closed(self) -> None:
        """Report the closing; it takes effect later, and for the closing process before it continues."""
        terminal, kernel = self.terminal, self.kernel
        if terminal.locked_by is self:
            terminal.locked_by = None
        terminal.report(IN_CLOSE_WRITE if self._writes else IN_CLOSE_NOWRITE)
        delay_ns = terminal.terminals.delay_ns("closing", _CLOSING_NS)
        kernel.at(kernel.now_ns + delay_ns, self._detach)
        process = kernel.current
        if process is not None and process.alive and not process.dying:
            kernel.elapse(delay_ns + 1)

    def _detach(self) -> None:
        self.terminal.hosts.remove(self)
        if not self.terminal.hosts:
            self.terminal.master.changed()

    def _check(self) -> None:
        if self._is_dead:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


class Terminals:
    """Pseudo-terminals of a simulation.

    Attributes:
        kernel: Kernel.
        root: Folder in place of the machine's root.
        folder: Folder of their host sides, in place of /dev/pts.
        notices: Reports of inotify.
        processes: Folder in place of /proc, in the state of the last `list_processes`.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.kernel = simulation.kernel
        self.root = str(simulation.folder)
        self.folder = simulation.folder / "dev" / "pts"
        os.makedirs(self.folder)
        self.processes = simulation.folder / "proc"
        self._devices = simulation.system.devices
        self._rng = simulation.rng("terminals")
        self._open: dict[int, Terminal] = {}
        self.notices = Notices(simulation.kernel)
        simulation.system.os.terminals = self

    @contextmanager
    def installed(self) -> Generator[None]:
        """Have khep_twin see these terminals, and the descriptors of the processes."""
        with (
            patch.object(port_users, "_PROCESSES", _ProcessFolder(self)),
            patch.object(port_users, "_LOCKS", self.folder),
            patch.object(event_sources, "ctypes", self.notices),
            patch.object(pty, "tty", _Tty(tty, self.kernel)),
        ):
            yield

    def make(self) -> tuple[int, int]:
        """Make a terminal; return the descriptors of its two sides."""
        process = self.kernel.called()
        number = next(candidate for candidate in count() if candidate not in self._open)
        self._open[number] = terminal = Terminal(self, number)
        os.close(os.open(terminal.path, os.O_CREAT | os.O_EXCL))
        self._devices[str(terminal.path)] = terminal
        return process.opened(terminal.master), process.opened(terminal.open(process, os.O_RDWR))

    def number_of(self, path: str) -> int | None:
        """Return the number of the terminal at a path; None for another file."""
        device = self._devices.get(path)
        return device.number if isinstance(device, Terminal) else None

    def remove(self, terminal: Terminal) -> None:
        """Remove a terminal whose master is closed; its number is free again."""
        del self._open[terminal.number], self._devices[str(terminal.path)]
        os.unlink(terminal.path)

    def delay_ns(self, kind: str, usual_ns: tuple[int, int]) -> int:
        """Draw how long a transit or a closing takes [ns]."""
        faults = self.kernel.faults
        if faults.happens(f"slow {kind}", "terminals", MOST_SLOW):
            return faults.drawn(f"slow {kind}", "terminals").randrange(usual_ns[1], 20_000_000)
        return self._rng.randrange(*usual_ns)

    def list_processes(self) -> Path:
        """Write the folder /proc, with the terminals that processes have open; return it."""
        shutil.rmtree(self.processes, ignore_errors=True)
        os.makedirs(self.processes)
        for process in self.kernel.processes:
            if process.alive and process.leader is process:
                self._write_process(process, self.processes / str(process.pid))
        return self.processes

    def _write_process(self, process: Process, folder: Path) -> None:
        """Write the folder of a process: its descriptors of terminals and its name; none controls it."""
        links, about = folder / "fd", folder / "fdinfo"
        os.makedirs(links)
        os.makedirs(about)
        for name, text in {"comm": process.name, "stat": f"{process.pid} ({process.name}) S 1 1 1 0"}.items():
            (folder / name).write_text(text, encoding="ascii")
        for number, file in process.files.items():
            if isinstance(file, HostSide):
                os.symlink(file.terminal.path, links / str(number))
            elif isinstance(file, Master):
                os.symlink(f"{self.root}/dev/ptmx", links / str(number))
                text = f"pos:\t0\ntty-index:\t{file.terminal.number}\n"
                (about / str(number)).write_text(text, encoding="ascii")


class _Tty(Shim):
    """Module `tty`."""

    def setraw(self, descriptor: int, when: int = termios.TCSAFLUSH) -> None:
        """Make a terminal raw: of the settings, only reads of a byte or more matter here."""
        terminal = self.kernel.called().file(descriptor)
        assert isinstance(terminal, _Side)
        settings = terminal.tcgetattr()
        settings[0] = settings[1] = settings[3] = 0
        settings[6][termios.VMIN], settings[6][termios.VTIME] = 1, 0
        terminal.tcsetattr(when, settings)


class _ProcessFolder:
    """Folder /proc, which shows the processes at the time of each look."""

    def __init__(self, terminals: Terminals) -> None:
        self._terminals = terminals

    def __truediv__(self, name: str) -> Path:
        return self._terminals.processes / name

    def glob(self, pattern: str) -> list[Path]:
        """Return the folders of the processes; a look takes milliseconds."""
        kernel = self._terminals.kernel
        kernel.called()
        kernel.elapse(2_000_000)
        return sorted(self._terminals.list_processes().glob(pattern))
