"""Hosts on a bare socket: good ones, and those that a network port must withstand."""

import random
import re
import socket as real_socket
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from checks.simulate.faults import BURST, HALF
from checks.simulate.kernel import NS_PER_S
from checks.simulate.simulation import Simulation
from checks.simulate.truth import BROWSERS, REFUSED, Truth, tag

REPLY_TIMEOUT_S = 60.0
"""Time within which a reply comes, whatever stalls and delays there are [s]."""

ORDERS = ("N", "O", "H", "E", "B", "K", "I,1", "hello", "T,9,X", "R,3", "Q", "G,5,6", "D,3,4", "D,0,0")
"""Lines that a host without the library sends."""

_PASSING = frozenset({"stall", "accept"})
"""Kinds of faults that delay a host by less than its timeout."""

_BURST_LINES = 300
"""Lines of a burst: their answers are more than waits for a host that does not read."""

_TELNET = re.compile(rb"\xff\xfa.*?\xff\xf0|\xff[\xfb-\xfe].", re.DOTALL)
"""Negotiation of RFC 2217 amid a robot's bytes."""


def half_line(simulation: Simulation) -> bytes:
    """Return half a line with which a good host leaves, now and then."""
    return b"D,7," if simulation.faults.happens(HALF, "hosts", 1.0) else b""


