"""Processes that have a port open, as the kernel reports them: no port is opened, so sessions continue.

A process holds a device that it has open (/proc/PID/fd), that is its controlling terminal (/proc/PID/stat,
which every user may read), or for which it has left a lock file, as terminal programs do. A program at the
far end of a pseudo-terminal, such as `khep-twin serve`, may keep one descriptor of the host's side open
without being a host. A TCP port has a host when a connection to it is established.

Other users' processes that have a device open without a lock cannot be detected; without /proc, none can.
"""

import os
import re
import socket
import stat
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

_PROCESSES, _LOCKS = Path("/proc"), Path("/run/lock")
_TCP_TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_ESTABLISHED = "01"
_UNIX98_PTS = range(136, 144)
"""Major numbers of pseudo-terminals, whose minor numbers are their names in /dev/pts."""


def port_user(url: str) -> str:
    """Name the user of a port: "process 1234 (picocom)", "a connection"; empty if none is found.

    The port is a device, a link to one, or a URL of pyserial's.
    """
    try:
        parts = urlsplit(url)
    except ValueError:  # such as brackets that are not closed
        return ""
    if parts.scheme in ("socket", "rfc2217"):
        with suppress(OSError, ValueError):
            return "a connection" if _is_connected(parts.hostname or "", parts.port or 0) else ""
    try:
        device = os.stat(url)
    except (OSError, ValueError):
        return ""
    if not stat.S_ISCHR(device.st_mode):
        return ""
    number = next(_processes(url, device), None)
    return "" if number is None else f"process {number}{_name(number)}"


def count_descriptors(path: str) -> int:
    """Count the descriptors that processes have open of a device, as far as /proc shows them."""
    device, count = os.stat(path), 0
    for process in _PROCESSES.glob("[0-9]*"):
        # Processes end while they are looked at, and those of others are closed to us.
        with suppress(OSError):
            count += _count(process, device)
    return count


def _processes(path: str, device: os.stat_result) -> Iterator[int]:
    """Find the processes that have a device open or in their lock file."""
    if sys.platform == "win32":
        return
    major, minor = os.major(device.st_rdev), os.minor(device.st_rdev)
    terminal = (major - _UNIX98_PTS.start) * 256 + minor if major in _UNIX98_PTS else None
    for process in _PROCESSES.glob("[0-9]*"):
        # Processes end while they are looked at, and those of others are closed to us.
        with suppress(OSError, ValueError, IndexError):
            if _controls(process, major, minor):
                yield int(process.name)
                continue
            kept = 1 if terminal is not None and _has_master(process, terminal) else 0
            if _count(process, device) > kept:
                yield int(process.name)
    for name in {os.path.basename(path), os.path.basename(os.path.realpath(path))}:
        with suppress(OSError, ValueError, IndexError):
            number = int((_LOCKS / f"LCK..{name}").read_text(encoding="ascii").split()[0])
            if (_PROCESSES / str(number)).exists():
                yield number


def _count(process: Path, device: os.stat_result) -> int:
    """Count the descriptors that a process has open of a device."""
    return sum(_is_same(each, device) for each in (process / "fd").iterdir())


def _is_same(descriptor: Path, device: os.stat_result) -> bool:
    """Return whether a descriptor is of a device; of pseudo-terminals, each container numbers its own."""
    if sys.platform == "win32":
        return False
    with suppress(OSError):
        if os.readlink(descriptor).startswith("/dev/"):
            found = descriptor.stat()
            is_terminal = os.major(device.st_rdev) in _UNIX98_PTS
            same_number = stat.S_ISCHR(found.st_mode) and found.st_rdev == device.st_rdev
            return os.path.samestat(found, device) or (same_number and not is_terminal)
    return False


def _controls(process: Path, major: int, minor: int) -> bool:
    """Return whether a device that is no pseudo-terminal is the controlling terminal of a process."""
    # Behind the name in brackets: state, parent, group, session, terminal.
    about = (process / "stat").read_text(encoding="utf-8", errors="replace")
    terminal = int(about.rpartition(")")[2].split()[4])
    number = ((terminal >> 8) & 0xFFF, (terminal & 0xFF) | ((terminal >> 12) & 0xFFF00))
    return major not in _UNIX98_PTS and number == (major, minor)


def _has_master(process: Path, terminal: int) -> bool:
    """Return whether a process has the far end of a pseudo-terminal open."""
    for descriptor in (process / "fd").iterdir():
        with suppress(OSError):
            if os.readlink(descriptor).endswith("ptmx"):
                about = (process / "fdinfo" / descriptor.name).read_text(encoding="ascii")
                found = re.search(r"^tty-index:\s*(\d+)$", about, re.MULTILINE)
                if found is not None and int(found[1]) == terminal:
                    return True
    return False


def _name(number: int) -> str:
    """Return a process's name in brackets; nothing if it has ended."""
    with suppress(OSError):
        name = (_PROCESSES / str(number) / "comm").read_text(encoding="utf-8", errors="replace")
        return f" ({name.strip()})"
    return ""


def _is_connected(host: str, port: int) -> bool:
    """Return whether this machine serves a TCP port that has an established connection."""
    infos = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    addresses = {_address(info[4][0]) for info in infos if isinstance(info[4][0], str)}
    anywhere = any(not int(address, 16) for address in addresses)
    for table in _TCP_TABLES:
        with suppress(FileNotFoundError):
            for row in table.read_text(encoding="ascii").splitlines()[1:]:
                _, local, _, state, *_ = row.split()
                address, _, number = local.partition(":")
                if state == _ESTABLISHED and int(number, 16) == port and (anywhere or address in addresses):
                    return True
    return False


def _address(text: str) -> str:
    """Write an address as the kernel's tables do: in words of 32 bits in this machine's order."""
    family = socket.AF_INET6 if ":" in text else socket.AF_INET
    packed = socket.inet_pton(family, text.partition("%")[0])
    words = [packed[place : place + 4] for place in range(0, len(packed), 4)]
    return "".join(f"{int.from_bytes(word, sys.byteorder):08X}" for word in words)
