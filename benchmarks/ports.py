"""`python -m benchmarks.ports`: a served twin beside a bare pseudo-terminal that echoes, in one run.

The round trip is that of `B` and its 13 bytes, with a plain client that calls os.write and os.read. The floor
is a process that answers each line with 13 ready bytes and does nothing else.
"""

import os
import statistics
import subprocess
import sys
import time
import tty
from pathlib import Path

ROUNDS = 5
TRIPS = 1000
REPLY = b"b,5.02,5.01\r\n"
EXAMPLE = Path(__file__).parents[1] / "examples" / "01_braitenberg.py"


def main() -> None:
    echo, path = _echo()
    floors: list[float] = []
    trips: list[float] = []
    with _served("--unpaced") as twin:
        name = _path_of(twin)
        for _ in range(ROUNDS):
            floors += _trips(path)
            trips += _trips(name)
        twin.terminate()
    echo.kill()
    floor, trip = statistics.median(floors), statistics.median(trips)
    print(f"B over a pty, {len(trips)} times: p50 {trip * 1e6:.0f} us, p99 {_p99(trips) * 1e6:.0f} us")
    print(f"bare pty echo:            p50 {floor * 1e6:.0f} us; ratio {trip / floor:.2f}")
    with _served() as twin:
        lateness = _lateness(_path_of(twin))
        twin.terminate()
    print(
        f"N at 9600 baud, 400 times: beside the line's time the reply ends "
        f"{statistics.median(lateness) * 1e3:+.2f} ms p50, {_p99(lateness) * 1e3:+.2f} ms p99, "
        f"{min(lateness) * 1e3:+.2f} ms at the earliest"
    )
    with _served("--clock", "wire", playpen="obstacles") as twin:
        name, start = _path_of(twin), time.perf_counter()
        subprocess.run([sys.executable, str(EXAMPLE), name, "1000"], check=True)
        took = time.perf_counter() - start
        twin.terminate()
        said = twin.communicate()[1]
    simulated = float(said.split(" s served")[0].split()[-1])
    factor = simulated / took
    print(f"wire clock, 1000 cycles of the example: {simulated:.1f} s in {took:.2f} s, {factor:.0f} times")


def _echo() -> tuple[subprocess.Popen[bytes], str]:
    program = (
        "import os, sys\nmaster = int(sys.argv[1])\n"
        "while True:\n    if b'\\n' in os.read(master, 100): os.write(master, b'b,5.02,5.01\\r\\n')"
    )
    master, slave = os.openpty()
    tty.setraw(slave)
    command = [sys.executable, "-c", program, str(master)]
    return subprocess.Popen(command, pass_fds=[master]), os.ttyname(slave)


def _served(*options: str, playpen: str = "default") -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "khep_twin", "serve", playpen, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _path_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _trips(path: str) -> list[float]:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    taken: list[float] = []
    try:
        for _ in range(TRIPS):
            start, reply = time.perf_counter(), b""
            os.write(port, b"B\n")
            while len(reply) < len(REPLY):
                reply += os.read(port, 100)
            taken.append(time.perf_counter() - start)
    finally:
        os.close(port)
    time.sleep(0.1)
    return taken


def _lateness(path: str) -> list[float]:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    late: list[float] = []
    try:
        for number in range(400):
            start, reply = time.perf_counter(), b""
            os.write(port, b"N\n")
            while not reply.endswith(b"\n"):
                reply += os.read(port, 100)
            late.append(time.perf_counter() - start - (2 + len(reply)) * 11 / 9600)
            time.sleep(0.001 * (number % 7))
    finally:
        os.close(port)
    return late


def _p99(values: list[float]) -> float:
    return statistics.quantiles(values, n=100)[98]


if __name__ == "__main__":
    sys.exit(main())
