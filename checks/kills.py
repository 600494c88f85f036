"""Kills of runs at random times, and the loss in their logs.

    python -m checks kills serve 200 --jobs 3
    python -m checks kills run 40 --jobs 3

`serve` is polled for its sensors by a host, in real time, until it is killed. The loss is the wall time
before the kill that is missing in the recovered log, by its last sample and by its last reply. `run` is in
lock-step and prints its simulated time after each cycle; the loss is the missing simulated time.
The robots are of the playpens in `HOSTS` in turn. Each log must be recovered by `khep-twin recover`, opened
by mcap's reader, and hold the replies that the host has received. The exit status is 1 if a log fails to, or
lost more than the limit.
"""

import os
import random
import select
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader

from khep_twin.clock import NS_PER_S
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import read_line
from khep_twin.log.recorder import FLUSH_NS
from stand_ins.served import served
from tools.command_table import command_line

MOST_LOST = {"serve": 1.0, "run": FLUSH_NS / NS_PER_S + 0.1}
"""Largest loss of a log: wall time for `serve`, simulated time for `run` [s].

A run loses its time since the last flush: any time up to that between two flushes. Its last reply may be a
cycle of the host earlier."""

HOSTS = {"obstacles": "Khepera", "arena4": "Khepera4", "arena3": "Khepera3"}
"""Playpens of three models, one after the other by the seed, and their host classes."""

LATEST_KILL = 3.0
"""Latest wall time of a kill after the first output [s]."""

TIMEOUT_S = 60.0
"""Timeout on a busy machine [s]."""

PROGRAM = """import os
from khep_twin import host

with host.{host}("khep://{playpen}?log=run.mcap") as robot:
    while True:
        robot.proximity()
        os.write(1, b"%.9f\\n" % robot.time)
"""


@dataclass(frozen=True, slots=True)
class Kill:
    """Results of one kill.

    Attributes:
        lost: Time lost before the kill, by the last sample [s].
        lost_replies: Time lost by the last reply, with the pause between two replies [s].
        stall: Longest pause between two outputs, which a busy machine may cause [s].
        whole: True if the file was recovered as a whole, and not in part.
    """

    lost: float
    lost_replies: float
    stall: float
    is_complete: bool


@dataclass(frozen=True, slots=True)
class Recovered:
    """Content of a recovered log: time of the last sample [s], and the robot's replies."""

    last_sample: float
    replies: Sequence[TextLine]
    is_complete: bool


def kill_serve(folder: Path, after: float, playpen: str) -> Kill:
    """Serve a twin, poll it and kill it after so many seconds."""
    log = folder / "run.mcap"
    with served("serve", playpen, "--log", str(log)) as (server, path):
        start = time.monotonic()
        host_replies = _poll(path, start + after)
        killed = time.monotonic()
        server.kill()
    recovered = _recover(log)
    times = [start, *(at for at, _ in host_replies)]
    recorded = [line.text for line in recovered.replies]
    n_common = min(len(recorded), len(host_replies))
    # The last reply may still have been on the line when the host was asked for the last time.
    assert recorded[:n_common] == [text for _, text in host_replies][:n_common], (
        "other replies than the host's"
    )
    # The last reply in both relates simulated time to wall time; without one, the start does.
    at, simulated = (
        (host_replies[n_common - 1][0], recovered.replies[n_common - 1].time_ns / NS_PER_S)
        if n_common
        else (start, 0)
    )
    by_sample = killed - at - (recovered.last_sample - simulated)
    by_reply = killed - times[n_common] if n_common < len(host_replies) else 0.0
    stall = max(after - before for before, after in zip(times, [*times[1:], killed], strict=True))
    return Kill(by_sample, by_reply, stall, recovered.is_complete)


