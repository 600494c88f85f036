"""Scenario `relay`: hosts at the relay to a real robot, whose cable and battery fail, with a log of the line.

The relay is that of `khep-twin serve --relay` and, with its polls, of `khep-twin shadow --relay`. A twin in a
process that is never suspended plays the robot.
"""

import re
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import patch

from checks.simulate.cable import Cable, RobotEnd
from checks.simulate.kernel import NS_PER_S, Process
from checks.simulate.line_logs import LineLog
from checks.simulate.networking import Site, visit
from checks.simulate.relay_mutants import MUTANTS as MUTANTS
from checks.simulate.serving import DISTURBING, ServedTerminal, run_time_folder
from checks.simulate.simulation import Scenario, Simulation
from checks.simulate.terminals import Terminals
from checks.simulate.truth import Truth
from khep_twin.board.uart import HostEvent
from khep_twin.cli import endpoints, options
from khep_twin.cli.endpoints import EndpointOptions
from khep_twin.cli.option_groups import LogOptions
from khep_twin.errors import PortError
from khep_twin.ports.serve import serve
from khep_twin.ports.twin import open_twin

_BAUD = 9600
"""Speed of the robot's line [baud]."""

_MOST_UNPLUGGED, _MOST_SWITCHED_OFF = 0.02, 0.02
"""Highest probabilities within a second."""

_NOTICED_NS = 60 * NS_PER_S
"""Time within which a relay ends that is to stop, or whose cable is gone, whatever holds it up [ns]."""

_SETTLED_NS = 5 * NS_PER_S
"""Time after a disturbance of the line from which on it is as if there had been none (assumed) [ns]."""

_ROGUES_NS = 150 * NS_PER_S
"""Time after the coming of a host that a port must withstand in which it may matter to others [ns]."""

_POLL = -2
"""Session of a relay's polls."""

_FAILED = re.compile(r"the robot's port failed: .+|cannot open this port: No such file or directory")


class LineTruth(Truth):
    """Exchanges on the line of a robot behind a relay, with its polls, which end in a carriage return."""

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Take bytes of the line."""
        for piece in re.split(rb"(?<=\r)", data) if to_robot else [data]:
            count = len(self.exchanges)
            super().on_bytes(time_ns, robot, to_robot, piece)
            if to_robot and len(self.exchanges) > count and piece.endswith(b"\r"):
                self.exchanges[-1].session = _POLL

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Ignore events: the robot cannot see hosts come and go."""


