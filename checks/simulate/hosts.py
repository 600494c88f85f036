"""Host programs with the real host library: a user's script, and the ways in which it ends."""

import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from checks.simulate.kernel import Killed
from checks.simulate.simulation import Simulation
from checks.simulate.truth import Truth, tag
from khep_twin.errors import KhepTwinError, MoveError, PortError, PortTimeout, ProtocolError
from khep_twin.host import Gripper, Khepera, Radio, Vision, commands
from khep_twin.host.commands import HostCommand
from khep_twin.host.vision import read_image, read_light, read_region
from khep_twin.units import RadioStatus

READS = "position", "proximity", "ambient", "speed", "versions"
"""Commands that a good host reads by."""

_ZEROS = re.compile(r"(?<![\d.])0+(?=\d)")
"""Zeros before a number, as in a line that has lost a digit."""


class Program(Exception):
    """Exception of a user's program."""


@dataclass(slots=True)
class Session:
    """One session of a host of the library.

    Args:
        simulation: Simulation.
        url: URL of the port.
        truth: Exchanges on the line of the twin.
        number: Number of the session.
        rng: Random generator of its actions.
        options: Options of `Khepera`.
        is_exact: Whether the robot's replies currently reach the library as they are in `truth`.
        may_fail: Function that returns whether the line may currently fail.
        garbles: Whether bytes may be garbled, so that a wrong command or value cannot be detected.
        ending: Exception that ends it amid its work; None to complete it.
        moves: Whether time passes for the robot, so that moves are completed.
        on_hang: Function called when the program hangs, with its motors on; None if it does not hang.
        is_driving: True amid its work.
        persists: Whether it continues after an error.
    """

    simulation: Simulation
    url: str
    truth: Callable[[], Truth | None]
    number: int
    rng: random.Random
    options: dict[str, Any]
    is_exact: Callable[[], bool]
    may_fail: Callable[[], bool]
    garbles: bool = False
    ending: BaseException | None = None
    moves: bool = True
    on_hang: Callable[[], object] | None = None
    is_driving: bool = False
    persists: bool = False

    def run(self, count: int) -> None:
        """Open the port, perform `count` actions, and leave; check all values and errors."""
        ends = self.ending is not None or self.on_hang is not None
        end_at = self.rng.randrange(count) if ends else count
        error: BaseException | None = None
        is_open = False
        truth: Truth | None = None
        try:
            with Khepera(self.url, **self.options) as robot:
                is_open, truth = True, self.truth()
                assert truth is not None
                self.is_driving = True
                try:
                    self._work(robot, truth, count, end_at)
                finally:
                    self.is_driving = False
                    self._heed()
        except Killed:
            raise
        except (KhepTwinError, KeyboardInterrupt, Program) as found:
            error = found
        try:
            self._check_end(error, truth, is_open)
        finally:
            # Its traceback has this frame, which would keep the port until the next collection of cycles.
            del error

    def _work(self, robot: Khepera, truth: Truth, count: int, end_at: int) -> None:
        rng = self.rng
        self.persists = rng.random() < 0.5
        reply = robot.ask(tag(self.number))
        if self.number not in truth.tags and self.is_exact() and not self.may_fail():
            self.simulation.violate("replies", f"{tag(self.number)!r} at first was answered {reply!r}")
        for index in range(count):
            if index == end_at:
                if self.ending is not None:
                    robot.set_speed(rng.randint(1, 20), rng.randint(1, 20))
                    raise self.ending
                if self.on_hang is not None:
                    robot.set_speed(rng.randint(1, 20), rng.randint(1, 20))
                    self.on_hang()
                    robot.sleep(1e6)
            try:
                self._perform_action(robot, truth)
            except (PortTimeout, ProtocolError, MoveError) as error:
                # Some programs continue where others end.
                self._check_error(error)
                if not self.persists:
                    raise
            self.simulation.count("things")

    def _heed(self) -> None:
        """Raise the exception of a signal that came before the port is closed."""
        process = self.simulation.kernel.current
        if process is not None and process.thrown is not None:
            error, process.thrown = process.thrown, None
            raise error

    def _check_end(self, error: BaseException | None, truth: Truth | None, is_open: bool) -> None:
        simulation, text = self.simulation, str(error)
        simulation.count("sessions")
        notes = getattr(error, "__notes__", ())
        if isinstance(error, KhepTwinError):
            simulation.count("errors")
            self._check_error(error)
        elif error is not None:
            simulation.count("interrupted")
        lines = [text, *notes]
        if any("may still run" in line for line in lines) or not is_open:
            return
        simulation.count("stops")
        if truth is None or truth is not self.truth() or self.garbles or not self.is_exact():
            return
        if not truth.has_stopped(self.number):
            simulation.violate("motors", f"host {self.number} has left ({error!r}), and the motors run on")

    def _check_error(self, error: KhepTwinError) -> None:
        """Check that an error is one line that names the port, and that there was a reason for it."""
        simulation, text = self.simulation, str(error)
        kinds = (PortError, ProtocolError, MoveError)
        if not isinstance(error, kinds) or "\n" in text or not text.startswith(self.url):
            simulation.violate("errors", f"{error!r} of a host at {self.url}")
        if isinstance(error, MoveError):
            return
        if not self.may_fail():
            simulation.violate("answers", f"a host on a sound line got {error!r}")

    # Actions -------------------------------------------------------------------------------------------

    def _perform_action(self, robot: Khepera, truth: Truth) -> None:
        rng = self.rng
        match rng.randrange(20):
            case 0 | 1 | 2:
                self.read(robot, truth, _command(rng.choice(READS)))
            case 3:
                self.read(robot, truth, *(_command(rng.choice(READS)) for _ in range(rng.randint(2, 9))))
            case 4 | 5:
                robot.set_speed(rng.randint(-20, 20), rng.randint(-20, 20))
            case 6 | 7 | 8:
                robot.sleep(rng.choice([0.01, 0.1, 0.5, 3.0]))
            case 9 | 16 | 17 | 18 | 19:
                self._set_position(robot, truth)
            case 10:
                robot.status()
                robot.converter(rng.randrange(7))
            case 11:
                robot.set_led(rng.randrange(2), rng.randrange(3))
                robot.read_bus(rng.randrange(64))
            case 12 if self.moves:
                robot.move(rng.uniform(-0.05, 0.05), timeout=10.0)
            case 13 if self.moves:
                robot.turn(rng.uniform(-1, 1), timeout=10.0)
            case 14:
                robot.configure_speed_controller(3800, 800, 100)
                robot.configure_position_controller(3000, 20, 4000)
                robot.configure_profile(20, 64, 20, 64)
                robot.set_duty(rng.randint(-40, 40), rng.randint(-40, 40))
            case _:
                self._use_turret(robot, truth)

    def read(self, robot: Khepera, truth: Truth, *requested: HostCommand[Any]) -> None:
        """Read values, and check that the robot has sent them since the request."""
        first = len(truth.exchanges)
        values = robot.burst(*requested)
        if truth is not self.truth() or not self.is_exact():
            return
        for command, value in zip(requested, values, strict=True):
            self.simulation.count("values")
            suffix = ",".join(map(str, value)) if isinstance(value, tuple) and not self.garbles else ""
            suffix = _ZEROS.sub("", suffix)  # of a version that lost bytes
            if not any(
                _reads(command, exchange.reply) == value
                and _ZEROS.sub("", exchange.reply.rstrip()).endswith(suffix)
                for exchange in truth.exchanges[first:]
            ):
                replies = [exchange.reply for exchange in truth.exchanges[first:]]
                self.simulation.violate(
                    "replies", f"{command.request!r} returned {value}, but the robot has sent {replies}"
                )

    def _set_position(self, robot: Khepera, truth: Truth) -> None:
        """Set the counters to values that no other command has, and check that it was done once at most."""
        left, right = self.rng.randint(-4_000_000, 4_000_000), self.rng.randint(-4_000_000, 4_000_000)
        try:
            robot.set_position(left, right)
        finally:
            n_times = sum(exchange.request == f"G,{left},{right}" for exchange in truth.exchanges)
            if n_times > 1:
                self.simulation.violate("counters", f"'G,{left},{right}' was carried out {n_times} times")

    def _use_turret(self, robot: Khepera, truth: Truth) -> None:
        """Use each kind of turret; a missing one is a ProtocolError that names the port."""
        rng = self.rng
        kind = rng.choice([Gripper, Radio, Vision])
        try:
            turret = kind(robot)
        except ProtocolError as error:
            if not str(error).startswith(robot.name):
                self.simulation.violate("errors", f"{error!r} of a host at {robot.name}")
            return
        if isinstance(turret, Gripper):
            if self.moves:
                rng.choice([turret.lower, turret.lift, turret.open, turret.close])()
                turret.wait(timeout=10.0)
            values = turret.arm(), turret.fingers(), turret.barrier(), turret.resistivity()
            if not self.may_fail() and not all(0 <= value <= 255 for value in values):
                self.simulation.violate("replies", f"the gripper has {values}")
        elif isinstance(turret, Radio):
            if turret.status() & RadioStatus.READY:
                turret.send(rng.randint(1, 3), rng.randbytes(rng.randint(0, 16)))
            turret.receive()
            if self.moves:
                turret.wait_until_sent()
                turret.broadcast(b"all")
                try:
                    turret.wait_for_message(0.1)
                except PortTimeout as error:
                    if "no message came" not in str(error):
                        raise
        else:
            self.read(robot, truth, read_image(), read_light(), read_region(rng.randint(0, 48), 16))
            turret.set_period(rng.randrange(8))
            for ask in (
                turret.brightest,
                turret.darkest,
                turret.every_second,
                turret.every_fourth,
                turret.coarse,
            ):
                ask()


def ending(rng: random.Random) -> BaseException:
    """Return an exception by which a program ends amid its work."""
    return rng.choice([KeyboardInterrupt(), Program("a mistake\nin two lines")])


def _command(name: str) -> HostCommand[Any]:
    return getattr(commands, name)()


def _reads(command: HostCommand[Any], reply: str) -> Any:
    try:
        return command.read(reply.rstrip("\r\n"))
    except ValueError:
        return None
