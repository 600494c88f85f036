"""Module `socket` on simulated sockets; `create_server` and `create_connection` are Python's."""

# The functions are Python's, which documents them.
# ruff: noqa: D102

import errno
import os
import socket
from collections.abc import Callable, Mapping
from types import FunctionType, TracebackType
from typing import Any, Self

from checks.simulate.kernel import NS_PER_S, Kernel, Process
from checks.simulate.sockets import Network, TcpFile
from checks.simulate.system import Shim

_LOOPBACK: Mapping[str, tuple[tuple[int, str], ...]] = {
    "localhost": ((socket.AF_INET6, "::1"), (socket.AF_INET, "127.0.0.1")),
    "127.0.0.1": ((socket.AF_INET, "127.0.0.1"),),
    "0.0.0.0": ((socket.AF_INET, "0.0.0.0"),),
    "::1": ((socket.AF_INET6, "::1"),),
    "::": ((socket.AF_INET6, "::"),),
}
"""Addresses of this machine by its names, in the order of Linux."""

_MOST_REFUSED = 0.05
"""Highest probability that a connection cannot be accepted."""


class SimulatedSocketModule(Shim):
    """Module `socket`."""

    def __init__(self, kernel: Kernel, network: Network) -> None:
        super().__init__(socket, kernel)
        self.network = network

        def make(
            family: int = socket.AF_INET,
            kind: int = socket.SOCK_STREAM,
            protocol: int = 0,
            fileno: int | None = None,
        ) -> "Socket":
            assert kind == socket.SOCK_STREAM, "only TCP is simulated"
            process = kernel.called()
            file = TcpFile(network, process.name)
            file.address = "::1" if family == socket.AF_INET6 else "127.0.0.1"
            return Socket(network, process, file, family)

        self.socket = make
        names = {**vars(socket), "socket": make, "getaddrinfo": self.getaddrinfo}
        self.create_server = self._on_these(socket.create_server, names)
        self.create_connection = self._on_these(socket.create_connection, names)

    @staticmethod
    def _on_these(function: Any, names: dict[str, Any]) -> Callable[..., "Socket"]:
        """Return a function of Python's with other names in its module."""
        function_copy = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
        function_copy.__kwdefaults__ = function.__kwdefaults__
        return function_copy

    def getaddrinfo(
        self, host: str | None, port: int, family: int = 0, type: int = 0, proto: int = 0, flags: int = 0
    ) -> list[tuple[int, int, int, str, tuple[Any, ...]]]:
        if not 0 <= port < 65536:
            raise OverflowError("getaddrinfo: port must be 0-65535.")
        if (addresses := _LOOPBACK.get(host or "127.0.0.1")) is None:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [
            (
                of,
                socket.SOCK_STREAM,
                socket.IPPROTO_TCP,
                "",
                (address, port, 0, 0)[: 4 if of == socket.AF_INET6 else 2],
            )
            for of, address in addresses
            if family in (0, of)
        ]


