"""khep://PLAYPEN: a twin in the host's process, opened as a port of pyserial, in lock-step.

    khep://default?seed=1&robot=0&noise=off&rom=5.02&mode=1&log=run.mcap
    khep://default?battery_used_min=40
    khep://run.mcap?at=12.5&seed=2

The last URL resumes the run of a log at a time, or at its end, and replaces its host.
Time passes only while the host waits: in a read until its bytes have arrived or its timeout has passed, in a
flush until all bytes are sent, in `sleep`. A poll without result (`in_waiting`, a read with timeout 0) takes
one byte time, so that polling loops make progress. There is no thread and no wall clock: the same seed and
the same bytes give the same run.
"""

# pyserial is not typed.
# pyright: reportUnknownMemberType=false, reportAttributeAccessIssue=false

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import RLock
from typing import Any, Self
from urllib.parse import parse_qsl, unquote, urlsplit

from serial import PortNotOpenError, SerialException, SerialTimeoutException
from serial.serialutil import SerialBase

from khep_twin.board.uart import LineSettings
from khep_twin.clock import to_ns
from khep_twin.errors import KhepTwinError, PortError, choices
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.process.one_thread import one_thread

_POLL_NS = 1_000_000
"""Duration of a poll on a line without delay [ns]."""


class TwinPortError(PortError, SerialException):
    """A khep:// port cannot be opened; also a `SerialException` for users of pyserial."""


