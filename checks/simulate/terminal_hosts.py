"""Hosts on a terminal, by system calls: good ones, and those that a port must withstand."""

import fcntl
import os
import random
import termios
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from checks.simulate.kernel import NS_PER_S
from checks.simulate.raw_hosts import ORDERS, REPLY_TIMEOUT_S, half_line
from checks.simulate.simulation import Simulation
from checks.simulate.truth import Truth, tag
from khep_twin.errors import PortError, PortInUse
from khep_twin.host.discovery import found_ports, identify_robot

_COMPANIONS = 8
"""Most hosts that open a terminal at the moment of another one."""

_TURN_S = 0.1
"""Time within which a server that nothing holds up has seen who came and went [s]."""

_SETTINGS = termios.B300, termios.B38400, termios.B115200


class TerminalSite(Protocol):
    """Site of a terminal that hosts come to."""

    truth: Truth

    @property
    def url(self) -> str:
        """Path of the terminal."""
        ...

    def is_serving(self, truth: Truth) -> bool:
        """Return whether the server that this is the truth of runs, and is not about to stop."""
        ...

    def is_private(self) -> bool:
        """Return whether no other host can have got replies to the present one, nor it theirs."""
        ...

    def other_openings(self) -> tuple[int, bool]:
        """Return how often other hosts have opened it so far, and whether one has it open."""
        ...


