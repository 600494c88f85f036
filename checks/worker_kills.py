"""Kills of Ray's workers at random during a sweep, and a check that each result exists once.

    python -m checks worker-kills --tasks 200 --kills 100

The table must be the same, byte for byte, as that of an undisturbed sweep in threads; otherwise the exit
status is 1. Only processes that the sweep itself has started are killed.
"""

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pyarrow.parquet as pq

from tools.command_table import command_line

STUDY = """version = 1
name = "kills"
playpens = ["looping-maze"]
seeds = {n_episodes}
seconds = {seconds}
step_ms = 5
rollouts_per_task = 4
output = "{output}"

[[network]]
name = "drawn"
recurrent = true
drawn = 4
"""

LOOPBACK = {"0100007F", "0000000000000000FFFF00000100007F"}
"""Forms of 127.0.0.1 in /proc/net/tcp and in tcp6."""

TIMEOUT_S = 120.0
"""Timeout without progress on a busy machine [s]."""


def study(folder: Path, tasks: int, seconds: int, output: str) -> Path:
    """Write a study of so many tasks, four episodes each."""
    file = folder / f"{output}.toml"
    file.write_text(STUDY.format(n_episodes=tasks, seconds=seconds, output=output))
    return file


def descendants(parent: int) -> dict[int, bytes]:
    """Return the command lines of all descendants of a process."""
    parents: dict[int, int] = {}
    names: dict[int, bytes] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            status = (entry / "stat").read_text()
            names[int(entry.name)] = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        parents[int(entry.name)] = int(status.rpartition(")")[2].split()[1])
    command_lines: dict[int, bytes] = {}
    for process, name in names.items():
        above = process
        while above not in (0, parent):
            above = parents.get(above, 0)
        if above == parent:
            command_lines[process] = name
    return command_lines


def workers_of(parent: int) -> list[int]:
    """Return Ray's workers among the descendants of a process."""
    names = descendants(parent)
    return sorted(process for process, name in names.items() if name.startswith((b"ray::_do", b"ray::IDLE")))


def listening(parent: int) -> set[str]:
    """Return the addresses on which a process and its descendants listen, in the form of /proc."""
    sockets: dict[str, str] = {}
    for table in ("tcp", "tcp6"):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A":  # listening
                sockets[f"socket:[{fields[9]}]"] = fields[1].partition(":")[0]
    addresses: set[str] = set()
    for process in descendants(parent):
        try:
            addresses |= {
                sockets.get(os.readlink(link), "") for link in Path(f"/proc/{process}/fd").iterdir()
            }
        except OSError:
            continue
    return addresses - {""}


def kill_workers(sweep: "subprocess.Popen[bytes]", parts: Path, tasks: int, kills: int, seed: int) -> int:
    """Kill workers, each time after another part of the tasks is done; return their number."""
    rng = random.Random(seed)
    killed: set[int] = set()
    last = time.monotonic()
    # The last tasks are left out: they may be done before a kill.
    for threshold in sorted(rng.choices(range(max(tasks - 4, 1)), k=kills)):
        while True:
            assert time.monotonic() - last < TIMEOUT_S, f"nothing happened after {len(killed)} kills"
            if sweep.poll() is not None:
                return len(killed)
            n_parts = len(list(parts.glob("task-*.parquet")))
            if n_parts >= threshold:
                break
            time.sleep(0.05)
        time.sleep(rng.uniform(0, 0.7))
        # Ray may also end idle workers.
        while not (alive := [pid for pid in workers_of(sweep.pid) if pid not in killed]):
            if sweep.poll() is not None:
                return len(killed)
            assert time.monotonic() - last < TIMEOUT_S, f"no worker after {len(killed)} kills"
            time.sleep(0.05)
        victim = rng.choice(alive)
        os.kill(victim, signal.SIGKILL)
        killed.add(victim)
        last = time.monotonic()
    return len(killed)


def trial(folder: Path, tasks: int, kills: int, seconds: int, seed: int) -> int:
    """Run a study twice, in threads and with kills; return the number of kills.

    Raises:
        AssertionError: The tables differ, or the sweep failed.
    """
    command = [sys.executable, "-m", "khep_twin", "sweep"]
    quiet = study(folder, tasks, seconds, "quiet")
    subprocess.run([*command, str(quiet)], check=True, stdout=subprocess.DEVNULL)
    disturbed = study(folder, tasks, seconds, "disturbed")
    with subprocess.Popen([*command, str(disturbed), "--ray"], stdout=subprocess.DEVNULL) as sweep:
        try:
            killed = kill_workers(sweep, folder / "disturbed" / "parts", tasks, kills, seed)
            addresses = listening(sweep.pid)
            assert addresses <= LOOPBACK, f"it listens to others: {addresses}"
            assert sweep.wait() == 0, "the sweep failed"
        finally:
            sweep.terminate()
    tables = [folder / name / "results.parquet" for name in ("quiet", "disturbed")]
    episodes = pq.read_table(tables[1])["episode"].to_pylist()
    assert episodes == list(range(4 * tasks)), "an episode is missing, or there twice"
    assert tables[0].read_bytes() == tables[1].read_bytes(), "other results than without kills"
    return killed


def main() -> int:
    """Kill the requested number of workers and print the result."""
    parser = command_line(__doc__)
    parser.add_argument("--tasks", type=int, default=200)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seconds", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    wish = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="khep-twin-sweep-") as folder:
        start = time.monotonic()
        try:
            killed = trial(Path(folder), wish.tasks, wish.kills, wish.seconds, wish.seed)
        except (AssertionError, subprocess.CalledProcessError) as error:
            print(error)
            return 1
        print(
            f"{killed} workers killed in a sweep of {wish.tasks} tasks, {4 * wish.tasks} episodes: each is "
            f"there once, the table as without kills ({time.monotonic() - start:.0f} s)"
        )
    return 0 if killed == wish.kills else 1
