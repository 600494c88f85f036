"""Terminals in place of a robot's line, which answer with constant bytes or echo their input."""

import os
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Generator
from contextlib import contextmanager

BYTE_S = 11 / 9600
"""Duration of a byte on the line [s]."""

_UNPACED = """
import os, sys
master = int(sys.argv[1])
while True:
    if b"\\n" in os.read(master, 100):
        os.write(master, b"b,5.02,5.01\\r\\n")
"""
"""One terminal that answers `B` with the least work."""

_PACED = f"""
import os, select, sys, time
masters = [int(each) for each in sys.argv[1:]]
due = {{}}
while True:
    now = time.perf_counter()
    for master, (at, reply) in list(due.items()):
        while reply and at <= now:
            os.write(master, reply[:1])
            at, reply = at + {BYTE_S}, reply[1:]
        due[master] = at, reply
        if not reply:
            del due[master]
    wait = min((at for at, _ in due.values()), default=now + 1) - time.perf_counter()
    for master in select.select(masters, [], [], max(wait, 0))[0]:
        request = os.read(master, 100)
        reply = b"n,0,0,0,0,0,0,0,0\\r\\n" if request[:1] == b"N" else b"d\\r\\n"
        due[master] = time.perf_counter() + (len(request) + 1) * {BYTE_S}, reply
"""
"""Any number of terminals, answered at 9600 baud."""


@contextmanager
def echoes(count: int = 1, *, paced: bool = True) -> Generator[tuple["subprocess.Popen[bytes]", list[str]]]:
    """Run a process that only answers on terminals with constant bytes.

    Args:
        count: Number of terminals.
        paced: True to answer N and D at 9600 baud, False to answer `B` immediately on one terminal.

    Yields:
        The process, and the paths of the terminals.
    """
    pairs = [os.openpty() for _ in range(count)]
    for _, host_side in pairs:
        tty.setraw(host_side)
    masters = [master for master, _ in pairs]
    command = [sys.executable, "-c", _PACED if paced else _UNPACED, *map(str, masters)]
    process = subprocess.Popen(command, pass_fds=masters)
    try:
        yield process, [os.ttyname(host_side) for _, host_side in pairs]
    finally:
        process.kill()
        process.wait()
        for end in (*masters, *(host_side for _, host_side in pairs)):
            os.close(end)


@contextmanager
def loopback() -> Generator[str]:
    """Yield the path of a terminal that echoes its input, after about a byte's time in each direction."""
    far_end, near_end = os.openpty()
    tty.setraw(near_end)

    def echo() -> None:
        while data := os.read(far_end, 4096):
            time.sleep(0.002)
            os.write(far_end, data)

    threading.Thread(target=echo, daemon=True).start()
    yield os.ttyname(near_end)
