"""Benchmark of many robots in real time, each polled on a separate line, against bare echoes.

`python -m benchmarks.swarm` serves the playpen `swarm` with and without a log, and asks each of its twenty
robots for N and D in turn, as often as 9600 baud allows. The floor is a process that answers on as many
pseudo-terminals with constant bytes at 9600 baud. The unit is the share of the time in which a line transmits
bytes: its ratio to the floor's is the real-time factor.
"""

import os
import select
import statistics
import subprocess
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.line import open_terminal, processor_s
from benchmarks.table import LEGEND, Row, RunTimes, measure, text
from khep_twin.playpen import Playpen
from stand_ins.echoes import BYTE_S, echoes
from stand_ins.served import served

ROUNDS = 3
SECONDS = 10.0

REQUESTS = (b"N\n", b"D,5,4\n")


@contextmanager
def swarm_rows(name: str, seconds: float) -> Generator[list[Row]]:
    """Measure the floor and a served playpen with and without a log, while their processes run.

    Args:
        name: Playpen.
        seconds: Duration of one run [s].
    """
    count = len(Playpen.load(name).robots)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        rows = [PolledLines(*stack.enter_context(echoes(count)), seconds).row("bare paced echoes (floor)")]
        for title, options in (("served", ()), ("served, logged", ("--log", str(folder / "swarm.mcap")))):
            process, paths = stack.enter_context(_served(name, count, *options))
            rows.append(PolledLines(process, paths, seconds).row(f"{name} {title}"))
        yield rows


class PolledLines:
    """Lines of a process, all polled together by this one.

    Args:
        process: Process that answers.
        paths: Paths of its terminals.
        seconds: Duration of one run [s].

    Attributes:
        late: Delays of the replies of the last run beyond the line's time [s].
    """

    def __init__(self, process: subprocess.Popen[Any], paths: Sequence[str], seconds: float) -> None:
        self.late: list[float] = []
        self._process, self._paths, self._seconds = process, paths, seconds

    def row(self, name: str) -> Row:
        """Return the row of a table: seconds of the lines' time per second, and the delays."""
        return Row(name, 1, self.run, lambda rate: self._delays())

    def run(self) -> RunTimes:
        """Poll all lines for the duration; return the times for one second on each line."""
        self.late = []
        ports = [open_terminal(path) for path in self._paths]
        poll, busy = select.epoll(), 0.0
        replies = {port: b"" for port in ports}
        request_index = dict.fromkeys(ports, 0)
        sent: dict[int, float] = {}
        try:
            cpu, start = processor_s(self._process.pid), time.perf_counter()
            for port in ports:
                poll.register(port, select.EPOLLIN)
                sent[port] = time.perf_counter()
                os.write(port, REQUESTS[0])
            # Two delays at least, for their percentiles.
            while (now := time.perf_counter()) - start < self._seconds or len(self.late) < 2:
                for port, _ in poll.poll(0.1):
                    replies[port] += os.read(port, 4096)
                    if replies[port].endswith(b"\n"):
                        now = time.perf_counter()
                        line = (len(REQUESTS[request_index[port]]) + len(replies[port])) * BYTE_S
                        self.late.append(now - sent[port] - line)
                        busy += line / len(ports)
                        replies[port], request_index[port] = b"", (request_index[port] + 1) % len(REQUESTS)
                        sent[port] = now
                        os.write(port, REQUESTS[request_index[port]])
            cpu, wall = processor_s(self._process.pid) - cpu, now - start
        finally:
            poll.close()
            for port in ports:
                os.close(port)
        time.sleep(0.1)
        return RunTimes(wall / busy, cpu / busy)

    def _delays(self) -> str:
        p99 = statistics.quantiles(self.late, n=100)[98]
        return f"late {statistics.median(self.late) * 1e3:.2f} ms p50, {p99 * 1e3:.2f} ms p99"


@contextmanager
def _served(name: str, count: int, *options: str) -> Generator[tuple["subprocess.Popen[Any]", list[str]]]:
    with served("serve", name, *options) as (process, first):
        assert process.stdout is not None
        yield process, [first, *(process.stdout.readline().strip() for _ in range(count - 1))]


def main() -> None:
    with swarm_rows("swarm", SECONDS) as rows:
        print(text([measure("swarm, N and D at 9600 baud", rows, ROUNDS, unit="s of each line per s")]))
    print(LEGEND)


if __name__ == "__main__":
    main()
