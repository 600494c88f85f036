"""Scenarios of hosts: at TCP and RFC 2217 ports of a served twin, and in lock-step with in-process twins."""

import random
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from unittest.mock import patch

import khep_twin.host.final_stop
from checks.simulate.hosts import Session, ending
from checks.simulate.kernel import NS_PER_S, Process
from checks.simulate.network_mutants import MUTANTS as MUTANTS
from checks.simulate.raw_hosts import Raw
from checks.simulate.simulation import Scenario, Simulation
from checks.simulate.truth import SESSIONS, Truth
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.network import TcpPort
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.serve import WIRE_SPEED, serve
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

_PLAYPENS = "default", "obstacles", "gripper", "stripes"

_RADIO = str(Path(__file__).with_name("radio.toml"))
"""Playpen of a robot with a radio."""

_SHARE_RADIO = 0.2
"""Share of twins with a radio."""

_NUMBER = 5000
"""Number of the port."""

_LONGEST_TURN_NS = 200 * NS_PER_S
"""Longest time without another host on the line [ns]: that of a session and of hosts that hold the port."""

_MOST_DROPPED, _MOST_GARBLED = 0.02, 0.01
"""Highest probabilities that a converter loses or garbles a byte of a segment."""


def _playpen(rng: random.Random, radio: random.Random) -> str:
    """Draw the playpen of a twin: sometimes one with a radio, by a separate generator."""
    usual = rng.choice(_PLAYPENS)
    return _RADIO if radio.random() < _SHARE_RADIO else usual


