"""A Scout of a world, and the program on its line."""

from khep_twin.robots.line_server import LineServer
from khep_twin.robots.model import consecutive_registers
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.simulation.robot_arrays import Layout, Part
from khep_twin.simulation.world_state import RobotSnapshot
from khep_twin.step import Reason
from second_robot.core import CAPACITY, FULL, N_FLAGS, N_SONAR, NONE, POWERED, TIMES
from second_robot.model import BATTERY, LABELS, LEDS, N_REGISTERS, ORDERS, READS, SCOUT, SETPOINT

REGISTERS, FLAGS = [Part("register", N_REGISTERS, -(2**31), 2**31 - 1)], [Part("flag", 2, 0, 1)]
LEVELS = [Part("used charge", 1, 0, CAPACITY), Part("voltage of a motor", 2, -FULL, FULL)]


class ScoutProgram(LineServer):
    """The program on the line, which a low supply ends."""

    robot: "ScoutRobot"

    @property
    def powered(self) -> bool:
        return bool(self.robot.flags[POWERED])

    def receive(self, data: bytes) -> bytes:
        return super().receive(data) if self.powered else b""

    def reset(self) -> bytes:
        self.robot.reset_motion()
        return super().reset()


class ScoutRobot(Robot):
    """A Scout of a world."""

    sampled = consecutive_registers(LABELS)
    layout = Layout(
        1, {"registers": REGISTERS, "flags": [*FLAGS, Part("time", N_SONAR, NONE)], "levels": LEVELS}
    )

    def __init__(self, setup: RobotSetup) -> None:
        record = setup.context.simulation.robots.record_of(setup.index)
        self.registers, self.flags, self._first_moment = (
            record["registers"],
            record["flags"],
            record["first_moment"],
        )
        program = ScoutProgram(SCOUT.dialect, self.execute)
        program.robot = self
        super().__init__(setup, program)
        setup.context.observers.evaluations.append(self.evaluate)

    @property
    def lit_leds(self) -> list[int]:
        return [int(self.registers[LEDS:BATTERY].any())]

    def reset_motion(self) -> None:
        self.registers[SETPOINT : SETPOINT + 2] = 0

    def act_after(self, reason: int) -> None:
        super().act_after(reason)
        if reason == Reason.STOPPED and not self.flags[POWERED] and not self._has_stopped:
            self._has_stopped = True
            self.stop_processor()
            self._context.observers.on_event(self.index, "the battery is empty")

    def evaluate(self) -> None:
        """Evaluate the recorded bursts."""
        for sensor in range(N_SONAR):
            if self.flags[TIMES + sensor] != NONE:
                moment, context = int(self._first_moment) + sensor, self._context
                context.simulation.evaluate(self.index, sensor, moment, context.moments)

    def readings(self) -> dict[str, list[int]]:
        self.evaluate()
        return super().readings()

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        self.evaluate()
        return super().state(since_ns)

    def set_state(self, state: RobotSnapshot) -> None:
        super().set_state(state)
        if self.flags[POWERED] == state.is_stopped or (self.flags[TIMES:N_FLAGS] != NONE).any():
            raise ValueError(f"flags = {self.flags}; expected a powered or a stopped robot, without bursts")

    def execute(self, request: bytes) -> bytes:
        """Return the reply to a request."""
        word, *texts = request.decode("latin-1").split() or [""]
        numbers = [200, 3, 2, 1] if word == "id" else [-1]
        if word in READS and not texts:
            self.evaluate()
            numbers = self.registers[slice(*READS[word])].tolist()
        elif word in ORDERS:
            first, count, low, high = ORDERS[word]
            values = [int(text) for text in texts if text.isascii() and text.removeprefix("-").isdecimal()]
            if len(values) == len(texts) == count and all(low <= value <= high for value in values):
                self.registers[first : first + count], numbers = values, [0]
        return " ".join(map(str, numbers)).encode() + b"\r\n"