class Serial(SerialBase):
    """A twin as a port of pyserial, for one thread at a time, as two would receive each other's replies.

    Attributes:
        twin: Twin behind the port, with its world, robot and log, for ground truth.
        guard: Lock of its methods.
    """

    twin: Twin
    cts = dsr = cd = True
    ri = False
    _port: str | None
    _timeout: float | None
    _write_timeout: float | None
    _baudrate: int
    _stopbits: float

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.guard = RLock()
        super().__init__(*arguments, **options)

    @classmethod
    def of(cls, twin: Twin, timeout: float | None = None) -> Self:
        """Return a port to an open twin."""
        port = cls(baudrate=twin.robot.firmware.baud, timeout=timeout)
        port.port = f"khep://{twin.world.playpen.name}"
        port._connect(twin)
        return port

    def open(self) -> None:
        """Open the twin that the URL describes.

        Raises:
            TwinPortError: The URL, the playpen or the log cannot be used.
        """
        if self._port is None:
            raise TwinPortError("a port needs a URL before it can be opened, such as khep://default")
        if self.is_open:
            raise TwinPortError(f"{self._port} is open already")
        try:
            self._connect(open_url(self._port))
        except KhepTwinError as error:
            raise TwinPortError(str(error)) from None

    def _connect(self, twin: Twin) -> None:
        self.twin = twin
        self._uart = twin.robot.uart
        self.is_open = True
        self._reconfigure_port()

    def close(self) -> None:
        """Close the twin and complete its log."""
        if self.is_open:
            self.is_open = False
            self.twin.close()

    @one_thread
    def sleep(self, duration: float) -> None:
        """Let simulated time pass [s]."""
        self._check_open()
        self.twin.advance_to(self.time_ns + to_ns(duration))

    @property
    def robot_model(self) -> str:
        """Name of the robot's model."""
        return self.twin.world.playpen.robots[self.twin.robot.index].model

    @property
    def robot_baudrate(self) -> int:
        """Baud rate of the robot's line."""
        return self.twin.robot.firmware.baud

    @property
    def time_ns(self) -> int:
        """Simulated time since the port was opened [ns]."""
        return self.twin.world.time_ns

    @property
    @one_thread
    def in_waiting(self) -> int:
        """Number of bytes that have arrived; a poll of an empty line takes one byte time."""
        self._check_open()
        if not self._uart.tx.count_arrived(self.time_ns):
            self._poll()
        return self._uart.tx.count_arrived(self.time_ns)

    @property
    def out_waiting(self) -> int:
        """Number of written bytes that have not reached the robot."""
        self._check_open()
        return len(self._uart.rx) - self._uart.rx.count_arrived(self.time_ns)

    def read(self, size: int = 1) -> bytes:
        """Read up to `size` bytes, waiting for them in simulated time up to the timeout."""
        return self._read(lambda: size if len(self._uart.tx) >= size else None, size)

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        """Read up to and including `expected`, or `size` bytes, or until the timeout."""
        tx = self._uart.tx

        def count_needed() -> int | None:
            count = tx.count_to_end_of(expected)
            if size is not None and len(tx) >= size and (count is None or count > size):
                return size
            return count

        return self._read(count_needed, size)

    def readline(self, size: int | None = -1, /) -> bytes:
        """Read a line with its line feed, or until the timeout."""
        return self.read_until(size=None if size is None or size < 0 else size)

    @one_thread
    def write(self, data: Any, /) -> int:
        """Write bytes to the line; wait, as a real port does, only while the line's queue is full.

        Raises:
            SerialTimeoutException: The queue was full until the write timeout.
        """
        self._check_open()
        self.twin.time_source.attend()
        self._set_host_line()
        remaining = bytes(data)
        limit_ns = self._write_timeout_ns
        deadline_ns = None if limit_ns is None else self.time_ns + limit_ns
        while remaining:
            if free_capacity := self._uart.free_capacity:
                self.twin.robot.send(remaining[:free_capacity])
                remaining = remaining[free_capacity:]
                continue
            next_ns = self.twin.robot.next_exchange_ns() or 0
            if deadline_ns is not None and next_ns > deadline_ns:
                self.twin.advance_to(deadline_ns)
                if self._write_timeout == 0:
                    break
                raise SerialTimeoutException("Write timeout")
            self.twin.advance_to(max(next_ns, self.time_ns))
        return len(data) - len(remaining)

    @one_thread
    def flush(self) -> None:
        """Wait until all written bytes have reached the robot."""
        self._check_open()
        last_ns = self._uart.rx.arrival_ns(len(self._uart.rx)) or 0
        self.twin.advance_to(max(last_ns, self.time_ns))

    @one_thread
    def reset_input_buffer(self) -> None:
        """Discard unread bytes that have arrived."""
        self._check_open()
        self._uart.tx.read(self.time_ns)

    @one_thread
    def reset_output_buffer(self) -> None:
        """Discard written bytes that have not reached the robot."""
        self._check_open()
        self.twin.robot.flush()

    @one_thread
    def _read(self, count_needed: Callable[[], int | None], limit: int | None) -> bytes:
        """Wait until as many bytes as `count_needed` returns have arrived, and return them."""
        self._check_open()
        if limit is not None and limit <= 0:
            return b""
        tx = self._uart.tx
        deadline_ns = None if self._timeout_ns is None else self.time_ns + self._timeout_ns
        while (count := count_needed()) is None:
            next_ns = self.twin.robot.next_answer_ns()
            if next_ns is None or (deadline_ns is not None and next_ns > deadline_ns):
                break
            self.twin.advance_to(max(next_ns, self.time_ns))
        if count is None and deadline_ns is None:
            reason = (
                "no timeout is set and no answer is under way "
                "(every command ends with a line feed or carriage return)"
                if self.twin.robot.firmware.powered
                else "the robot's supply is below 4 V, it is dead"
            )
            raise TwinPortError(f"{self._port}: waiting for ever: {reason}")
        ends_ns = [end_ns for end_ns in (deadline_ns, count and tx.arrival_ns(count)) if end_ns is not None]
        if self._timeout == 0 and not tx.count_arrived(self.time_ns):
            self._poll()
        else:
            self.twin.advance_to(max(min(ends_ns), self.time_ns))
        count = count_needed()
        return tx.read(self.time_ns, limit if count is None else count)

    def _poll(self) -> None:
        """Advance time by a poll of an empty line."""
        self.twin.advance_to(self.time_ns + (self._uart.tx.byte_ns or _POLL_NS))

    def _check_open(self) -> None:
        if not self.is_open:
            raise PortNotOpenError()

    def _set_host_line(self) -> None:
        """Apply the host's baud rate, and warn once if it is not the robot's."""
        robot = self.twin.robot
        if notice := robot.set_host_line(self._settings):
            self.twin.world.log_event(robot.index, notice)
            warnings.warn(f"{self._port}: {notice}", stacklevel=4)

    def _reconfigure_port(self) -> None:
        """Adopt the port's settings; the baud rate applies from the next byte."""
        self._settings = LineSettings(self._baudrate, 2 if self._stopbits > 1 else 1)
        self._timeout_ns = None if self._timeout is None else to_ns(self._timeout)
        self._write_timeout_ns = None if self._write_timeout is None else to_ns(self._write_timeout)

    def _update_rts_state(self) -> None:
        """Do nothing: the line does not have this wire."""

    _update_dtr_state = _update_break_state = _update_rts_state


