"""One robot of a served twin and the host at the far end of its cable."""

from collections.abc import Callable, Sequence

from khep_twin.ports.cable import IN_A_MOMENT, Cable, LineSettings
from khep_twin.ports.twin import Twin
from khep_twin.randomness import stream
from khep_twin.robot import Robot


class Connection:
    """Carries bytes between a robot's line and its cable, and watches how the host treats its end.

    Args:
        twin: the world of the robot.
        robot: at this end.
        cable: to the host.
        tell: takes what somebody should see.
        strict: garbles the bytes of a host whose speed is not the robot's.
    """

    def __init__(
        self, twin: Twin, robot: Robot, cable: Cable, tell: Callable[[str], None], strict: bool
    ) -> None:
        self._world = twin.world
        self._robot = robot
        self._cable = cable
        self._tell = tell
        self._noise = stream(twin.options.seed, "line", robot.name) if strict else None
        self._matched = True
        self._warned: set[LineSettings] = set()

    def descriptors(self) -> Sequence[int]:
        """What to wait for."""
        return self._cable.descriptors(self._robot.uart.room > 0)

    def events_ns(self) -> list[int]:
        """When the robot takes its next command and when its next byte arrives at the host [ns]."""
        times_ns = (self._robot.next_command_ns(), self._robot.uart.tx.next_ns)
        return [time_ns for time_ns in times_ns if time_ns is not None]

    def exchange(self, ready: set[int], now: Callable[[], int] | None = None) -> None:
        """Takes what the host has sent, and gives it what has arrived for it.

        Args:
            ready: descriptors that are readable.
            now: gives simulated time by the clock on the wall, behind which the world may lag a little [ns].
        """
        if not ready.isdisjoint(self._cable.descriptors(True)):
            self._take(now)
        self.give()

    def give(self) -> None:
        """Gives the host what has arrived for it."""
        reply = self._robot.uart.tx.read(self._world.time_ns)
        if reply and self._cable.occupied:
            self._cable.write(self._over_the_line(reply))

    def _take(self, now: Callable[[], int] | None) -> None:
        robot, cable = self._robot, self._cable
        gone, notices = cable.look()
        for notice in notices:
            self._note(notice)
        if data := cable.read(robot.uart.room):
            self._compare()
            robot.send(self._over_the_line(data), 0 if now is None else now())
        if gone and not cable.clear():
            self._note(IN_A_MOMENT)
        elif gone:
            # What it has sent still reaches the robot, as on a cable; what it has left behind is cleared.
            robot.hang_up()
            self._matched = True

    def _compare(self) -> None:
        """Looks whether the host has set its line as the robot's is; says so once for each way it has not."""
        settings, baud = self._cable.settings(), self._robot.firmware.baud
        self._matched = settings is None or settings.baud == baud
        if settings is None or settings in self._warned or (self._matched and settings.stop_bits == 2):
            return
        self._warned.add(settings)
        outcome = "garbled" if self._noise is not None and not self._matched else "taken all the same"
        self._note(
            f"the host has its line at {settings.baud} baud with {settings.stop_bits} stop bits, the robot's "
            f"has {baud} with 2; the bytes are {outcome}"
        )

    def _over_the_line(self, data: bytes) -> bytes:
        """Bytes as they arrive: unchanged, unless speeds differ and that is to be felt."""
        if self._matched or self._noise is None:
            return data
        errors = self._noise.integers(1, 256, len(data)).tolist()
        return bytes(byte ^ error for byte, error in zip(data, errors, strict=True))

    def _note(self, text: str) -> None:
        self._world.tell(self._robot.index, text)
        self._tell(f"{self._cable.path}: {text}")
