"""Delay of a relay with and without a shadow beside it: `python -m benchmarks.relay_delay`.

Three served twins at 9600 baud stand in for robots, two behind `serve --relay`, one behind `shadow --relay`.
A host asks `N` and sets speeds at each of them in turn; what the two relays differ by is the noise of the
measurement. A round trip's delay is what it takes beside the time
of its bytes on the line. Printed is also the processor time of the shadow, in parts of the time it followed.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

PLAYPEN = "obstacles"
BYTE_S = 11 / 9600


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--trips", type=int, default=500, help="round trips of N by each way")
    options.add_argument("--particles", type=int, default=1000, help="particles of the shadow")
    given = options.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        twins = [
            stack.enter_context(_command("serve", PLAYPEN, "--link", str(folder / f"robot{seed}")))
            for seed in range(3)
        ]
        ways = {
            "relay": stack.enter_context(_command("serve", "--relay", twins[0][1])),
            "another relay": stack.enter_context(_command("serve", "--relay", twins[2][1])),
            "relay and shadow": stack.enter_context(
                _command("shadow", PLAYPEN, "--relay", twins[1][1], f"--particles={given.particles}")
            ),
        }
        ports = {name: os.open(path, os.O_RDWR | os.O_NOCTTY) for name, (_, path) in ways.items()}
        shadow = _child_of(ways["relay and shadow"][0].pid)
        begin, used = time.monotonic(), _used_s(shadow)
        late: dict[str, list[float]] = {name: [] for name in ports}
        for number in range(given.trips):
            speed = 4 if number // 50 % 2 else -4
            for name, port in ports.items():
                late[name].append(1e3 * _late_s(port, b"N\n"))
                _late_s(port, b"D,%d,%d\n" % (speed, 4))
        part = (_used_s(shadow) - used) / (time.monotonic() - begin)
        for port in ports.values():
            os.close(port)
    for name, values in late.items():
        print(
            f"{name:18} {statistics.median(values):+.2f} ms p50, "
            f"{statistics.quantiles(values, n=100)[98]:+.2f} ms p99, {max(values):+.2f} ms at most"
        )
    print(f"the shadow of {given.particles} particles used {part:.2f} of a core")


@contextmanager
def _command(*words: str) -> Generator[tuple["subprocess.Popen[str]", str]]:
    """Run a command; yield its process and what a host opens."""
    command = [sys.executable, "-m", "khep_twin", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.terminate()
            process.stdout.read()


def _late_s(port: int, command: bytes) -> float:
    """Return what a round trip takes beside the time of its bytes on the line [s]."""
    begin, reply = time.perf_counter(), b""
    os.write(port, command)
    while not reply.endswith(b"\n"):
        reply += os.read(port, 100)
    return time.perf_counter() - begin - (len(command) + len(reply)) * BYTE_S


def _child_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


def _used_s(pid: int) -> float:
    """Return the processor time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
