"""Round trips on a line, and the processor time of the process at its other end."""

import os
import time
from pathlib import Path

from stand_ins.echoes import BYTE_S


def open_terminal(path: str) -> int:
    """Open a terminal; return its descriptor."""
    return os.open(path, os.O_RDWR | os.O_NOCTTY)


def trip_s(port: int, request: bytes) -> tuple[float, int]:
    """Return the time of a request with its reply [s], and the length of the reply [bytes]."""
    start, reply = time.perf_counter(), b""
    os.write(port, request)
    while not reply.endswith(b"\n"):
        reply += os.read(port, 100)
    return time.perf_counter() - start, len(reply)


def delay_s(port: int, request: bytes) -> float:
    """Return the duration of a round trip less the time of its bytes on the line [s]."""
    took_s, length = trip_s(port, request)
    return took_s - (len(request) + length) * BYTE_S


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used, as Linux shows it [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