def _poll(path: str, end_s: float) -> list[tuple[float, str]]:
    """Poll the sensors repeatedly; return the time of completion and the text of each reply."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    replies: list[tuple[float, str]] = []
    try:
        while time.monotonic() < end_s:
            os.write(port, b"N\n")
            reply = b""
            while b"\n" not in reply:
                if not select.select([port], [], [], max(end_s - time.monotonic(), 0))[0]:
                    return replies
                reply += os.read(port, 4096)
            replies.append((time.monotonic(), reply.decode("ascii").strip()))
        return replies
    finally:
        # Closing after the kill would be the same; a host that disconnects first loses nothing.
        os.close(port)


def kill_run(folder: Path, after: float, playpen: str) -> Kill:
    """Run a program in lock-step and kill it after so many seconds."""
    log = folder / "run.mcap"
    program = PROGRAM.format(playpen=playpen, host=HOSTS[playpen])
    command = [sys.executable, "-c", program]
    pipe, null = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(command, stdout=pipe, stderr=null, cwd=folder) as process:
        assert process.stdout is not None
        output = b""
        try:
            assert select.select([process.stdout], [], [], TIMEOUT_S)[0], "nothing was run"
            end_s = time.monotonic() + after
            while (rest := end_s - time.monotonic()) > 0:
                if select.select([process.stdout], [], [], rest)[0]:
                    output = (output + os.read(process.stdout.fileno(), 65536))[-100:]
        finally:
            process.kill()
        output = (output + process.stdout.read())[-100:]
    recovered = _recover(log)
    reached = float(output.splitlines()[-1])
    last_reply = recovered.replies[-1].time_ns / NS_PER_S if recovered.replies else 0.0
    return Kill(reached - recovered.last_sample, reached - last_reply, 0.0, recovered.is_complete)


def _recover(log: Path) -> Recovered:
    """Recover a killed run's log by the command and read it by mcap's reader."""
    part = log.with_name(log.name + ".part")
    command = [sys.executable, "-m", "khep_twin", "recover", str(part)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode in (0, 3), process
    last_ns, replies = 0, []
    with log.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.topic == "/tf":
                last_ns = message.log_time
            elif channel.topic.endswith("/serial"):
                line = read_line(message.data)
                replies += [line] if line.name == "robot" else []
    return Recovered(last_ns / NS_PER_S, replies, process.returncode == 0)


KILLS = {"serve": kill_serve, "run": kill_run}


def kill(kind: str, seed: int, latest: float = LATEST_KILL) -> Kill:
    """Kill one run, in a separate folder, at a time drawn from the seed."""
    with tempfile.TemporaryDirectory(prefix="khep-twin-kills-") as folder:
        playpen = [*HOSTS][seed % len(HOSTS)]
        return KILLS[kind](Path(folder), random.Random(seed).uniform(0, latest), playpen)


def main() -> int:
    """Kill the requested number of runs and print the losses."""
    parser = command_line(__doc__)
    parser.add_argument("what", choices=sorted(KILLS), nargs="?", default="serve")
    parser.add_argument("count", type=int, nargs="?", default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    wish = parser.parse_args()
    seeds = range(wish.seed, wish.seed + wish.count)
    with ThreadPoolExecutor(wish.jobs) as pool:
        kills = list(pool.map(lambda seed: kill(wish.what, seed), seeds))
    lost = [max(record.lost, 0.0) for record in kills]
    replies = [max(record.lost_replies, 0.0) for record in kills]
    late = sum(max(pair) > MOST_LOST[wish.what] for pair in zip(lost, replies, strict=True))
    n_complete = sum(record.is_complete for record in kills)
    print(f"{wish.what} killed {len(kills)} times, all recovered, {n_complete} as a whole")
    for name, values in (("samples", lost), ("replies", replies)):
        print(
            f"lost by {name} [s]: min {min(values):.3f}  mean {statistics.mean(values):.3f}  "
            f"median {statistics.median(values):.3f}  max {max(values):.3f}"
        )
    if wish.what == "serve":
        print(f"longest pause between two replies {max(record.stall for record in kills):.3f} s")
    print(f"{late} lost more than {MOST_LOST[wish.what]:.1f} s")
    return 1 if late else 0
