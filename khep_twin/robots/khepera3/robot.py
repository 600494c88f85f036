"""A Khepera III of a world: its bus, readings of its sensors, and the program on its serial line."""

from khep_twin.robots.khepera3 import state
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.letters import program_of
from khep_twin.robots.khepera3.model import SAMPLED
from khep_twin.robots.khepera3.motor_control import Pic
from khep_twin.robots.khepera3.registers import N_BYTES, SETTINGS
from khep_twin.robots.khepera3.state import BURST_NS, Khepera3State, fill_registers
from khep_twin.robots.measuring_core import INFRARED, NONE, wheel_pulses
from khep_twin.robots.measuring_robot import MeasuringRobot
from khep_twin.robots.robot import RobotSetup
from khep_twin.robots.vehicle import N_VEHICLE
from khep_twin.simulation.robot_arrays import Layout, Part

_MEMORY, _NUMBERS = Part("byte of a motor controller", N_BYTES, 0, 255), Part("number of a motor", len(Pic))

LAYOUT = Layout(
    1,
    {
        **{f"{side}.memory": [_MEMORY] for side in ("left", "right")},
        **{f"{side}.numbers": [_NUMBERS] for side in ("left", "right")},
        "board": [
            Part("flag of the supply", 1, 0, 1),
            Part("time of the dsPIC", 2),
            Part("state of an LED", 2, 0, 1),
            Part("setting", len(SETTINGS), 0, 0xFFFF),
        ],
        "burst": [Part("last ultrasonic sensor", 1, NONE, state.N_ULTRASONIC - 1)],
        "echoes": [Part("ultrasonic reading", state.N_ULTRASONIC * state.N_ECHO)],
        "battery": [Part("used charge", 1, 0, state.CAPACITY), Part("current", 2)],
        "vehicle": [Part("number of the vehicle", N_VEHICLE, -(2**31), 2**31)],
        "registers": [Part("register", SAMPLED[-1].registers[-1] + 1)],
    },
)
"""State of the robot in snapshots, besides the positions at the last burst."""


class Khepera3Robot(MeasuringRobot):
    """A Khepera III of a world.

    Args:
        setup: See `Robot`.

    Attributes:
        bus: Its devices.
        registers: Values of `SAMPLED` at the last `refresh`.
    """

    sampled = SAMPLED
    layout = LAYOUT

    def __init__(self, setup: RobotSetup) -> None:
        context, entry = setup.context, setup.context.playpen.robots[setup.index]
        robot: Khepera3State = context.simulation.robots.state_of(setup.index)
        self.bus = Bus(robot, entry.robot_model)
        super().__init__(setup, program_of(self.bus, entry.rom), fill_registers, BURST_NS)
        self.bus.dspic.before_read = self._evaluate_pending
        self.bus.dspic.time_ms = lambda: context.time_ns // 1_000_000

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        return [self._state.board[state.LEDS], self._state.board[state.LEDS + 1]]

    def reset_motion(self) -> None:
        """Reset the board and its program, and cut the motors' voltage."""
        self.firmware.reset()
        for motor, joint in zip((self._state.left, self._state.right), self.indices.wheel_qpos, strict=True):
            motor.numbers[Pic.PULSES] = wheel_pulses(self._state, self._context.data.qpos[joint])
        self._context.data.ctrl[list(self.indices.motors)] = 0.0

    def _evaluate_pending(self, letter: str) -> None:
        """Evaluate the pending measurements that a command reads, by its letter."""
        if letter == "G":
            self._evaluate_echoes()
        elif letter in "NO":
            self._evaluate(INFRARED)
