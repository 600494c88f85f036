"""Benchmarks of planar episodes on an NVIDIA GPU: `python -m benchmarks.card`, under eight minutes.

It prints, in parts that --limit may cut short:

    compare    1,000 random networks for a minute in each playpen, on the GPU and on the CPU: how many
               episodes are the same bits, and the same ranks
    speed      simulated seconds per second of the ROM's vehicle and of networks, by the number of episodes:
               of all, and of the GPU alone; and of the CPU's cores
    blocks     the same by the number of blocks that a multiprocessor runs together
    kheperax   Kheperax on the same GPU in the same playpens, by the ROM's rule; --kheperax names its Python
    million    a million episodes of a minute, with their memory

Without a GPU: NUMBA_ENABLE_CUDASIM=1 python -m benchmarks.card --quick, which tests that it runs.
"""

import argparse
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import numpy as np
from numba import cuda

from benchmarks.peers import Kheperax, kheperax_python
from benchmarks.scale import PLAYPENS
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Braitenberg, Driver, Floats, Network
from khep_twin.episodes.cuda import card, card_batch, kernel
from khep_twin.episodes.device import find_gpu_error
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen
from khep_twin.process.machine import n_cores

NETWORK = Network(hidden=(5,), recurrent=True)
START_S = time.monotonic()
WAITING = Lock()
"""Lock that each launch holds, so that only its time is measured."""


class Clock:
    """Time that the GPU has been busy [s]: of all launches, and of the starting ones, with transfers."""

    def __init__(self) -> None:
        self.all = self.switching_on = 0.0


@contextmanager
def measure_launches() -> Iterator[Clock]:
    """Measure the launches inside the block."""
    clock, plain = Clock(), card_batch.CardBatch._launch

    def launch(self: Any, rows: Any, fresh: Any, untils: Any) -> None:
        with WAITING:
            begin = time.perf_counter()
            plain(self, rows, fresh, untils)
            wall_s = time.perf_counter() - begin
        clock.all += wall_s
        clock.switching_on += 0.0 if fresh is None else wall_s

    card_batch.CardBatch._launch = launch
    try:
        yield clock
    finally:
        card_batch.CardBatch._launch = plain


def genes(count: int) -> Floats:
    return np.random.default_rng(7).normal(scale=1.5, size=(count, NETWORK.n_genes))


def compare(count: int, seconds: float) -> None:
    print(f"\ncompare: {count} networks, {seconds:g} s")
    for name in PLAYPENS:
        results = [
            rollout(name, NETWORK, range(count), seconds, genes=genes(count), planar=True, device=device)
            for device in ("cuda", "cpu")
        ]
        gpu_metric, cpu_metric = (result.metrics["obstacle_avoidance"] for result in results)
        registers = (results[0].registers == results[1].registers).all(axis=1).mean()
        poses = (results[0].poses == results[1].poses).all(axis=1).mean()
        distances_mm = np.hypot(*(results[0].poses - results[1].poses)[:, :2].T) * 1000
        ranks = [np.argsort(np.argsort(metric)) for metric in (gpu_metric, cpu_metric)]
        first = set(np.argsort(-gpu_metric)[:10]) == set(np.argsort(-cpu_metric)[:10])
        print(
            f"  {name:14} same registers {100 * registers:.1f} %, poses {100 * poses:.1f} %, metric "
            f"{100 * (gpu_metric == cpu_metric).mean():.1f} %; "
            f"apart at most {distances_mm.max():.3g} mm; Spearman {np.corrcoef(*ranks)[0, 1]:.6f}; "
            f"first ten {'the same' if first else 'others'}; "
            f"failures {len(results[0].failures)}, {len(results[1].failures)}",
            flush=True,
        )


def speed(name: str, driver: Driver, count: int, seconds: float, device: str = "cuda") -> float:
    """Print the speed of a batch; return the wall time [s]."""
    setup = EpisodeSetup(Playpen.load(name), planar=True)
    network_genes = genes(count) if isinstance(driver, Network) else None
    with measure_launches() as clock:
        begin = time.perf_counter()
        rollout(setup, driver, range(count), seconds, genes=network_genes, device=device)  # type: ignore[arg-type]
        wall_s = time.perf_counter() - begin
    simulated_s, kind = count * seconds, "network" if isinstance(driver, Network) else "ROM"
    of_card = ""
    if device == "cuda":
        running = clock.all - clock.switching_on
        of_card = (
            f"; card {simulated_s / running:12,.0f}, {running:.2f} s, transfers {clock.switching_on:.2f} s"
        )
    where = device if device == "cuda" else f"{n_cores()} cores"
    print(
        f"  {name:14} {kind:8}{where:9}{count:8,} episodes: {simulated_s / wall_s:12,.0f}{of_card}",
        flush=True,
    )
    return wall_s


