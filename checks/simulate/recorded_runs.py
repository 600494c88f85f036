"""Runs of the product that record logs: in lock-step, served, relayed, and resumed from another log."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import quote

from checks.simulate.kernel import NS_PER_S
from checks.simulate.log_truth import Truth
from checks.simulate.simulation import Simulation
from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.errors import PlaypenError
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.interventions.switching import set_lamps, switch
from khep_twin.log.attached import playpen_of
from khep_twin.log.line_recorder import ROBOT, LineRecorder
from khep_twin.log.reader import read_label
from khep_twin.log.recorded import BranchPoint
from khep_twin.ports.branching import open_log
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.resume import run_end_ns
from khep_twin.ports.serve import PeriodicFlush
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.robots.model import Feature

PLAYPENS = "default", "default", "two-lamps", "gripper", "stripes", "looping-maze", "arena4"
"""Shipped playpens that are opened within 20 ms; two with turrets, one that sees, one with a Khepera IV."""

COMMANDS = (
    *(b"N\n", b"O\n", b"E\n", b"H\n", b"D,5,5\n", b"D,-3,7\r\n", b"D,0,0\n", b"L,0,2\n", b"G,0,0\n", b"B\n"),
    *(b"R\r\n", b"D,90,60\r\n", b"A,0\r\n", b"V,0\r\n", b"G\r\n"),
    *(b"T,2,N\n", b"T,1,G\n", b"X9\n", b"\n", b"K\r", b"N"),
)
"""Requests of a host: replies of all kinds, errors, and lines that end with the next command."""


@dataclass(slots=True)
class Run:
    """A run that is recorded.

    Attributes:
        number: Number of it, and its seed.
        path: Path of the finished log.
        truth: True content of it.
        duration: Simulated time of it [s].
        parent: Log that it resumes; None for a run from its start.
        failures: Lines about a log that cannot be written any more.
        goes_on: True if it continues without its log.
    """

    simulation: Simulation
    number: int
    path: Path
    truth: Truth
    duration: float
    parent: Path | None = None
    failures: list[str] | None = None
    goes_on: bool = False

    @property
    def clock(self) -> Any:
        """Module `time` of the simulation."""
        return self.simulation.system.modules["time"]

    @property
    def on_failure(self) -> Callable[[str], None] | None:
        """Function that takes the line about a log that fails; None to end the run."""
        self.failures = []
        return self.failures.append if self.goes_on else None

    def watch(self, twin: Twin) -> None:
        """Keep the true content of a twin's run from now on."""
        recorder = twin.recorder
        assert recorder is not None
        self.truth.failed = lambda: recorder.failure is not None
        self.truth.watch([robot.name for robot in twin.world.robots], twin.world)
        # A line that its parent's host has started is continued.
        transcript = recorder._transcript
        pieces = [(0, *rest) for rest in transcript.partial_lines] + transcript._received
        self.truth.resume(pieces)

    def lock_step(self) -> None:
        """Drive a twin of khep:// by a host in the same process."""
        rng = self.simulation.rng("run", self.number)
        path = quote(str(self.path))
        if self.parent is None:
            noise = rng.choice(("on", "off"))
            url = f"khep://{rng.choice(PLAYPENS)}?seed={self.number}&noise={noise}&log={path}"
        else:
            at_s = rng.uniform(0.1, run_end_ns(self.parent) / NS_PER_S)
            at = "" if rng.random() < 0.2 else f"at={at_s:.9f}&"
            fault = rng.choice(("", "&fault=drop:0.05", "&fault=stuck:2,weak:left:0.5"))
            if "stuck" in fault and not _has_kheperas(self.parent):
                fault = "&fault=late:0.1:30"
            url = f"khep://{quote(str(self.parent))}?{at}seed={self.number}&log={path}{fault}"
        if self.parent is not None and rng.random() < 0.3:
            port = Serial.of(self._edited(self.parent, rng), 0.5)
        else:
            port = Serial(timeout=0.5)
            port.port = url
            port.open()
        self.watch(port.twin)
        end_ns = port.time_ns + round(self.duration * NS_PER_S)
        while port.time_ns < end_ns:
            self.clock.sleep(10 ** rng.uniform(-3, 0.3))
            if rng.random() < 0.1:
                self._intervene(port.twin, rng)
            for _ in range(rng.randrange(8)):
                port.write(rng.choice(COMMANDS))
                if rng.random() < 0.9:
                    port.readline()
            if rng.random() < 0.05:
                rng.choice((port.reset_output_buffer, port.reset_input_buffer, port.flush, port.read))()
            self.simulation.count("bytes waiting", port.in_waiting + port.out_waiting)
            port.sleep(rng.uniform(0, 2))
        self._finish(port.close)

    def _edited(self, parent: Path, rng: Random) -> Twin:
        """Take up a log with its robot turned, which is another scene; or with another light."""
        edit = rng.choice(("robot.1.heading_deg=77", "lighting.room_lux=50", "robot.1.battery_used_min=30"))
        at_ns = max(round(run_end_ns(parent) * rng.uniform(0.1, 1.0)), 1)
        return open_log(parent, BranchPoint(at_ns, seed=self.number, edits=(edit,)), None, self.path)

    def served(self) -> None:
        """Advance a twin with the wall clock, and flush its log, as the serving loop does."""
        rng = self.simulation.rng("run", self.number)
        options = TwinOptions(seed=self.number, robot=None, noise=rng.random() < 0.5, vary=rng.random() < 0.3)
        twin = open_twin(rng.choice(PLAYPENS), options)
        twin.record(self.path, on_failure=self.on_failure)
        self.watch(twin)
        flush, turn = PeriodicFlush(twin.recorder), rng.uniform(0.01, 0.1)
        start_ns, end_ns = self.clock.monotonic_ns(), round(self.duration * NS_PER_S)
        while twin.world.time_ns < end_ns:
            self.clock.sleep(turn)
            wall_ns = self.clock.monotonic_ns()
            twin.advance_to(
                max(min(wall_ns - start_ns, twin.world.time_ns + NS_PER_S // 10), twin.world.time_ns)
            )
            if rng.random() < 0.2:
                twin.robot.send(rng.choice(COMMANDS))
            if rng.random() < 0.01:
                self._intervene(twin, rng)
            if rng.random() < 0.01:
                twin.robot.disconnect()
            flush()
            self.truth.turn(wall_ns, twin.world.time_ns)
        self._finish(twin.close)

    def relayed(self) -> None:
        """Record the line of a robot, as a relay does."""
        rng = self.simulation.rng("run", self.number)
        start_ns = self.clock.monotonic_ns()
        recorder = LineRecorder(
            self.path,
            {"relay": "/dev/ttyS0", "seed": self.number},
            lambda: self.clock.monotonic_ns() - start_ns,
            on_failure=self.on_failure,
        )
        self.truth.failed = lambda: recorder.failure is not None
        self.truth.watch([ROBOT])
        flush = PeriodicFlush(recorder)
        while (time_ns := self.clock.monotonic_ns() - start_ns) < self.duration * NS_PER_S:
            command = rng.choice(COMMANDS)
            for to_robot, data in ((True, command), (False, _reply(command, rng.randrange(1000)))):
                if data:
                    self.truth.on_bytes(time_ns, 0, to_robot, data)
                    recorder.on_bytes(to_robot, data)
                if to_robot:
                    event = HostEvent(HostEventKind.SEND, time_ns, None, data)
                    self.truth.on_host_event(time_ns, 0, event)
            if rng.random() < 0.01:
                self.truth.on_event(time_ns, 0, "the robot is connected")
                recorder.on_event("the robot is connected")
                self.truth.note_flush(time_ns)
            flush()
            self.truth.turn(self.clock.monotonic_ns(), time_ns)
            self.clock.sleep(rng.uniform(0.0, 0.2))
        self._finish(recorder.close)

    def _finish(self, close: Callable[[], None]) -> None:
        self.truth.closing = True
        close()
        if not self.truth.failed():
            self.truth.closed = True

    def _intervene(self, twin: Twin, rng: Any) -> None:
        """Intervene in a world as a user does."""
        world, index = twin.world, rng.randrange(len(twin.world.robots))
        act = rng.randrange(5)
        try:
            if act == 0:
                place_robot(
                    world, index, rng.uniform(50, 400), rng.uniform(50, 400), 90.0, reset=rng.random() < 0.5
                )
            elif act == 1 and world.lamps.names:
                switch(world, rng.randrange(len(world.lamps.names)), rng.random() < 0.5)
            elif act == 2:
                set_lamps(world, world.playpen.lamps[rng.randrange(2) :], world.playpen.lighting)
            elif act == 3:
                scan(world)
            else:
                world.log_event(rng.choice((None, index)), f"note {rng.randrange(1000)}")
        except PlaypenError:
            pass  # there is no room


def _has_kheperas(path: Path) -> bool:
    """Return whether all robots of a log are Kheperas, which may have faults of sensors and motors."""
    return all(
        Feature.LINE in robot.robot_model.features
        for robot in playpen_of(read_label(path).attachments, path).robots
    )


def _reply(command: bytes, number: int) -> bytes:
    """Return a reply in the form of a robot's."""
    counts = {b"N": 8, b"O": 8, b"E": 2, b"H": 2}.get(command[:1], 0)
    if command.startswith(b"T,2,N"):
        return b"t,2,n," + b",".join(b"%d" % (number % 256) for _ in range(64)) + b"\r\n"
    return b",".join([command[:1].lower(), *[b"%d" % number] * counts]) + b"\r\n" if command.strip() else b""
