"""Recordings of stand-in robots in a folder: `python -m stand_ins FOLDER --runs 20 --playpen obstacles`."""

import argparse
import time
from pathlib import Path

import numpy as np

from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen
from stand_ins.hosts import HOSTS
from stand_ins.recordings import free_start, record


def main() -> None:
    """Record runs, and print how fast."""
    options = argparse.ArgumentParser(
        "python -m stand_ins",
        description=__doc__,
        formatter_class=argparse.RawTextHelpFormatter,
    )
    options.add_argument("folder", type=Path, help="folder of the recordings, made if it is not there")
    options.add_argument("--runs", type=int, default=3, help="number of runs, which alternate with the hosts")
    options.add_argument("--playpen", default="workshop", help="name or path of the playpen")
    options.add_argument("--seconds", type=float, default=300.0, help="length of each run [s]")
    options.add_argument("--seed", type=int, default=0, help="seed of the first run")
    options.add_argument("--host", choices=HOSTS, help="one host for all runs")
    options.add_argument("--asks-counters", action="store_true", help="ask H as well")
    options.add_argument("--asks-light", action="store_true", help="ask O as well")
    options.add_argument("--free-start", action="store_true", help="start anywhere")
    options.add_argument("--fault", action="append", default=[], help="a hidden fault, such as stuck:2@60")
    given = options.parse_args()
    try:
        _record_all(given)
    except (KhepTwinError, OSError) as error:
        options.error(str(error))


def _record_all(given: argparse.Namespace) -> None:
    given.folder.mkdir(parents=True, exist_ok=True)
    playpen = Playpen.load(given.playpen)
    for seed in range(given.seed, given.seed + given.runs):
        host = given.host or list(HOSTS)[seed % len(HOSTS)]
        path = given.folder / f"{playpen.name}_{host.replace(' ', '_')}_{seed}.mcap"
        began = time.perf_counter()
        truth = record(
            path,
            playpen,
            seed=seed,
            seconds=given.seconds,
            host=host,
            asks_counters=given.asks_counters,
            asks_light=given.asks_light,
            faults=given.fault,
            start=free_start(playpen, seed) if given.free_start else None,
        )
        path_m = float(np.hypot(*np.diff(truth.poses[:, :2], axis=0).T).sum())
        rate = given.seconds / (time.perf_counter() - began)
        print(f"{path}  {path_m:.1f} m driven, {rate:.0f} simulated s per s")


if __name__ == "__main__":
    main()