class Site:
    """A served twin, its server, and the hosts that come to it.

    Attributes:
        truth: Exchanges on the twin's line since its server was started.
        server: Process of the server.
    """

    most_files = 3
    """Most descriptors that a server has open."""

    def __init__(self, simulation: Simulation, *, rfc2217: bool) -> None:
        self.simulation = simulation
        rng = simulation.rng("site")
        self._rng, self._rfc2217 = rng, rfc2217
        self.playpen = _playpen(rng, simulation.rng("radio"))
        self.speed = rng.choice([1.0, 1.0, 1.0, WIRE_SPEED])
        self._options = TwinOptions(seed=rng.randrange(1000), unpaced=rng.random() < 0.2)
        faults = simulation.faults
        drops, garbles = faults.rate("drop", _MOST_DROPPED) > 0, faults.rate("garble", _MOST_GARBLED) > 0
        # One bad converter in four.
        self.is_exact = not (drops or garbles) or rng.random() < 0.75
        self.garbles = garbles and not self.is_exact
        if not self.is_exact:
            simulation.network.spoil = self._spoil
        self.server: Process | None = None
        self.truth: Truth
        self._sessions = 0
        self._stopping = False
        self.endings: dict[str, list[Callable[[], object]]] = {}
        self._last, self._last_ns = -1, simulation.kernel.now_ns
        self._start()

    @property
    def url(self) -> str:
        """URL that hosts open."""
        return f"{'rfc2217' if self._rfc2217 else 'socket'}://127.0.0.1:{_NUMBER}"

    def is_private(self) -> bool:
        """Return whether all bytes of the robot reach the present host unchanged."""
        return self.is_exact

    def may_fail(self) -> bool:
        """Return whether a fault has happened that may disturb a host."""
        return bool(self.simulation.faults.kinds)

    # Server --------------------------------------------------------------------------------------------

    def _start(self) -> None:
        twin = open_twin(self.playpen, self._options)
        twin.world.compile()
        self.truth = Truth(self.simulation, twin, is_exact=self.is_exact)
        self._start_server(lambda: self._serve(twin))

    def _serve(self, twin: Twin) -> None:
        """Serve a twin until the server is to stop."""
        with self._endpoint(twin.robot.firmware.baud) as port:
            serve(twin, [port], self.speed, stop=lambda: self._stopping, notify=self._notice)

    def _start_server(self, work: Callable[[], object]) -> None:
        """Start the process of the server, which must leave nothing behind when its work is done."""
        self._stopping = False

        def run() -> None:
            work()
            process = self.simulation.kernel.current
            if process is not None and process.files:
                self.simulation.violate("leftovers", f"the server leaves {len(process.files)} descriptors")
            self._check_rest()

        self.server = self.simulation.spawn("server", run)
        self.server.mortal = True
        self.server.on_end = self._ended

    def _endpoint(self, baud: int) -> AbstractContextManager[HostPort]:
        """Open the port that hosts come to."""
        return closing(TcpPort("127.0.0.1", _NUMBER, rfc2217=self._rfc2217, baud=baud))

    def _check_rest(self) -> None:
        """Check that a server that has ended leaves no other remains."""

    def _ended(self, process: Process) -> None:
        self.simulation.check_end(process)
        self.simulation.count("servers")
        kernel = self.simulation.kernel
        kernel.at(kernel.now_ns + self._rng.randrange(NS_PER_S // 100, 5 * NS_PER_S), self._start)

    def _notice(self, text: str) -> None:
        self.simulation.count("notices")
        if "\n" in text or not text:
            self.simulation.violate("errors", f"the server reported {text!r}")

    def watch(self) -> None:
        """Stop the server now and then, and watch its descriptors: a process of the scenario."""
        simulation, time = self.simulation, self.simulation.system.modules["time"]
        while True:
            time.sleep(1.0)
            if simulation.faults.happens("server-stop", "server", 0.02):
                self._stopping = True
            self.look()

    def look(self) -> None:
        """Check each second that hosts are let in, and that the server opens no more and more files."""
        simulation, server = self.simulation, self.server
        if self.truth.exchanges and self.truth.exchanges[-1].session != self._last:
            self._last, self._last_ns = self.truth.exchanges[-1].session, simulation.kernel.now_ns
        if simulation.kernel.now_ns - self._last_ns > _LONGEST_TURN_NS:
            simulation.violate("answers", f"no host was let in for {_LONGEST_TURN_NS / NS_PER_S:.0f} s")
        if server is not None and server.alive and len(server.files) > self.most_files:
            simulation.violate("leftovers", f"the server has {len(server.files)} descriptors open")

    def _spoil(self, name: str, to_server: bool, data: bytes) -> bytes:
        """Return a segment as a bad converter passes it on."""
        faults = self.simulation.faults
        for kind, max_rate in (("drop", _MOST_DROPPED), ("garble", _MOST_GARBLED)):
            if faults.happens(kind, name, max_rate) and data:
                rng = faults.drawn(kind, name)
                at = rng.randrange(len(data))
                changed = bytes([data[at] ^ 1 << rng.randrange(8)]) if kind == "garble" else b""
                data = data[:at] + changed + data[at + 1 :]
        return data

    # Hosts ---------------------------------------------------------------------------------------------

    def number(self) -> int:
        """Return the number of a new session."""
        self._sessions = self._sessions % (SESSIONS - 300) + 1
        return self._sessions

    def hosts(self) -> None:
        """Start hosts one after another, each in a separate process; a process of the scenario."""
        simulation, rng = self.simulation, self.simulation.rng("hosts")
        time, ended = simulation.system.modules["time"], simulation.system.modules["threading"].Event()

        def host_ended(process: Process) -> None:
            simulation.check_end(process)
            ended.set()

        while True:
            number = self.number()
            host_rng = simulation.rng("host", number)
            if host_rng.random() < 0.4:
                process = simulation.spawn(f"raw{number}", self._raw(number, host_rng).good)
            else:
                process = simulation.spawn(f"host{number}", lambda: self._library(number, host_rng))  # noqa: B023
                process.mortal = True
            ended.clear()
            process.on_end = host_ended
            ended.wait()
            if simulation.faults.happens("quick", "hosts", 0.5):
                time.sleep(simulation.faults.drawn("quick", "hosts").choice([0.0, 1e-5, 1e-4, 1e-3, 1e-2]))
            else:
                time.sleep(rng.choice([0.1, 0.5, 2.0]))

    def _raw(self, number: int, rng: random.Random) -> Raw:
        return Raw(self.simulation, _NUMBER, lambda: self.truth, number, rng, self.is_private, self.may_fail)

    def _library(self, number: int, rng: random.Random) -> None:
        simulation, kernel = self.simulation, self.simulation.kernel
        process = kernel.current
        assert process is not None
        name = "hosts"
        session = Session(
            simulation,
            self.url,
            lambda: self.truth,
            number,
            rng,
            # In a slow twin replies also take longer: an image of 250 bytes 1.1 s at a quarter of the speed.
            {"timeout": rng.choice([1.0, 1.0, 2.0]) / min(self.speed or 1.0, 1.0)},
            self.is_private,
            self.may_fail,
            garbles=self.garbles,
            moves=self.speed != WIRE_SPEED,
        )
        if simulation.faults.happens("exception", name, 0.3):
            session.ending = ending(simulation.faults.drawn("exception", name))
        if simulation.faults.happens("interrupt", name, 0.3):
            after_s = simulation.faults.drawn("interrupt", name).uniform(0.01, 10)
            error = KeyboardInterrupt()
            at_ns = kernel.now_ns + round(after_s * NS_PER_S)
            kernel.at(at_ns, lambda: kernel.interrupt(process, error) if session.is_driving else None)
        if simulation.faults.happens("terminate", name, 0.2):
            first_fault = len(simulation.faults.happened)
            session.on_hang = lambda: kernel.at(
                kernel.now_ns + NS_PER_S, lambda: self._terminate(process, session, first_fault)
            )
        session.run(rng.randint(1, 30))
        if process.files:
            simulation.violate("leftovers", f"{process.name} leaves {len(process.files)} descriptors")
        if any(thread.alive for thread in process.threads):
            simulation.violate("leftovers", f"{process.name} leaves a thread")

    def _terminate(self, process: Process, session: Session, first_fault: int) -> None:
        """End a process that hangs as `process.signals` does: clean-up in another thread, then the end.

        Its motors must stand if the faults since its start, from the number `first_fault`, are harmless.
        """
        clear = self.endings.get(process.name, [])
        if not process.alive or not clear:
            return
        truth = self.truth
        thread = self.simulation.kernel.spawn_thread(clear[0], process)

        def leave() -> None:
            was_done = thread.alive is False and thread.error is None
            self.simulation.kernel.kill(process)
            if was_done and not self.simulation.faults.disturbing(first_fault) and truth is self.truth:
                self.simulation.count("stops from outside")
                if not truth.has_stopped(session.number):
                    self.simulation.violate(
                        "motors", f"host {session.number} was ended, and the motors run on"
                    )

        self.simulation.kernel.at(self.simulation.kernel.now_ns + 7 * NS_PER_S // 10, leave)

    def rogues(self) -> None:
        """Send hosts that a port must withstand: a process of the scenario."""
        simulation, rng = self.simulation, self.simulation.rng("rogues")
        time, faults = simulation.system.modules["time"], simulation.faults
        while True:
            time.sleep(rng.uniform(0.2, 4.0))
            for fault in ("rogue", "vanish"):
                if faults.happens(fault, "rogues", 1.0):
                    raw = self._raw(self.number(), faults.drawn(fault, "rogues"))
                    kind = raw.vanishes if fault == "vanish" else None
                    simulation.spawn(f"rogue{raw.number}", partial(raw.rogue, kind))
                    simulation.count("rogues")


def visit(site: Site, seconds: float) -> None:
    """Have hosts come to a site, and watch it, for so many simulated seconds."""
    simulation = site.simulation

    def register_cleanup(clear: Callable[[], object]) -> Callable[[], object]:
        process = simulation.kernel.current
        clears = site.endings.setdefault("" if process is None else process.name, [])
        clears.append(clear)
        return lambda: clears.remove(clear) if clear in clears else None

    with patch.object(khep_twin.host.final_stop, "register_cleanup", register_cleanup):
        for name in ("hosts", "rogues", "watch"):
            simulation.spawn(name, getattr(site, name), NS_PER_S // 10)
        simulation.run(seconds)


def tcp(simulation: Simulation, seconds: float) -> None:
    """Hosts at a TCP port."""
    visit(Site(simulation, rfc2217=False), seconds)


def rfc2217(simulation: Simulation, seconds: float) -> None:
    """Hosts at an RFC 2217 port."""
    visit(Site(simulation, rfc2217=True), seconds)


def lockstep(simulation: Simulation, seconds: float) -> None:
    """Hosts of twins in the same process, one after another."""
    rng = simulation.rng("lockstep")
    time = simulation.system.modules["time"]

    def program() -> None:
        number = 0
        while True:
            number += 1
            # The time of the twin passes for all other processes as well.
            time.sleep(max(_lockstep_session(simulation, rng, number), 0.5))

    simulation.spawn("host", program)
    simulation.run(seconds)


def _lockstep_session(simulation: Simulation, rng: random.Random, number: int) -> float:
    """Run a host with a twin in its process; return the time of the twin [s]."""
    session_rng = simulation.rng("lockstep", number)
    query = {
        "seed": str(session_rng.randrange(1000)),
        "noise": session_rng.choice(["on", "off"]),
        "vary": session_rng.choice(["on", "off"]),
    }
    auto = session_rng.random() < 0.2
    if auto:
        query["mode"] = session_rng.choice("1237")
    if session_rng.random() < 0.3:
        query["unpaced"] = "on"
    elif session_rng.random() < 0.3:
        query["strict_line"] = "on"
    if session_rng.random() < 0.3:
        query["model"] = "khepera2"
    elif session_rng.random() < 0.3:
        query["rom"] = "4.06"
    faults = [
        make_fault(simulation.faults.drawn(kind, "lockstep"))
        for kind, make_fault in _LINE_FAULTS.items()
        if simulation.faults.happens(kind, "lockstep", 0.5)
    ]
    if faults:
        query["fault"] = ",".join(faults)
    url = f"khep://{_playpen(session_rng, simulation.rng('radio', number))}?" + "&".join(
        f"{key}={value}" for key, value in query.items()
    )
    truths: list[Truth] = []
    kinds = {fault.partition(":")[0] for fault in faults}
    is_exact = not kinds & {"drop", "garble"}
    connect_port = Serial._connect

    def connect(port: Serial, twin: Twin) -> None:
        connect_port(port, twin)
        twin.world.compile()
        truths.append(Truth(simulation, twin, is_exact=is_exact))

    session = Session(
        simulation,
        url,
        lambda: truths[-1] if truths else None,
        number % SESSIONS,
        session_rng,
        {
            "timeout": session_rng.choice([1.0, 2.0]),
            "baudrate": "auto" if auto else 9600,
            "retries": session_rng.choice([0, 1, 1, 3]),
        },
        lambda: True,
        lambda: bool(faults),
        garbles="garble" in kinds,
    )
    if simulation.faults.happens("exception", "lockstep", 0.3):
        session.ending = ending(simulation.faults.drawn("exception", "lockstep"))
    with patch.object(Serial, "_connect", connect):
        session.run(session_rng.randint(1, 30))
    return truths[-1].time_s if truths else 0.0


_LINE_FAULTS: dict[str, Callable[[random.Random], str]] = {
    "line-drop": lambda rng: f"drop:{rng.uniform(0.001, 0.06):.4f}",
    "line-garble": lambda rng: f"garble:{rng.uniform(0.001, 0.02):.4f}",
    "line-late": lambda rng: f"late:{rng.uniform(0.01, 0.3):.3f}:{rng.choice([60, 600, 1200])}",
}
"""Faults of a twin's line, by their kinds here."""

SCENARIOS: dict[str, Scenario] = {"tcp": tcp, "rfc2217": rfc2217, "lockstep": lockstep}