def open_url(url: str) -> Twin:
    """Open the twin of a khep:// URL: in a playpen, or resumed from a log.

    Raises:
        KhepTwinError: The URL, the playpen or the log cannot be used.
    """
    name, values = _parse_options(url)
    if not name.endswith(".mcap"):
        return open_twin(*parse_url(url))
    from khep_twin.log.recorded import BranchPoint
    from khep_twin.ports.branching import open_log
    from khep_twin.ports.resume import run_end_ns

    if extra := values.keys() - {"at", "seed", "faults", "robot", "log"}:
        raise TwinPortError(f"{url}: {min(extra)} is set by the log; expected at, seed, fault, robot or log")
    at_ns = run_end_ns(Path(name)) if "at" not in values else to_ns(values["at"])
    change = BranchPoint(at_ns, seed=values.get("seed"), faults=values.get("faults", ()))
    log = values.get("log")
    return open_log(Path(name), change, values.get("robot"), log and Path(log))


def parse_url(url: str) -> tuple[str, TwinOptions]:
    """Return the playpen and the options of a khep:// URL."""
    playpen, values = _parse_options(url)
    if "at" in values:
        raise TwinPortError(f"{url}: at = {values['at']:g} is for a log; expected khep://FILE.mcap?at=...")
    return playpen, replace(TwinOptions(), **values)


def _number_parser(pattern: str, convert: Callable[[str], float]) -> Callable[[str], float]:
    """Return a function that converts numbers of this pattern."""

    def parse(text: str) -> float:
        if not re.fullmatch(pattern, text):
            raise ValueError(text)
        return convert(text)

    return parse


_INTEGER = _number_parser("-?[0-9]{1,20}", int)
_ON_OFF = {"on": True, "off": False}.__getitem__

_OPTION_NAMES = {"fault": "faults"}
"""Names in `TwinOptions` of options with another name in the URL."""

_OPTIONS: dict[str, tuple[Callable[[str], object], str]] = {
    "at": (_number_parser(r"[0-9]{1,8}(\.[0-9]{1,9})?", float), "a moment of the log's run in seconds"),
    "seed": (_INTEGER, "an integer from 0 to 2**63-1"),
    "robot": (_INTEGER, "the number of a robot in the playpen, counted from 0"),
    "noise": (_ON_OFF, "on or off"),
    "vary": (_ON_OFF, "on or off"),
    "rom": (str, "a version of the firmware, such as 5.02"),
    "model": (str, "a model of the robot, khepera1 or khepera2"),
    "mode": (_number_parser("[0-9A-Fa-f]", partial(int, base=16)), "a running mode, one digit from 0 to F"),
    "battery_used_min": (
        _number_parser(r"(0?[0-9]{1,3}(\.[0-9]{1,9})?|1000(\.0{1,9})?)", float),
        "a number of minutes from 0 to 1000",
    ),
    "unpaced": (_ON_OFF, "on or off"),
    "strict_line": (_ON_OFF, "on or off"),
    "fault": (
        lambda text: tuple(text.split(",")),
        "faults with commas between them, such as drop:0.01,stuck:2@5-9",
    ),
    "log": (str, "the name of the log to write"),
}


def _parse_options(url: str) -> tuple[str, dict[str, Any]]:
    """Return the playpen or log of a khep:// URL, and its options by name."""
    try:
        parts = urlsplit(url)
    except ValueError as error:
        raise TwinPortError(f"{url}: no URL: {error}") from None
    if parts.fragment:
        raise TwinPortError(f"{url}: '#' ends a URL; expected %23 in its place")
    if parts.query.endswith((".toml", ".mcap")) and "=" not in parts.query:
        raise TwinPortError(f"{url}: '?' starts the options of a URL; expected %3F in a name")
    if parts.scheme != "khep":
        raise TwinPortError(f"{url}: another scheme; expected khep://, such as khep://default")
    playpen = unquote(parts.netloc + parts.path)
    if not playpen:
        raise TwinPortError(f"{url}: no playpen named; expected a name or a path, such as khep://default")
    values: dict[str, Any] = {}
    for key, value in parse_qsl(parts.query, keep_blank_values=True):
        if key not in _OPTIONS:
            raise TwinPortError(f"{url}: unknown option {key!r}; {choices(key, _OPTIONS)}")
        if _OPTION_NAMES.get(key, key) in values:
            raise TwinPortError(f"{url}: option {key!r} is given twice")
        convert, expected = _OPTIONS[key]
        try:
            values[_OPTION_NAMES.get(key, key)] = convert(value)
        except (KeyError, ValueError):
            raise TwinPortError(f"{url[:200]}: {key} = {value[:40]!r}; expected {expected}") from None
    return playpen, values