class _Relayed(Site):
    """A robot at a cable and its relay, in place of a served twin: mixed into a kind of site."""

    most_files = 12

    endpoint: EndpointOptions

    def _start(self) -> None:
        """Start the relay, and before the first one the robot."""
        if not hasattr(self, "cable"):
            self.cable = Cable(self.simulation, f"{self.simulation.folder}/dev/ttyUSB0", _BAUD)
            self.polls = self.simulation.rng("polls").random() < 0.4
            self._robot: Process | None = None
            self._stopping_ns = 0
            self._log = LineLog(self.simulation, self.cable)
            self._switch_on()
        self._log.begin()
        self._start_server(self._relay)

    def _relay(self) -> None:
        logging = LogOptions(log=self._log.path)
        polls = (b"N\r", b"H\r") if self.polls else ()  # a host's requests have another end of line
        endpoints.relay_robot(
            self.cable.path, _BAUD, self.endpoint, logging, poll_requests=polls, stop=self._is_to_stop
        )

    def _is_to_stop(self) -> bool:
        """Return whether the relay is to stop; called at the begin of each turn of its loop."""
        self._log.turn()
        return self._stopping

    def _switch_on(self) -> None:
        twin = open_twin(self.playpen, self._options)
        twin.world.compile()
        self.truth = LineTruth(self.simulation, twin, is_exact=True)
        self.cable.touch()

        def run() -> None:
            end = RobotEnd(self.cable, process)
            serve(twin, [end], 1.0, stop=lambda: False, notify=self._notice)

        self._robot = process = self.simulation.spawn("robot", run)
        process.outside = True

    # Faults and checks of each second ------------------------------------------------------------------

    def look(self) -> None:
        """Disturb cable and robot now and then; check that the relay notices it."""
        simulation, kernel, cable = self.simulation, self.simulation.kernel, self.cable
        faults, now_ns = simulation.faults, self.simulation.kernel.now_ns
        if cable.away_ns is None and faults.happens("unplug", "cable", _MOST_UNPLUGGED):
            cable.unplug()
            duration_s = 10 ** faults.drawn("unplug", "cable").uniform(-1, 2)
            kernel.at(now_ns + round(duration_s * NS_PER_S), cable.plug)
        robot = self._robot
        if robot is not None and faults.happens("power", "robot", _MOST_SWITCHED_OFF):
            duration_s = 10 ** faults.drawn("power", "robot").uniform(-1, 1.3)
            self._robot = None
            kernel.at(now_ns, lambda: kernel.kill(robot))
            kernel.at(now_ns + round(duration_s * NS_PER_S), self._switch_on)
        self._stopping_ns = (self._stopping_ns or now_ns) if self._stopping else 0
        is_served = self.server is not None and self.server.alive
        if is_served and self._stopping_ns and now_ns - self._stopping_ns > _NOTICED_NS:
            simulation.violate("leftovers", "the relay was to stop, and continues")
        away_ns = cable.away_ns
        if is_served and away_ns is not None and now_ns - away_ns > _NOTICED_NS and self._log.is_begun:
            simulation.violate("errors", "the cable is gone, and the relay continues without a line about it")
        if self._is_touched_since(now_ns) or not is_served:
            self._last_ns = now_ns
        super().look()

    def _ended(self, process: Process) -> None:
        """Check why the relay has ended, and its log; the next one starts on a line with remains."""
        self.cable.touch()
        error = process.error
        if isinstance(error, PortError):
            path = self.cable.path
            text = str(error).removeprefix(f"{path}: ")
            unplugged = "unplug" in self.simulation.faults.kinds
            if text == str(error) or not _FAILED.match(text) or not unplugged:
                self.simulation.violate("errors", f"the relay ended by: {error}")
            self.simulation.count("cables lost")
        kernel = self.simulation.kernel
        ended_well = error is None and not process.dying
        kernel.at(
            kernel.now_ns, lambda: self._log.check(is_complete=ended_well or isinstance(error, PortError))
        )
        super()._ended(process)

    # Questions of hosts --------------------------------------------------------------------------------

    def may_fail(self) -> bool:
        """Return whether a host of the library may be disturbed."""
        kinds = self.simulation.faults.kinds
        return not kinds.isdisjoint(DISTURBING) or not self.is_private() or self._rogues_were_here()

    def is_private(self) -> bool:
        """Return whether all bytes of the robot reach the present host unchanged."""
        return not self._is_touched() and super().is_private()

    def is_serving(self, truth: Truth) -> bool:
        """Return whether the relay runs, and is not about to stop, on a line that is as it should be."""
        server = self.server
        running = server is not None and server.alive and not self._stopping
        return truth is self.truth and running and not self._is_touched()

    def _is_touched(self) -> bool:
        """Return whether the line was disturbed a while before the present process came, or later."""
        process = self.simulation.kernel.current
        return process is None or self._is_touched_since(process.leader.began_ns)

    def _is_touched_since(self, time_ns: int) -> bool:
        return self._robot is None or self.cable.touched_ns > time_ns - _SETTLED_NS

    def _rogues_were_here(self) -> bool:
        kernel = self.simulation.kernel
        return any(
            process.name.startswith(("rogue", "child"))
            and (process.alive or process.began_ns > kernel.now_ns - _ROGUES_NS)
            for process in kernel.processes
        )


class RelayedTerminal(_Relayed, ServedTerminal):
    """A robot behind a relay with a terminal."""

    def __init__(self, simulation: Simulation, terminals: Terminals) -> None:
        self.endpoint = EndpointOptions(link=str(simulation.folder / "khepera"))
        super().__init__(simulation, terminals)
        self.speed = 1.0


class RelayedNetwork(_Relayed):
    """A robot behind a relay with a network port."""

    def __init__(self, simulation: Simulation, *, rfc2217: bool) -> None:
        address = "127.0.0.1:5000"
        self.endpoint = EndpointOptions(**{"rfc2217" if rfc2217 else "tcp": address})
        super().__init__(simulation, rfc2217=rfc2217)
        self.speed = 1.0


def relay(simulation: Simulation, seconds: float) -> None:
    """Hosts at a relay, by a terminal, by TCP or by RFC 2217."""
    terminals = Terminals(simulation)
    kind = simulation.rng("relay").choice(("terminal", "terminal", "tcp", "rfc2217"))
    with terminals.installed(), run_time_folder(simulation), _relay_notices(simulation) as tell:
        if kind == "terminal":
            site: Site = RelayedTerminal(simulation, terminals)
        else:
            site = RelayedNetwork(simulation, rfc2217=kind == "rfc2217")
        tell.append(site._notice)
        visit(site, seconds)


@contextmanager
def _relay_notices(simulation: Simulation) -> Generator[list[Callable[[str], None]]]:
    """Collect the relay's notices to its user."""
    takers: list[Callable[[str], None]] = []

    def echo(text: str, **_: object) -> None:
        for taker in takers:
            taker(text.rstrip("\n"))

    typer = SimpleNamespace(echo=echo)
    with patch.object(endpoints, "typer", typer), patch.object(options, "typer", typer):
        yield takers


SCENARIOS: dict[str, Scenario] = {"relay": relay}
