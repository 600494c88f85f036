"""Processes that have a port open, by the kernel's reports: the port is not opened, so sessions continue.

A process uses a device if it has it open (/proc/PID/fd), if it is its controlling terminal (/proc/PID/stat,
which every user may read), or if it has written a lock file, as terminal programs do. A program at the other
end of a pseudo-terminal, such as `khep-twin serve`, may keep one descriptor of the host's side open without
being a host. A TCP port has a host when a connection to it is established.

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
"""Major numbers of pseudo-terminals; their minor numbers are their names in /dev/pts."""


def port_user(url: str) -> str:
    """Return the user of a port, as "process 1234 (picocom)" or "a connection"; empty without one.

    The port is a device, a link to one, or a URL of pyserial.
    """
    try:
        parts = urlsplit(url)
    except ValueError:  # for example unclosed brackets
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
    pid = next(_find_users(url, device), None)
    return "" if pid is None else f"process {pid}{_process_name(pid)}"


def count_descriptors(path: str) -> int:
    """Count the open descriptors of a device in all processes that /proc shows."""
    device, count = os.stat(path), 0
    for process in _PROCESSES.glob("[0-9]*"):
        # Processes may end meanwhile, and those of other users are not readable.
        with suppress(OSError):
            count += _count_open(process, device)
    return count


def _find_users(path: str, device: os.stat_result) -> Iterator[int]:
    """Find the processes that have a device open or in their lock file."""
    if sys.platform == "win32":
        return
    major, minor = os.major(device.st_rdev), os.minor(device.st_rdev)
    terminal = (major - _UNIX98_PTS.start) * 256 + minor if major in _UNIX98_PTS else None
    for process in _PROCESSES.glob("[0-9]*"):
        # Processes may end meanwhile, and those of other users are not readable.
        with suppress(OSError, ValueError, IndexError):
            if _is_controlled_by(process, major, minor):
                yield int(process.name)
                continue
            n_expected = 1 if terminal is not None and _has_master(process, terminal) else 0
            if _count_open(process, device) > n_expected:
                yield int(process.name)
    for name in {os.path.basename(path), os.path.basename(os.path.realpath(path))}:
        with suppress(OSError, ValueError, IndexError):
            pid = int((_LOCKS / f"LCK..{name}").read_text(encoding="ascii").split()[0])
            if (_PROCESSES / str(pid)).exists():
                yield pid


def _count_open(process: Path, device: os.stat_result) -> int:
    """Count the open descriptors of a device in a process."""
    return sum(_is_same(descriptor, device) for descriptor in (process / "fd").iterdir())


def _is_same(descriptor: Path, device: os.stat_result) -> bool:
    """Return whether a descriptor refers to a device; containers number pseudo-terminals separately."""
    if sys.platform == "win32":
        return False
    with suppress(OSError):
        if os.readlink(descriptor).startswith("/dev/"):
            status = descriptor.stat()
            is_terminal = os.major(device.st_rdev) in _UNIX98_PTS
            same_number = stat.S_ISCHR(status.st_mode) and status.st_rdev == device.st_rdev
            return os.path.samestat(status, device) or (same_number and not is_terminal)
    return False


def _is_controlled_by(process: Path, major: int, minor: int) -> bool:
    """Return whether a device that is no pseudo-terminal is the controlling terminal of a process."""
    # After the name in brackets: state, parent, group, session, terminal.
    stat_text = (process / "stat").read_text(encoding="utf-8", errors="replace")
    terminal = int(stat_text.rpartition(")")[2].split()[4])
    device_number = ((terminal >> 8) & 0xFFF, (terminal & 0xFF) | ((terminal >> 12) & 0xFFF00))
    return major not in _UNIX98_PTS and device_number == (major, minor)


def _has_master(process: Path, terminal: int) -> bool:
    """Return whether a process has the master side of a pseudo-terminal open."""
    for descriptor in (process / "fd").iterdir():
        with suppress(OSError):
            if os.readlink(descriptor).endswith("ptmx"):
                fd_info = (process / "fdinfo" / descriptor.name).read_text(encoding="ascii")
                match = re.search(r"^tty-index:\s*(\d+)$", fd_info, re.MULTILINE)
                if match is not None and int(match[1]) == terminal:
                    return True
    return False


def _process_name(pid: int) -> str:
    """Return the name of a process in brackets; empty if it has ended."""
    with suppress(OSError):
        name = (_PROCESSES / str(pid) / "comm").read_text(encoding="utf-8", errors="replace")
        return f" ({name.strip()})"
    return ""


def _is_connected(host: str, port: int) -> bool:
    """Return whether this machine serves a TCP port that has an established connection."""
    address_infos = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    addresses = {_kernel_address(info[4][0]) for info in address_infos if isinstance(info[4][0], str)}
    is_any = any(not int(address, 16) for address in addresses)
    for table in _TCP_TABLES:
        with suppress(FileNotFoundError):
            for row in table.read_text(encoding="ascii").splitlines()[1:]:
                _, local, _, state, *_ = row.split()
                address, _, port_text = local.partition(":")
                if state == _ESTABLISHED and int(port_text, 16) == port and (is_any or address in addresses):
                    return True
    return False


def _kernel_address(address: str) -> str:
    """Return an address in the form of the kernel's tables: 32-bit words in this machine's byte order."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    packed = socket.inet_pton(family, address.partition("%")[0])
    words = [packed[start : start + 4] for start in range(0, len(packed), 4)]
    return "".join(f"{int.from_bytes(word, sys.byteorder):08X}" for word in words)
