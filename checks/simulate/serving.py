"""Scenario of a served pseudo-terminal: good hosts one after another, and those that it must withstand."""

import os
import random
from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from unittest.mock import patch

from checks.simulate.kernel import NS_PER_S, Process
from checks.simulate.networking import Site, visit
from checks.simulate.serving_mutants import MUTANTS as MUTANTS
from checks.simulate.simulation import Scenario, Simulation
from checks.simulate.terminal_hosts import TerminalHost
from checks.simulate.terminals import Terminal, Terminals
from checks.simulate.truth import Truth
from khep_twin.ports import pty
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.serve import WIRE_SPEED
from khep_twin.ports.service_registry import registered_ports

DISTURBING = "stall", "suspend", "kill", "server-stop", "slow transit", "slow closing"
"""Kinds of faults that may delay a reply beyond the timeout of the host library."""

_MOMENT_NS = NS_PER_S // 10
"""Time before its opening in which a host may cross another [ns]."""


class ServedTerminal(Site):
    """A twin served at a pseudo-terminal, with a link and a note in the list of servers."""

    def __init__(self, simulation: Simulation, terminals: Terminals) -> None:
        self._terminals = terminals
        self._notices: list[tuple[int, str]] = []
        self.link = simulation.folder / "khepera"
        super().__init__(simulation, rfc2217=False)
        self.is_exact, self.garbles = True, False
        self.speed = simulation.rng("clock").choice([1.0, 0.25, WIRE_SPEED, WIRE_SPEED])

    @property
    def url(self) -> str:
        """Path that hosts open."""
        return str(self.link)

    def may_fail(self) -> bool:
        """Return whether a host of the library may be disturbed: by a fault, or by another host."""
        return not self.simulation.faults.kinds.isdisjoint(DISTURBING) or not self.is_private()

    def is_private(self) -> bool:
        """Return whether no other host can have got replies to the present one, nor it theirs."""
        return self.is_alone() and not self.may_have_crossed()

    def is_serving(self, truth: Truth) -> bool:
        """Return whether the server that this is the truth of runs, and is not about to stop."""
        return truth is self.truth and self.server is not None and self.server.alive and not self._stopping

    def is_alone(self) -> bool:
        """Return whether no host but the present process has had the terminal open since it opened it."""
        process, terminal = self._process(), self._terminal()
        if terminal is None or self.server is None:
            return False
        if process not in terminal.openings:
            # It may be kept out by a lock of one that has it open.
            return not self.other_openings()[1]
        openings = terminal.openings[terminal.openings.index(process) :]
        return all(opener in (process, self.server) for opener in [*openings, *terminal.met[process]])

    def other_openings(self) -> tuple[int, bool]:
        """Return how often other hosts than the present one have opened it, and whether one has it open."""
        expected, terminal = (self._process(), self.server), self._terminal()
        if terminal is None:
            return 0, False
        n_openings = sum(opener not in expected for opener in terminal.openings)
        return n_openings, any(file.process not in expected for file in terminal.hosts)

    def may_have_crossed(self) -> bool:
        """Return whether the server has reported mixed hosts since the present process came."""
        began_ns = self._process().began_ns - _MOMENT_NS
        return any(time_ns >= began_ns and pty._MIXED_NOTICE in text for time_ns, text in self._notices)

    def rogues(self) -> None:
        """Send hosts that the terminal must withstand, mostly while no other is there."""
        simulation, rng = self.simulation, self.simulation.rng("rogues")
        time, faults = simulation.system.modules["time"], simulation.faults
        while True:
            time.sleep(rng.uniform(0.5, 8.0))
            if faults.happens("rogue", "rogues", 1.0):
                number = self.number()
                host = TerminalHost(simulation, self, number, faults.drawn("rogue", "rogues"))
                process = simulation.spawn(f"rogue{number}", host.rogue)
                process.mortal = True
                simulation.count("rogues")

    def _raw(self, number: int, rng: random.Random) -> TerminalHost:
        return TerminalHost(self.simulation, self, number, rng)

    @contextmanager
    def _endpoint(self, baud: int) -> Generator[HostPort]:
        with PtyPort(self.link, baud) as port, registered_ports([port.path], "twin"):
            yield port

    def _check_rest(self) -> None:
        """Check that a server that has ended leaves no link, lock, or note."""
        lock, notes = self.link.with_name(f".{self.link.name}.lock"), Path(os.environ["XDG_RUNTIME_DIR"])
        left = [path for path in (self.link, lock, *notes.glob("khep_twin/*")) if os.path.lexists(path)]
        if left:
            self.simulation.violate("leftovers", f"the server leaves {', '.join(map(str, left))}")

    def _notice(self, text: str) -> None:
        self._notices.append((self.simulation.kernel.now_ns, text))
        super()._notice(text)

    def _process(self) -> Process:
        process = self.simulation.kernel.current
        assert process is not None
        return process.leader

    def _terminal(self) -> Terminal | None:
        device = self.simulation.system.devices.get(os.path.realpath(self.link))
        return device if isinstance(device, Terminal) else None


def serve(simulation: Simulation, seconds: float) -> None:
    """Hosts at a served pseudo-terminal."""
    terminals = Terminals(simulation)
    with terminals.installed(), run_time_folder(simulation):
        visit(ServedTerminal(simulation, terminals), seconds)


def run_time_folder(simulation: Simulation) -> AbstractContextManager[object]:
    """Make the folder for the notes of servers; return the context in which they are found there."""
    folder = simulation.folder / "run"
    folder.mkdir(mode=0o700)
    return patch.dict(os.environ, XDG_RUNTIME_DIR=str(folder))


SCENARIOS: dict[str, Scenario] = {"serve": serve}
