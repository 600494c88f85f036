"""A Khepera IV of a world: readings of its sensors, and the server on its serial line.

The stepping core runs it (`khepera4.core`). Its measurements are evaluated when a program, the server or a
log reads them.
"""

from khep_twin.robots.khepera4 import gauge
from khep_twin.robots.khepera4.dspic import N_MEMORY, N_ULTRASONIC, Dspic
from khep_twin.robots.khepera4.inertial import COUNTS_LIMIT, GYROSCOPE_NS
from khep_twin.robots.khepera4.model import SAMPLED
from khep_twin.robots.khepera4.motor_control import GAIN_SCALE, PWM_LIMIT
from khep_twin.robots.khepera4.registers import PACKET_SIZE, ULTRASONIC_CODES, DspicRegister
from khep_twin.robots.khepera4.server import Kh4Server
from khep_twin.robots.khepera4.state import BURST_NS, Khepera4State, fill_registers, write_distances
from khep_twin.robots.measuring_core import INFRARED, NONE, wheel_pulses
from khep_twin.robots.measuring_robot import MeasuringRobot
from khep_twin.robots.robot import RobotSetup
from khep_twin.simulation.number_reader import LARGEST
from khep_twin.simulation.robot_arrays import Layout, Part
from khep_twin.simulation.world_state import RobotSnapshot

_MOTOR = (
    Part("motor's position", 1, -(2**31), 2**31 - 1),
    Part("motor's speed", 1),
    Part("motor's pwm", 1, -PWM_LIMIT, PWM_LIMIT),
    Part("motor's flag of a target", 1, 0, 1),
    Part("motor's ramp", 1, -(2**15), 2**15),
    Part("motor's wait", 1, 0, 255),
    Part("motor's error", 1),
    Part("motor's sum of errors", 1, -PWM_LIMIT * GAIN_SCALE, PWM_LIMIT * GAIN_SCALE),
)

LAYOUT = Layout(
    1,
    {
        "dspic.memory": [Part("byte of the registers", N_MEMORY, 0, 255)],
        "dspic.motors": [*_MOTOR, *_MOTOR],
        "dspic.counts": [Part("pulses of an encoder", 2)],
        "dspic.powered": [Part("flag of the supply", 1, 0, 1)],
        "inertial.values": [Part("inertial value", 6 * PACKET_SIZE, -COUNTS_LIMIT, COUNTS_LIMIT - 1)],
        "inertial.lengths": [Part("length of an incomplete packet", 2, 0, PACKET_SIZE - 1)],
        "inertial.n_rates": [Part("samples of the gyroscope", 1, 0, LARGEST // GYROSCOPE_NS)],
        "inertial.velocity": [Part("velocity", 3)],
        "gauge": [
            Part("used charge", 1, 0, gauge.CAPACITY),
            Part("sum of currents", 1),
            Part("control periods of the sum", 1, 0, gauge.CURRENT_TICKS - 1),
            Part("measured current", 2),
        ],
        "zeros": [Part("zero of an encoder", 2)],
        "burst": [Part("last ultrasonic sensor", 1, NONE, N_ULTRASONIC - 1)],
        "distances": [Part("distance", N_ULTRASONIC, 0, max(ULTRASONIC_CODES))],
        "vehicle": [
            Part("flag of the vehicle", 2, 0, 1),
            Part("periods without motion", 1, 0),
            Part("vehicle's position", 2, -(2**31), 2**31 - 1),
        ],
    },
)
"""State of the robot in snapshots, besides the positions at the last burst."""


class Khepera4Robot(MeasuringRobot):
    """A Khepera IV of a world.

    Args:
        setup: See `Robot`.

    Attributes:
        dspic: Its microcontroller.
        registers: Values of `SAMPLED` at the last `refresh`.
    """

    sampled = SAMPLED
    layout = LAYOUT

    def __init__(self, setup: RobotSetup) -> None:
        state: Khepera4State = setup.context.simulation.robots.state_of(setup.index)
        self.dspic = Dspic(state.dspic)
        super().__init__(setup, Kh4Server(self.dspic, state.vehicle), fill_registers, BURST_NS)
        self.dspic.before_read = self._evaluate_pending

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state."""
        super().set_state(state)
        expected = self._context.time_ns // GYROSCOPE_NS
        if (count := self._state.inertial.n_rates[0]) > expected:
            raise ValueError(f"inertial.n_rates = {count}; expected at most {expected}")

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        leds = self.dspic.leds
        return [int(any(leds[start : start + 3])) for start in range(0, 9, 3)]

    def reset_motion(self) -> None:
        """Reset the dsPIC, and cut the motors' voltage."""
        self.dspic.reset()
        self._record["inertial"]["velocity"] = 0
        self._context.data.ctrl[list(self.indices.motors)] = 0.0
        angles = self._context.data.qpos[list(self.indices.wheel_qpos)]
        self._record["zeros"] = [wheel_pulses(self._state, angle) for angle in angles]
        self._record["dspic"]["counts"] = 0

    def evaluate_all(self) -> None:
        """Evaluate all pending measurements."""
        self._evaluate_pending(0, DspicRegister.BATTERY)

    def _evaluate_pending(self, first: int, end: int) -> None:
        """Evaluate pending measurements of the registers from `first` to before `end`."""
        if end > DspicRegister.AMBIENT and first < DspicRegister.ULTRASONIC:
            self._evaluate(INFRARED)
        if end > DspicRegister.ULTRASONIC and first < DspicRegister.ULTRASONIC_ENABLED:
            self._evaluate_echoes()
            write_distances(self._state, 1)
