"""Episodes in the plane on an NVIDIA card: `python -m benchmarks.card`, under eight minutes.

It prints, in parts that a limit of time may cut short:

    compare    1,000 random networks for a minute in each playpen, on the card and on the CPU: how many
               episodes are the same bits, and the same ranks
    speed      simulated seconds per second of the ROM's vehicle and of networks, by the number of episodes:
               of all, and of the card alone; and of the CPU's cores
    blocks     the same by the number of blocks that a multiprocessor runs at once
    kheperax   Kheperax on the same card in the same playpens, by the ROM's rule; --kheperax names its Python
    million    a million episodes of a minute, with their memory

Without a card: NUMBA_ENABLE_CUDASIM=1 python -m benchmarks.card --quick, which shows that it runs.
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
from khep_twin.machine import n_cores
from khep_twin.playpen import Playpen

NETWORK = Network(hidden=(5,), recurrent=True)
BEGUN = time.monotonic()
WAITING = Lock()
"""Lock that a launch waits for, so that its own time is measured."""


class Clock:
    """Time that the card has been busy [s]: of all launches, and of those that switch on, with transfers."""

    def __init__(self) -> None:
        self.all = self.switching_on = 0.0


@contextmanager
def clocked() -> Iterator[Clock]:
    """Measure the launches within."""
    clock, plain = Clock(), card_batch.CardBatch._launch

    def launch(self: Any, rows: Any, fresh: Any, untils: Any) -> None:
        with WAITING:
            begin = time.perf_counter()
            plain(self, rows, fresh, untils)
            took = time.perf_counter() - begin
        clock.all += took
        clock.switching_on += 0.0 if fresh is None else took

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
        both = [
            rollout(name, NETWORK, range(count), seconds, genes=genes(count), planar=True, device=device)
            for device in ("cuda", "cpu")
        ]
        ours, theirs = (each.metrics["obstacle_avoidance"] for each in both)
        registers = (both[0].registers == both[1].registers).all(axis=1).mean()
        poses = (both[0].poses == both[1].poses).all(axis=1).mean()
        apart = np.hypot(*(both[0].poses - both[1].poses)[:, :2].T) * 1000
        ranks = [np.argsort(np.argsort(each)) for each in (ours, theirs)]
        first = set(np.argsort(-ours)[:10]) == set(np.argsort(-theirs)[:10])
        print(
            f"  {name:14} same registers {100 * registers:.1f} %, poses {100 * poses:.1f} %, metric "
            f"{100 * (ours == theirs).mean():.1f} %; apart at most {apart.max():.3g} mm; Spearman "
            f"{np.corrcoef(*ranks)[0, 1]:.6f}; first ten {'the same' if first else 'others'}; "
            f"failures {len(both[0].failures)}, {len(both[1].failures)}",
            flush=True,
        )


def speed(name: str, driver: Driver, count: int, seconds: float, device: str = "cuda") -> float:
    """Print the speed of a batch; return the wall time [s]."""
    setup = EpisodeSetup(Playpen.load(name), planar=True)
    own = genes(count) if isinstance(driver, Network) else None
    with clocked() as clock:
        begin = time.perf_counter()
        rollout(setup, driver, range(count), seconds, genes=own, device=device)  # type: ignore[arg-type]
        took = time.perf_counter() - begin
    done, kind = count * seconds, "network" if isinstance(driver, Network) else "ROM"
    of_card = ""
    if device == "cuda":
        running = clock.all - clock.switching_on
        of_card = f"; card {done / running:12,.0f}, {running:.2f} s, transfers {clock.switching_on:.2f} s"
    where = device if device == "cuda" else f"{n_cores()} cores"
    print(f"  {name:14} {kind:8}{where:9}{count:8,} episodes: {done / took:12,.0f}{of_card}", flush=True)
    return took


def kheperax(python: str | None, sizes: tuple[int, ...], seconds: float) -> None:
    if (found := kheperax_python(python)) is None:
        print("\nkheperax: left out, as no Python with it was given")
        return
    print("\nkheperax: simulated s per s")
    for name in PLAYPENS:
        with Kheperax(found, Playpen.load(name), platform="cuda") as peer:
            for count in sizes:
                row = peer.row("", count, seconds)
                row.run()
                print(f"  {name:14} {count:8,} robots: {row.work / row.run().wall:12,.0f}", flush=True)


def million(count: int, seconds: float) -> None:
    free = cuda.current_context().get_memory_info().free
    took = speed("obstacles", NETWORK, count, seconds)
    used = (free - cuda.current_context().get_memory_info().free) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(
        f"  {took:.0f} s; {used:,.0f} MiB are kept on the card; the CPU has used {peak:,.0f} MiB, of them "
        f"{count * 8 * (80 + 3 + 7) / 2**20:,.0f} for results"
    )


def left(limit: float) -> float:
    return limit - (time.monotonic() - BEGUN)


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["compare", "speed", "blocks", "kheperax", "million"])
    parser.add_argument("--quick", action="store_true", help="a few episodes of a tenth of a second")
    parser.add_argument(
        "--limit", type=float, default=460.0, help="seconds after which no measurement begins"
    )
    parser.add_argument("--kheperax", metavar="PYTHON", help="a Python with Kheperax and JAX for CUDA")
    given = parser.parse_args(words)
    if missing := find_gpu_error():
        print(f"benchmarks.card: {missing}", file=sys.stderr)
        return 1
    seconds = 0.1 if given.quick else 60.0
    sizes = (2, 4) if given.quick else (1024, 4096, 16_384, 65_536, 262_144)
    name = getattr(cuda.get_current_device(), "name", "simulated")
    print(f"{name}, {n_cores()} cores")
    begin = time.perf_counter()
    rollout("obstacles", Braitenberg(), range(1), 0.1, planar=True, device="cuda")
    print(f"compiled or loaded in {time.perf_counter() - begin:.1f} s", *_resources())
    rollout("default", Braitenberg(), range(1), 0.1, planar=True)
    if "compare" in given.parts:
        compare(4 if given.quick else 1000, seconds)
    if "speed" in given.parts:
        print(f"\nspeed: simulated s per s, episodes of {seconds:g} s")
        for name in PLAYPENS:
            speed(name, NETWORK, sizes[1], seconds, device="cpu")
            for driver in (NETWORK, Braitenberg()):
                expected = 0.0
                for before, count in zip((1, *sizes), sizes, strict=False):
                    if expected * count / before > left(given.limit) / 4:
                        print(f"  {name:14} {count:,} episodes: left out")
                        break
                    expected = speed(name, driver, count, seconds)
    if "blocks" in given.parts:
        print("\nblocks at once on each multiprocessor, of 64 threads")
        plain, count = card.EPISODES_PER_PROCESSOR, 2 * card.EPISODES_PER_PROCESSOR * card.n_processors()
        for blocks in (1, 2, 4, 8):
            card.EPISODES_PER_PROCESSOR = blocks * card_batch.BLOCK_SIZE
            if left(given.limit) > 20:
                print(f"{blocks:3}", end="")
                speed("obstacles", NETWORK, min(count, sizes[-1]), seconds)
        card.EPISODES_PER_PROCESSOR = plain
    if "kheperax" in given.parts and left(given.limit) > 60:
        kheperax(given.kheperax, sizes[-2:], seconds)
    if "million" in given.parts:
        print("\nmillion")
        count = 8 if given.quick else 1_000_000
        if not given.quick and left(given.limit) < 120:
            print("  left out: there is no time for it; python -m benchmarks.card million --limit 3600")
        else:
            million(count, seconds)
    print(f"\n{time.monotonic() - BEGUN:.0f} s in all")
    return 0


def _resources() -> Iterator[str]:
    """Yield the registers and the memory of a thread of each compiled kernel."""
    if not kernel.SIMULATED:
        for made in kernel.kernel(2048).overloads.values():
            yield f"; {made.regs_per_thread} registers, {made.local_mem_per_thread} bytes of local memory"


if __name__ == "__main__":
    sys.exit(main())
