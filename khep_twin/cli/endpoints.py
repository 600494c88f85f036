"""Endpoints (pseudo-terminals or network ports) that hosts open at `serve` and `shadow --relay`."""

import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.board.rom import ROMS
from khep_twin.cli.option_groups import LogOptions
from khep_twin.cli.options import notify, print_files, print_kept_log, usage
from khep_twin.errors import PortError
from khep_twin.process.machine import is_writable

if TYPE_CHECKING:
    from khep_twin.log.log_file import FileRecorder
    from khep_twin.ports.host_port import HostPort
    from khep_twin.ports.relay import LineListener
    from khep_twin.robots.model import RobotModel


ListenerMaker = Callable[[Callable[[], int]], "LineListener"]
"""Function of the line's clock [ns] that returns a listener, which receives the bytes on the line."""


@dataclass(frozen=True, slots=True)
class EndpointOptions:
    """Endpoints that hosts open.

    Attributes:
        link: Create this link to the pseudo-terminal, and print its path. A bare NAME is created in a private
            directory, $XDG_RUNTIME_DIR/khep_twin; ./NAME in the current directory.
        tcp: Serve TCP at HOST:PORT, for socket://HOST:PORT.
        rfc2217: Serve RFC 2217 at HOST:PORT, for rfc2217://HOST:PORT.
        allow_remote: Also let other machines connect to the network ports.
        ready_fd: Also write the printed paths to this descriptor, and close it.
    """

    link: Annotated[str | None, typer.Option(metavar="PATH")] = None
    tcp: str | None = None
    rfc2217: str | None = None
    allow_remote: bool = False
    ready_fd: int | None = None

    def open(self, bauds: Mapping[int, int]) -> AbstractContextManager[Sequence["HostPort"]]:
        """Open one serial cable per robot, by the baud rates of their lines."""
        from khep_twin.ports.endpoints import open_endpoints

        return open_endpoints(
            bauds, link=self.link, tcp=self.tcp, rfc2217=self.rfc2217, allow_remote=self.allow_remote
        )

    @contextmanager
    def announce(self, ports: Sequence["HostPort"], subject: str, speed: float) -> Generator[None]:
        """Register the service and its speed (`ServedPort`); print its paths, also to the file descriptor."""
        from khep_twin.ports.service_registry import registered_ports

        with ExitStack() as stack:
            try:
                stack.enter_context(registered_ports([port.path for port in ports], subject, speed))
            except PortError as error:
                notify(f"not listed by khep-twin ports: {error}")
            instruction = "hosts open the paths in the next lines"
            if self.link and not os.path.dirname(self.link):
                instruction += f", in a private directory (--link ./{self.link} is in this one)"
            notify(f"serving a {subject}; {instruction}; Ctrl-C ends it")
            paths = "".join(f"{port.path}\n" for port in ports)
            typer.echo(paths, nl=False)
            if (fd := self.ready_fd) is not None:
                try:
                    with os.fdopen(fd, "w") as file:
                        file.write(paths)
                except OSError as error:
                    raise usage(f"--ready-fd {fd}: cannot be written: {error.strerror}") from None
            yield

    def check(self) -> None:
        """Refuse a descriptor that is not open for writing."""
        fd = self.ready_fd
        if fd is None:
            return
        expected = "expected 3 or above, open for writing, such as --ready-fd 3 3>ready"
        if not 3 <= fd < 2**31:
            raise usage(f"--ready-fd {fd}: {expected}")
        try:
            # A descriptor that this process opened itself is not inheritable.
            is_open = os.get_inheritable(fd)
            writable = is_writable(fd)
        except OSError:
            is_open = writable = False
        if not (is_open and writable):
            raise usage(f"--ready-fd {fd}: is not open{' for writing' if is_open else ''}; {expected}")


def line_baud(mode: int | None) -> int:
    """Return the baud rate of a Khepera II's line in a running mode; that of mode 1 for None."""
    mode_number, rom = 1 if mode is None else mode, ROMS["khepera2"]
    if reason := rom.refusal_reason(mode_number):
        raise usage(f"--mode {mode_number:X}: {reason}")
    return rom.modes[mode_number].baud


def relay_robot(
    port: str,
    baud: int,
    endpoint: EndpointOptions,
    logging: LogOptions,
    make_listener: ListenerMaker | None = None,
    *,
    model: "RobotModel | None" = None,
    poll_requests: Sequence[bytes] = (),
    stop: Callable[[], bool],
) -> None:
    """Serve the robot at a port.

    Args:
        port: Robot's port.
        baud: Baud rate of its line, until a host sets another.
        endpoint: Endpoints that hosts open.
        logging: Log of the line.
        make_listener: Function that creates an additional listener on the line.
        model: Model of the robot, for the log; None for a Khepera.
        poll_requests: Requests that poll the robot while hosts are idle.
        stop: Function that returns whether to end.
    """
    from khep_twin.log.line_recorder import LineRecorder
    from khep_twin.ports.idle_polls import IdlePolls
    from khep_twin.ports.relay import Device, relay, start_wall_clock
    from khep_twin.ports.service_registry import served_speed

    with closing(Device(port, baud)) as device, endpoint.open({0: baud}) as ports, ExitStack() as stack:
        clock = start_wall_clock()
        listeners: list[LineListener] = []
        recorder = None
        if logging.log is not None:
            settings = {"relay": port, "baud": baud}
            recorder = LineRecorder(logging.log, settings, clock, model, on_failure=logging.on_failure)
            listeners.append(stack.enter_context(closing(recorder)))
        print_kept_log(recorder)
        if make_listener is not None:
            listeners.append(make_listener(clock))
        stack.enter_context(endpoint.announce(ports, f"robot at {port}", served_speed(port)))
        polls = IdlePolls(poll_requests) if poll_requests else None
        relay(device, ports[0], listeners, polls, stop=stop, notify=notify)
        duration_ns, dropped_bytes = clock(), ports[0].dropped
    print_end(duration_ns, dropped_bytes, logging, recorder)


def print_end(duration_ns: int, dropped: int, logging: LogOptions, recorder: "FileRecorder | None") -> None:
    """Print the time served [ns], bytes lost and the log's path; end the command if the log has failed."""
    typer.echo(f"{duration_ns / 1e9:.1f} s served", err=True)
    if dropped:
        typer.echo(f"{dropped} bytes dropped that no host took", err=True)
    logging.check(recorder)
    if logging.log is not None:
        print_files("log", [logging.log], err=True)