class Socket:
    """Object of `socket.socket`."""

    def __init__(self, network: Network, process: Process, file: TcpFile, family: int) -> None:
        self.family, self.type, self.proto = family, socket.SOCK_STREAM, 0
        self._network, self._kernel, self._process, self._tcp = network, network.kernel, process, file
        self._timeout: float | None = None
        self._number = process.opened(file)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        # As Python's; amid any code, so that no time passes.
        process, number = self._process, getattr(self, "_number", -1)
        if process.alive and process.files.get(number) is self._tcp:
            process.close(number)

    def fileno(self) -> int:
        return self._number

    def close(self) -> None:
        if self._number >= 0:
            process = self._kernel.called()
            number, self._number = self._number, -1
            process.close(number)

    def detach(self) -> int:
        number, self._number = self._number, -1
        return number

    # Options -------------------------------------------------------------------------------------------

    def setblocking(self, blocking: bool) -> None:
        self.settimeout(None if blocking else 0.0)

    def settimeout(self, timeout: float | None) -> None:
        self._timeout = timeout
        self._tcp.blocking = timeout is None

    def gettimeout(self) -> float | None:
        return self._timeout

    def setsockopt(self, level: int, option: int, value: int | bytes) -> None:
        self._file().options[level, option] = value

    def getsockopt(self, level: int, option: int, size: int = 0) -> int | bytes:
        file = self._file()
        if (level, option) == (socket.SOL_SOCKET, socket.SO_ERROR):
            return file.take_error()
        if (level, option) == (socket.IPPROTO_TCP, socket.TCP_INFO):
            # The third byte of Linux's struct tcp_info has the retransmissions.
            return bytes((1, 0, file.way.retransmissions))[:size].ljust(size, b"\0")
        return file.options.get((level, option), 0)

    def getsockname(self) -> tuple[Any, ...]:
        return self._named(self._file())

    def getpeername(self) -> tuple[Any, ...]:
        file = self._file()
        if file.peer is None or file.is_gone:
            raise OSError(errno.ENOTCONN, os.strerror(errno.ENOTCONN))
        return self._named(file.peer)

    def _named(self, file: TcpFile) -> tuple[Any, ...]:
        return (file.address, file.port, 0, 0)[: 4 if self.family == socket.AF_INET6 else 2]

    # Connections ---------------------------------------------------------------------------------------

    def bind(self, address: tuple[Any, ...]) -> None:
        file = self._file()
        host, number = address[:2]
        if number and number in self._network.listeners:
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        file.address, file.port = host, number or self._network.free_port()

    def listen(self, backlog: int = 128) -> None:
        file = self._file()
        file.port = file.port or self._network.free_port()
        if self._network.listeners.setdefault(file.port, file) is not file:
            raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        file.backlog = backlog

    def accept(self) -> tuple["Socket", tuple[Any, ...]]:
        process, file = self._kernel.called(), self._file()
        self._wait(file.readable, file)
        if not file.queue:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        faults = self._network.faults
        if faults.happens("accept", process.name, _MOST_REFUSED):
            number = faults.drawn("accept", process.name).choice([errno.ECONNABORTED, errno.EMFILE])
            if number == errno.ECONNABORTED:
                file.queue.pop(0).closed_with_reset()
            raise OSError(number, os.strerror(number))
        end = file.queue.pop(0)
        accepted = Socket(self._network, process, end, self.family)
        assert end.peer is not None
        return accepted, accepted._named(end.peer)

    def connect(self, address: tuple[Any, ...]) -> None:
        self._kernel.called()
        file = self._file()
        if not file.is_connecting:
            if file.peer is not None:
                raise OSError(errno.EISCONN, os.strerror(errno.EISCONN))
            file.address = "127.0.0.1"
            listener = self._network.listeners.get(address[1])
            listener_address = "" if listener is None else listener.address
            same = listener_address in (address[0], "0.0.0.0", "::", "localhost")
            file.connect(address[1] if same else 0)
        if self._timeout == 0:
            raise BlockingIOError(errno.EINPROGRESS, os.strerror(errno.EINPROGRESS))
        self._wait(lambda: not file.is_connecting, file)
        file.raise_error()

    def connect_ex(self, address: tuple[Any, ...]) -> int:
        try:
            self.connect(address)
        except TimeoutError:
            return errno.EAGAIN
        except OSError as error:
            return error.errno or 0
        return 0

    def shutdown(self, how: int) -> None:
        self._kernel.called()
        self._file().shut(how)

    # Bytes ---------------------------------------------------------------------------------------------

    def recv(self, limit: int, flags: int = 0) -> bytes:
        self._kernel.called()
        file = self._file()
        self._wait(file.readable, file)
        if flags & socket.MSG_PEEK and file.incoming:
            return bytes(file.incoming[:limit])
        return file.read(limit)

    def send(self, data: Any, flags: int = 0) -> int:
        self._kernel.called()
        file = self._file()
        self._wait(file.writable, file)
        return file.write(bytes(data))

    def sendall(self, data: Any, flags: int = 0) -> None:
        rest, kernel = bytes(data), self._kernel
        end_ns = self._deadline_ns()
        while rest:
            kernel.called()
            file = self._file()
            self._wait(file.writable, file, end_ns)
            rest = rest[file.write(rest) :]

    def _file(self) -> TcpFile:
        if self._number < 0:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return self._tcp

    def _deadline_ns(self) -> int | None:
        return None if self._timeout is None else self._kernel.now_ns + round(self._timeout * NS_PER_S)

    def _wait(self, ready: Callable[[], bool], file: TcpFile, end_ns: int | None = None) -> None:
        if self._timeout != 0:
            deadline_ns = self._deadline_ns() if end_ns is None else end_ns
            if not self._kernel.wait([file], ready, deadline_ns):
                raise TimeoutError("timed out")
