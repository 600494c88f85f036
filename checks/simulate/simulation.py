"""One simulation: a scenario under a seed, and its outcome."""

import gc
import random
import shutil
import tempfile
from collections.abc import Callable, Collection, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from unittest.mock import patch

from checks.simulate.clock_faults import disturb_clocks
from checks.simulate.faults import Faults, mixed
from checks.simulate.kernel import NS_PER_S, Kernel, Process
from checks.simulate.socket_module import SimulatedSocketModule
from checks.simulate.sockets import Network
from checks.simulate.system import System
from checks.simulate.threads import SimulatedQueue, SimulatedThreading
from khep_twin.errors import KhepTwinError

_COLLECTION_NS = 30 * NS_PER_S
"""Simulated time between two collections of cyclic garbage, which must not come amid a process [ns]."""


class Violation(AssertionError):
    """An invariant that does not hold.

    Attributes:
        invariant: Name of it.
    """

    def __init__(self, invariant: str, text: str) -> None:
        super().__init__(f"{invariant}: {text}")
        self.invariant = invariant


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a simulation.

    Attributes:
        scenario: Name of the scenario.
        seed: Seed.
        violation: Invariant that does not hold, and how; None if all hold.
        invariant: Name of it; empty if all hold.
        faults: Names of the faults that have happened.
        simulated_ns: Simulated time [ns].
        counts: Numbers of checks, by name.
    """

    scenario: str
    seed: int
    violation: str | None
    invariant: str
    faults: tuple[str, ...]
    simulated_ns: int
    counts: dict[str, int] = field(default_factory=dict)


class Simulation:
    """World of a scenario.

    Args:
        seed: Seed of everything.
        folder: Empty folder for its files.
        allowed: Names of the faults that happen; None for all.

    Attributes:
        faults: Faults.
        kernel: Kernel.
        network: TCP connections.
        system: Modules that the product's code uses.
        counts: Numbers of checks, by name, for the figures.
    """

    def __init__(self, seed: int, folder: Path, allowed: Collection[str] | None = None) -> None:
        self.seed, self.folder = seed, folder
        self.faults = Faults(seed, allowed)
        self.kernel = Kernel(seed, self.faults)
        self.network = Network(self.kernel, self.faults)
        self.system = System(self.kernel)
        self.system.modules |= {
            "socket": SimulatedSocketModule(self.kernel, self.network),
            "threading": SimulatedThreading(self.kernel),
            "queue": SimulatedQueue(self.kernel),
        }
        disturb_clocks(self.kernel, self.faults, self.system.modules["time"])
        self.counts: dict[str, int] = {}

    def rng(self, *names: str | int) -> random.Random:
        """Return the random generator of a name."""
        return random.Random(mixed(self.seed, *names))

    def count(self, name: str, number: int = 1) -> None:
        """Count checks by name."""
        self.counts[name] = self.counts.get(name, 0) + number

    def violate(self, invariant: str, text: str) -> NoReturn:
        """End the simulation with a violation of an invariant."""
        raise Violation(invariant, f"at {self.kernel.now_ns / NS_PER_S:.6f} s: {text}")

    def spawn(self, name: str, function: Callable[[], object], delay_ns: int = 0) -> Process:
        """Start a process whose errors must be KhepTwinErrors, in one line."""
        process = self.kernel.spawn(name, function, delay_ns)
        process.on_end = self.check_end
        return process

    def check_end(self, process: Process) -> None:
        """Check the error that has ended a process: one line that names the cause."""
        error = process.error
        if error is None:
            return
        if isinstance(error, Violation):
            raise error
        if not isinstance(error, KhepTwinError) or "\n" in str(error) or not str(error):
            raise Violation("errors", f"{process.name} ended by {error!r}") from error
        process.say(str(error))

    def run(self, seconds: float) -> None:
        """Run for a simulated time [s]."""
        end_ns = self.kernel.now_ns + round(seconds * NS_PER_S)
        while self.kernel.now_ns < end_ns:
            self.kernel.run(min(self.kernel.now_ns + _COLLECTION_NS, end_ns))
            # Between processes: objects close their descriptors when they are collected.
            gc.collect()


Scenario = Callable[[Simulation, float], None]
"""Function that sets a simulation up and runs it for so many simulated seconds."""


def simulate(
    name: str, scenario: Scenario, seed: int, seconds: float, allowed: Collection[str] | None = None
) -> Outcome:
    """Run a scenario under a seed; return its outcome.

    Raises:
        Exception: The simulation itself is at fault.
    """
    # The product's temporary folders are removed as well.
    with _folder() as folder, patch.object(tempfile, "tempdir", str(folder)), _collected_by_hand():
        simulation = Simulation(seed, folder, allowed)
        violation: Violation | None = None
        with simulation.system.installed():
            try:
                scenario(simulation, seconds)
            except Violation as found:
                violation = found
            finally:
                for process in simulation.kernel.processes:
                    process.on_end = None
                simulation.kernel.stop_all()
    return Outcome(
        name,
        seed,
        None if violation is None else str(violation),
        "" if violation is None else violation.invariant,
        tuple(simulation.faults.happened),
        simulation.kernel.now_ns - NS_PER_S,
        simulation.counts,
    )


@contextmanager
def _folder() -> Generator[Path]:
    """Make a folder for files, in memory if possible, and remove it."""
    shared = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="khep-simulate-", dir=shared if shared.is_dir() else None))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@contextmanager
def _collected_by_hand() -> Generator[None]:
    """Leave cyclic garbage to `Simulation.run`, which collects it at the same times under the same seed.

    Earlier objects stay out of all later collections: they are more than a simulation makes.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