def kheperax(python: str | None, sizes: tuple[int, ...], seconds: float) -> None:
    if (interpreter := kheperax_python(python)) is None:
        print("\nkheperax: left out, as no Python with it was given")
        return
    print("\nkheperax: simulated s per s")
    for name in PLAYPENS:
        with Kheperax(interpreter, Playpen.load(name), platform="cuda") as peer:
            for count in sizes:
                row = peer.row("", count, seconds)
                row.run()
                print(f"  {name:14} {count:8,} robots: {row.work / row.run().wall:12,.0f}", flush=True)


def million(count: int, seconds: float) -> None:
    free = cuda.current_context().get_memory_info().free
    wall_s = speed("obstacles", NETWORK, count, seconds)
    used = (free - cuda.current_context().get_memory_info().free) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(
        f"  {wall_s:.0f} s; {used:,.0f} MiB are kept on the card; the CPU has used {peak:,.0f} MiB, of them "
        f"{count * 8 * (80 + 3 + 7) / 2**20:,.0f} for results"
    )


def remaining_s(limit: float) -> float:
    return limit - (time.monotonic() - START_S)


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["compare", "speed", "blocks", "kheperax", "million"])
    parser.add_argument("--quick", action="store_true", help="a few episodes of a tenth of a second")
    parser.add_argument(
        "--limit", type=float, default=460.0, help="seconds after which no measurement starts"
    )
    parser.add_argument("--kheperax", metavar="PYTHON", help="a Python with Kheperax and JAX for CUDA")
    options = parser.parse_args(words)
    if missing := find_gpu_error():
        print(f"benchmarks.card: {missing}", file=sys.stderr)
        return 1
    seconds = 0.1 if options.quick else 60.0
    sizes = (2, 4) if options.quick else (1024, 4096, 16_384, 65_536, 262_144)
    name = getattr(cuda.get_current_device(), "name", "simulated")
    print(f"{name}, {n_cores()} cores")
    begin = time.perf_counter()
    rollout("obstacles", Braitenberg(), range(1), 0.1, planar=True, device="cuda")
    print(f"compiled or loaded in {time.perf_counter() - begin:.1f} s", *_resources())
    rollout("default", Braitenberg(), range(1), 0.1, planar=True)
    if "compare" in options.parts:
        compare(4 if options.quick else 1000, seconds)
    if "speed" in options.parts:
        print(f"\nspeed: simulated s per s, episodes of {seconds:g} s")
        for name in PLAYPENS:
            speed(name, NETWORK, sizes[1], seconds, device="cpu")
            for driver in (NETWORK, Braitenberg()):
                expected = 0.0
                for before, count in zip((1, *sizes), sizes, strict=False):
                    if expected * count / before > remaining_s(options.limit) / 4:
                        print(f"  {name:14} {count:,} episodes: left out")
                        break
                    expected = speed(name, driver, count, seconds)
    if "blocks" in options.parts:
        print("\nblocks at once on each multiprocessor, of 64 threads")
        plain, count = card.EPISODES_PER_PROCESSOR, 2 * card.EPISODES_PER_PROCESSOR * card.n_processors()
        for blocks in (1, 2, 4, 8):
            card.EPISODES_PER_PROCESSOR = blocks * card_batch.BLOCK_SIZE
            if remaining_s(options.limit) > 20:
                print(f"{blocks:3}", end="")
                speed("obstacles", NETWORK, min(count, sizes[-1]), seconds)
        card.EPISODES_PER_PROCESSOR = plain
    if "kheperax" in options.parts and remaining_s(options.limit) > 60:
        kheperax(options.kheperax, sizes[-2:], seconds)
    if "million" in options.parts:
        print("\nmillion")
        count = 8 if options.quick else 1_000_000
        if not options.quick and remaining_s(options.limit) < 120:
            print("  left out: there is no time for it; python -m benchmarks.card million --limit 3600")
        else:
            million(count, seconds)
    print(f"\n{time.monotonic() - START_S:.0f} s in all")
    return 0


def _resources() -> Iterator[str]:
    """Yield the registers and the memory of a thread of each compiled kernel."""
    if not kernel.SIMULATED:
        for code in kernel.kernel(2048).overloads.values():
            yield f"; {code.regs_per_thread} registers, {code.local_mem_per_thread} bytes of local memory"


if __name__ == "__main__":
    sys.exit(main())