@dataclass(slots=True)
class Raw:
    """Host on a bare socket.

    Args:
        simulation: Simulation.
        port: Port number.
        truth: Function that returns the exchanges on the line of the twin.
        number: Number of its session.
        rng: Random generator of its actions.
        is_exact: Function that returns whether all bytes of the robot reach the host unchanged.
        may_fail: Function that returns whether the line may currently fail.
    """

    simulation: Simulation
    port: int
    truth: Callable[[], Truth]
    number: int
    rng: random.Random
    is_exact: Callable[[], bool]
    may_fail: Callable[[], bool]

    def connect(self, timeout: float = 5.0) -> Any:
        """Return a connected socket."""
        socket = self.simulation.system.modules["socket"]
        return socket.create_connection(("127.0.0.1", self.port), timeout)

    # Good hosts ----------------------------------------------------------------------------------------

    def good(self) -> None:
        """Ask in bursts, and check each reply; leave by closing, or by finishing to send."""
        rng, truth, faults = self.rng, self.truth(), self.simulation.faults
        n_requests, got, has_finished, first_fault = 0, b"", False, len(faults.happened)
        try:
            with self.connect() as host:
                host.settimeout(REPLY_TIMEOUT_S)
                lines = [tag(self.number)]
                if faults.happens(BURST, "hosts", 1.0):
                    lines += ["N"] * _BURST_LINES
                for _ in range(rng.randint(1, 20)):
                    lines += rng.choices(ORDERS, k=rng.randint(1, 8))
                    host.sendall("".join(f"{line}\n" for line in lines).encode())
                    n_requests += len(lines)
                    lines = []
                    while (got_lines := _TELNET.sub(b"", got).count(b"\n")) < n_requests:
                        if not (data := host.recv(4096)):
                            if not self.may_fail():
                                text = f"raw host {self.number} was cut off after {got_lines} replies"
                                self.simulation.violate("answers", text)
                            return
                        got += data
                    self._compare(truth, got)
                    self._pause(rng.choice([0.0, 0.05, 1.0]))
                host.sendall(b"D,0,0\n" + half_line(self.simulation))
                if rng.random() < 0.3:
                    has_finished = True
                    host.shutdown(real_socket.SHUT_WR)
                    while host.recv(4096):
                        pass
        except TimeoutError:
            if truth is self.truth() and self.is_exact() and faults.disturbing(first_fault) <= _PASSING:
                kind = "leftovers" if has_finished else "answers"
                self.simulation.violate(kind, f"raw host {self.number} waited for {REPLY_TIMEOUT_S} s")
        except OSError as error:
            if not self.may_fail():
                self.simulation.violate("answers", f"raw host {self.number} on a sound line got {error!r}")

    def _compare(self, truth: Truth, got: bytes) -> None:
        """Check that all that came are the replies to this host's lines, in order."""
        if not self.is_exact() or truth is not self.truth():
            return
        expected = "".join(exchange.reply for exchange in truth.replies(self.number))
        received = _TELNET.sub(b"", got).decode("latin-1")
        self.simulation.count("replies", received.count("\n"))
        if expected != received:
            self.simulation.violate(
                "replies", f"raw host {self.number} got {received!r}; expected {expected!r}"
            )

    def _pause(self, duration: float) -> None:
        if duration:
            self.simulation.system.modules["time"].sleep(duration)

    # Hosts that a port must withstand ------------------------------------------------------------------

    def rogue(self, kind: Callable[[], None] | None = None) -> str:
        """Perform one action that a port must withstand, by default any; return its name."""
        kinds: Sequence[Callable[[], None]] = (
            self.second,
            self.storm,
            self.half,
            self.never_reads,
            self.vanishes,
            self.browser,
            self.garbage,
            self.leaves_amid,
            self.floods,
        )
        kind = kind or self.rng.choice(kinds)
        try:
            kind()
        except OSError:
            pass  # a host that is refused or cut off may find it at any call
        return kind.__name__

    def second(self) -> None:
        """Connect beside another host; nothing that is sent reaches the robot if the host is refused."""
        truth, session = self.truth(), REFUSED * 256 + self.number % 256
        got = b""
        try:
            with self.connect() as host:
                host.settimeout(REPLY_TIMEOUT_S)
                host.sendall(f"{tag(session)}\n".encode())
                got = host.recv(4096)
                while got and not _TELNET.sub(b"", got) and (data := host.recv(4096)):
                    got += data
        except ConnectionError:
            pass
        refused = not _TELNET.sub(b"", got)
        if refused and self.is_exact() and truth is self.truth() and session in truth.tags:
            self.simulation.violate("replies", "bytes of a host that was refused were carried out")

    def storm(self) -> None:
        """Connect and leave immediately, many times."""
        for _ in range(self.rng.randint(2, 30)):
            with self.connect(1.0) as host:
                if self.rng.random() < 0.5:
                    host.send(b"N\n" * self.rng.randint(1, 3))

    def half(self) -> None:
        """Finish sending, and read to the end, which must come."""
        count = self.rng.randint(1, 30)
        truth, got = self.truth(), b""
        with self.connect() as host:
            host.settimeout(REPLY_TIMEOUT_S)
            host.sendall(f"{tag(self.number)}\n".encode() + b"B\n" * count)
            host.shutdown(real_socket.SHUT_WR)
            try:
                while data := host.recv(4096):
                    got += data
                    self._compare_beginning(truth, got)
            except TimeoutError:
                if truth is self.truth():
                    self.simulation.violate("leftovers", "a host that has finished was never let go")

    def _compare_beginning(self, truth: Truth, got: bytes) -> None:
        if self.is_exact() and truth is self.truth():
            expected = "".join(exchange.reply for exchange in truth.replies(self.number))
            received = _TELNET.sub(b"", got).decode("latin-1")
            if not received.startswith("\xff") and not expected.startswith(received):
                self.simulation.violate(
                    "replies", f"raw host {self.number} got {received!r}; expected {expected!r}"
                )

    def never_reads(self) -> None:
        """Ask without ever reading, then leave."""
        with self.connect() as host:
            host.setblocking(False)
            for _ in range(self.rng.randint(1, 60)):
                try:
                    host.send(b"N\nO\nK\nB\n" * 20)
                except BlockingIOError:
                    pass
                self._pause(0.5)

    def vanishes(self) -> None:
        """Be let in, send, and lose the cable for a while or for ever."""
        for _ in range(20):
            with self.connect() as host:
                host.settimeout(2.0)
                host.sendall(f"{tag(self.number)}\n".encode())
                if host.recv(4096):
                    self._lose_cable(host)
                    return
            self._pause(0.5)

    def _lose_cable(self, host: Any) -> None:
        host.sendall(b"D,2,2\nN\n")
        self._pause(self.rng.choice([0.0, 0.02, 0.02, 1.0]))  # in 0.02 s the reply is on its way
        duration_ns = self.rng.choice([None, NS_PER_S // 10, 2 * NS_PER_S, 40 * NS_PER_S])
        self.simulation.network.cut(host._tcp, duration_ns)
        self._pause(self.rng.choice([0.1, 5.0]))
        host.send(b"N\n")
        self._pause(self.rng.choice([1.0, 60.0]))

    def browser(self) -> None:
        """Send a request of HTTP, with commands in it."""
        begin = self.rng.choice([b"GET / HTTP/1.1\r\n", b"POST /W HTTP/1.1\r\n", b"\x16\x03\x01\x02\x00\x01"])
        body = begin + f"Host: x\r\n\r\nW,{self.number % 256},{BROWSERS}\nD,9,9\n".encode()
        with self.connect() as host:
            while body:
                size = self.rng.randint(1, len(body))
                host.sendall(body[:size])
                body = body[size:]
                self._pause(self.rng.choice([0.0, 0.01]))
            host.settimeout(5.0)
            host.recv(4096)

    def garbage(self) -> None:
        """Send random bytes and broken negotiation."""
        begin, end = b"\xff\xfa", b"\xff\xf0"
        pieces = [begin + b",\x01\x00\x00\x25\x80" + end, begin + b",\x01\x00" + end, end, b"\xff\xfb,"]
        pieces += [begin + b"x" * 300, begin + b",\x03\x09" + end, begin + b",\x02\x04" + end, b"\n"]
        pieces += [begin + b",\x01\x00\x00\x00\x01" + end, begin + b",\x05\x63" + end]
        pieces.append(self.rng.randbytes(40))
        with self.connect() as host:
            for _ in range(self.rng.randint(1, 20)):
                host.sendall(self.rng.choice(pieces))
                self._pause(self.rng.choice([0.0, 0.01, 0.2]))
            host.settimeout(2.0)
            host.recv(4096)

    def leaves_amid(self) -> None:
        """Leave amid a line, by a close or a reset."""
        with self.connect() as host:
            host.sendall(f"{tag(self.number)}\n".encode() + b"N\n" * self.rng.randint(0, 5) + b"D,7,")
            if self.rng.random() < 0.5:
                host.setsockopt(real_socket.SOL_SOCKET, real_socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._pause(self.rng.choice([0.0, 0.05]))

    def floods(self) -> None:
        """Send more than the port takes, so that its leaving cannot be seen; then leave."""
        with self.connect() as host:
            host.settimeout(1.0)
            try:
                host.sendall(b"N\n" * self.rng.choice([1000, 9000, 60_000]))
            except TimeoutError:
                pass
            self._pause(self.rng.choice([0.0, 2.0]))