@dataclass(slots=True)
class TerminalHost:
    """Host on a terminal.

    Args:
        simulation: Simulation.
        site: Site of the terminal.
        number: Number of its session.
        rng: Random generator of its actions.
    """

    simulation: Simulation
    site: TerminalSite
    number: int
    rng: random.Random

    @property
    def _os(self) -> Any:
        return self.simulation.system.modules["os"]

    def good(self) -> None:
        """Ask in bursts, and check each reply."""
        rng, truth, faults = self.rng, self.site.truth, self.simulation.faults
        for place in (f"terminals{number}" for number in range(_COMPANIONS)):
            if faults.happens("companion", place, 1.0):
                companion_rng = faults.drawn("companion", place)
                delay_ns = round(10 ** companion_rng.uniform(2, 5.3))
                stay = companion_rng.choice([0.0, 0.0001, 0.01, 1.0])
                self.simulation.spawn(f"companion{self.number}", partial(self._accompany, stay), delay_ns)
        try:
            descriptor = self._open()
        except OSError:  # no server just now
            return
        got, lines = b"", [tag(self.number)]
        try:
            for _ in range(rng.randint(1, 12)):
                lines += rng.choices(ORDERS, k=rng.randint(1, 5))
                self._write(descriptor, "".join(f"{line}\n" for line in lines).encode())
                # Of this burst: a robot that was switched off never answers earlier requests.
                got += self._replies(descriptor, len(lines), truth)
                lines = []
                self._compare(truth, got)
                self._pause(rng.choice([0.0, 0.05, 1.0, 10.0]))
            self._write(descriptor, b"D,0,0\n")
            self._pause(1.0)
            if half := half_line(self.simulation):
                self._write(descriptor, half)
        except OSError as error:
            if self.site.is_serving(truth):
                self.simulation.violate("answers", f"host {self.number} got {error!r} from a running server")
            return
        self._os.close(descriptor)

    def _replies(self, descriptor: int, count: int, truth: Truth) -> bytes:
        """Read so many lines."""
        kernel, select = self.simulation.kernel, self.simulation.system.modules["select"]
        end_ns, got = kernel.now_ns + round(REPLY_TIMEOUT_S * NS_PER_S), b""
        while got.count(b"\n") < count:
            left_s = (end_ns - kernel.now_ns) / NS_PER_S
            if left_s <= 0 or not select.select([descriptor], [], [], left_s)[0]:
                self._expect_silence(truth, got, count)
                self._expect_life(descriptor, truth)
                break
            try:
                data = self._os.read(descriptor, 256)
            except BlockingIOError:
                continue
            if not data:
                # With pyserial's VMIN of 0 another host has read it; a terminal without a server refuses.
                self.simulation.system.modules["fcntl"].ioctl(descriptor, termios.FIONREAD, bytes(4))
            got += data
        return got

    def _expect_silence(self, truth: Truth, got: bytes, count: int) -> None:
        """Check that there is a reason for a missing reply."""
        site = self.site
        if site.is_serving(truth) and site.is_private():
            n_got = got.count(b"\n")
            self.simulation.violate(
                "answers", f"host {self.number} has got {n_got} of {count} replies in {REPLY_TIMEOUT_S:.0f} s"
            )

    def _expect_life(self, descriptor: int, truth: Truth) -> None:
        """Check that the line answers this host again once it is alone, whoever was beside it."""
        site, select = self.site, self.simulation.system.modules["select"]
        before = site.other_openings()
        if before[1] or not site.is_serving(truth):
            return
        self._write(descriptor, b"\nB\n")
        is_readable = select.select([descriptor], [], [], REPLY_TIMEOUT_S)[0]
        if not is_readable and site.is_serving(truth) and site.other_openings() == before:
            self.simulation.violate("answers", f"the line is deaf to host {self.number}, alone there")
        self.simulation.count("lines asked again")

    def _accompany(self, stay: float) -> None:
        """Open the terminal at the moment of another host, as `stty` beside a shell does, and leave."""
        try:
            descriptor = self._os.open(self.site.url, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            self._pause(stay)
            self._os.close(descriptor)
        except OSError:
            pass  # without a server

    def _compare(self, truth: Truth, got: bytes) -> None:
        """Check that all that came are the replies to this host's lines, in order."""
        site = self.site
        if not site.is_serving(truth) or not site.is_private():
            self.simulation.count("exchanges shared")
            return
        expected = "".join(exchange.reply for exchange in truth.replies(self.number))
        received = got.decode("latin-1")
        self.simulation.count("replies", received.count("\n"))
        if expected != received:
            # A server reports mixed hosts in its next iteration.
            self._pause(_TURN_S)
            if site.is_private():
                self.simulation.violate(
                    "replies", f"host {self.number} got {received!r}; expected {expected!r}"
                )

    # Hosts that a port must withstand ------------------------------------------------------------------

    def rogue(self) -> None:
        """Perform one action that a port must withstand."""
        kinds: list[Callable[[int], None]] = [
            self._leaves_amid,
            self._leaves_unread,
            self._garbage,
            self._endless,
            self._never_reads,
            self._locks,
            self._sets,
            self._forks,
            self._second,
        ]
        try:
            if self.rng.random() < 0.2:
                self._storm()
                return
            if self.rng.random() < 0.2:
                self._asks_around()
                return
            descriptor = self._open()
            self.rng.choice(kinds)(descriptor)
            self._os.close(descriptor)
        except OSError:
            pass  # without a server, or without room

    def _leaves_amid(self, descriptor: int) -> None:
        self._write(descriptor, f"{tag(self.number)}\n".encode() + b"N\n" * self.rng.randint(0, 5) + b"D,7,")
        self._pause(self.rng.choice([0.0, 0.0001, 0.05]))

    def _leaves_unread(self, descriptor: int) -> None:
        self._write(descriptor, f"{tag(self.number)}\n".encode() + b"N\nH\n" * self.rng.randint(1, 10))
        self._pause(self.rng.choice([0.0, 0.001, 0.05, 1.0]))

    def _garbage(self, descriptor: int) -> None:
        for _ in range(self.rng.randint(1, 10)):
            self._write(descriptor, self.rng.randbytes(self.rng.randint(1, 200)))
            self._pause(self.rng.choice([0.0, 0.01, 0.2]))

    def _endless(self, descriptor: int) -> None:
        for _ in range(self.rng.randint(1, 20)):
            self._write(descriptor, b"N,1,2,3" * self.rng.randint(1, 300))
            self._pause(self.rng.choice([0.0, 0.1]))

    def _never_reads(self, descriptor: int) -> None:
        for _ in range(self.rng.randint(1, 20)):
            self._write(descriptor, b"N\nO\nK\nB\n" * 20)
            self._pause(0.5)

    def _locks(self, descriptor: int) -> None:
        self.simulation.system.modules["fcntl"].ioctl(descriptor, termios.TIOCEXCL)
        self._pause(self.rng.choice([0.0, 1.0]))

    def _sets(self, descriptor: int) -> None:
        shim = self.simulation.system.modules["termios"]
        settings = shim.tcgetattr(descriptor)
        settings[4] = settings[5] = self.rng.choice(_SETTINGS)
        settings[2] ^= termios.CSTOPB
        shim.tcsetattr(descriptor, termios.TCSANOW, settings)
        self._write(descriptor, b"N\n")
        self._pause(self.rng.choice([0.0, 0.002, 1.0]))

    def _forks(self, descriptor: int) -> None:
        """Leave a child that holds the terminal for a while."""
        process = self.simulation.kernel.current
        assert process is not None
        child = self.simulation.spawn(f"child{self.number}", lambda: self._pause(self.rng.uniform(0, 5)))
        child.opened(process.file(descriptor))

    def _second(self, descriptor: int) -> None:
        """Read beside another host."""
        self._pause(self.rng.uniform(0, 2))
        for _ in range(self.rng.randint(0, 20)):
            try:
                self._os.read(descriptor, 16)
            except BlockingIOError:
                self._pause(0.05)

    def _asks_around(self) -> None:
        """Look for robots as `khep-twin ports` does, and ask at the terminal who answers."""
        try:
            listed = [port.url for port in found_ports() if port.twin]
            identify_robot(listed[0] if listed else self.site.url)
        except (PortError, PortInUse) as error:
            if "\n" in str(error) or self.site.url not in str(error):
                self.simulation.violate("errors", f"a look for robots ended by {error!r}")
        self.simulation.count("looks for robots")

    def _storm(self) -> None:
        for _ in range(self.rng.randint(2, 40)):
            descriptor = self._open()
            if self.rng.random() < 0.3:
                self._write(descriptor, b"N\n" * self.rng.randint(1, 3))
            self._pause(self.rng.choice([0.0, 0.0, 0.0005, 0.02]))
            self._os.close(descriptor)

    # Calls ---------------------------------------------------------------------------------------------

    def _open(self) -> int:
        flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | (self.rng.random() < 0.5 and os.O_CLOEXEC)
        descriptor = self._os.open(self.site.url, flags)
        if self.rng.random() < 0.3:
            self.simulation.system.modules["fcntl"].flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return descriptor

    def _write(self, descriptor: int, data: bytes) -> None:
        """Write all, waiting for room for a while."""
        for _ in range(40):
            try:
                data = data[self._os.write(descriptor, data) :]
            except BlockingIOError:
                self._pause(0.05)
            if not data:
                return

    def _pause(self, duration: float) -> None:
        if duration:
            self.simulation.system.modules["time"].sleep(duration)
