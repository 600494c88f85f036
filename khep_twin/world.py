"""The world: one scene, its robots, and the one clock that both obey.

Time is an integer in nanoseconds. Physics advances in whole steps of 2.5 ms, the bytes on the serial lines
fall between them. `World.advance_to` is the only way in which time passes.
"""

import math
from functools import partial
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import calibration, kernel, units
from khep_twin.clock import n_steps
from khep_twin.errors import DivergedError
from khep_twin.firmware import Firmware
from khep_twin.kernel import DUTIES, LEFT, RIGHT, Board, Wheel
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.protocol import LINE_ENDS
from khep_twin.randomness import stream
from khep_twin.rom import ROMS
from khep_twin.sensors import InfraredScan
from khep_twin.supply import Supply
from khep_twin.turrets import find
from khep_twin.uart import Uart

SAMPLE_NS = units.SCAN_NS
"""How often taps are shown the world [ns]."""

_STEPS_PER_TICK = n_steps(units.TICK_NS, units.STEP_NS)
_STEPS_PER_SAMPLE = n_steps(SAMPLE_NS, units.STEP_NS)
REPLY_LIMIT = 256
"""Bytes of replies that wait to be sent before the firmware takes no more commands (assumed)."""

_FASTEST = 1000.0
"""What no joint in a playpen exceeds [m/s or rad/s]; beyond it the simulation has diverged."""


class Tap(Protocol):
    """Something that watches a world, such as a recorder."""

    def sample(self, world: "World") -> None:
        """Is shown the world every SAMPLE_NS, at its start too."""
        ...

    def wire(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Hears the bytes that crossed a robot's line, the last of them at `time_ns`."""
        ...

    def event(self, time_ns: int, robot: int | None, text: str) -> None:
        """Is told of something worth a note."""
        ...


class World:
    """A playpen brought to life.

    The robots are switched on a scan and a step before time 0, so that every register holds a conversion.

    Args:
        playpen: the scene.
        seed: of every chance in the run.
        noise: whether sensors are noisy.
        unpaced: lets bytes cross the lines in no time.

    Attributes:
        time_ns: how far time has come [ns].
        model: the compiled scene.
        data: its state.
        robots: in the playpen's order.
        taps: who watches.
    """

    def __init__(self, playpen: Playpen, *, seed: int = 0, noise: bool = True, unpaced: bool = False) -> None:
        # MuJoCo would write its warnings into a file where the user happens to be; they are checked here.
        mujoco.set_mju_user_warning(_keep_quiet)
        self.playpen = playpen
        self.spec = to_spec(playpen)
        self.model = self.spec.compile()
        self.data = mujoco.MjData(self.model)
        self.robots = tuple(
            Robot(self, index, seed if noise else None, unpaced) for index in range(len(playpen.robots))
        )
        self.taps: list[Tap] = []
        self.time_ns = 0
        self._steps = 0
        self._failure: DivergedError | None = None
        self._warnings: NDArray[np.int32] = self.data.warning.number
        self._places = self.data.xpos.ravel()
        self._limit = 1.0 + max(units.metres(playpen.arena.width_mm), units.metres(playpen.arena.height_mm))
        self._switch_on()

    def add_tap(self, tap: Tap) -> None:
        """Lets `tap` watch from now on; it is shown the world at once."""
        self.taps.append(tap)
        mujoco.mj_kinematics(self.model, self.data)
        tap.sample(self)

    def advance_to(self, time_ns: int) -> None:
        """Lets time pass until `time_ns` [ns].

        Each step of 2.5 ms runs in this order:

            1. bytes that arrive before its end are taken by the firmware, which answers from the registers
               of the last step
            2. physics, with the motor voltages of the last control tick
            3. one sensor of each robot is converted, as of the pose at the step's start
            4. after every fourth step the control tick: encoders, speed, controllers, duty, voltage
            5. after every eighth the taps are shown the world

        Raises:
            ValueError: `time_ns` lies in the past.
            DivergedError: the physics left its bounds, now or before.
        """
        if self._failure is not None:
            raise self._failure
        if time_ns < self.time_ns:
            raise ValueError(f"time cannot go back from {self.time_ns} to {time_ns} ns")
        while (end_ns := (self._steps + 1) * units.STEP_NS) <= time_ns:
            self._exchange(end_ns)
            self.time_ns = end_ns
            self._step()
        self._exchange(time_ns)
        self.time_ns = time_ns

    def tell(self, robot: int | None, text: str) -> None:
        """Passes a note on to the taps."""
        for tap in self.taps:
            tap.event(self.time_ns, robot, text)

    def _switch_on(self) -> None:
        # The rangefinders' first turn comes in the second step.
        mujoco.mj_step(self.model, self.data)
        for channel in range(units.N_SENSORS):
            mujoco.mj_step(self.model, self.data)
            for robot in self.robots:
                robot.convert(channel)
        for robot in self.robots:
            robot.zero_encoders()
            robot.measure_supply()
        self._check_state()
        self._check_warnings()

    def _exchange(self, time_ns: int) -> None:
        for robot in self.robots:
            if (next_ns := robot.uart.rx.next_ns) is not None and next_ns <= time_ns:
                robot.exchange(time_ns)

    def _step(self) -> None:
        channel = self._steps % units.N_SENSORS
        mujoco.mj_step(self.model, self.data)
        self._steps += 1
        for robot in self.robots:
            robot.convert(channel)
        if self._steps % _STEPS_PER_TICK == 0:
            self._check_state()
            for robot in self.robots:
                robot.tick()
        if self._steps % _STEPS_PER_SAMPLE == 0:
            self._check_warnings()
            for robot in self.robots:
                robot.show_leds()
            self._show()

    def _show(self) -> None:
        if self.taps:
            # A step leaves the bodies' places as of its start; the taps are shown them as of its end.
            mujoco.mj_kinematics(self.model, self.data)
            for tap in self.taps:
                tap.sample(self)

    def _check_warnings(self) -> None:
        """Refuses to go on after MuJoCo has warned."""
        if self._warnings.any():
            kind = mujoco.mjtWarning(int(np.flatnonzero(self._warnings)[0])).name
            raise self._diverged(f"MuJoCo warns of {kind}")

    def _check_state(self) -> None:
        """Refuses to go on with a state that is no physics any more."""
        # Sums of squares, because they are the quickest look that also meets what is not a number.
        places, speeds, joints = self._places, self.data.qvel, self.data.qpos
        fits = places.dot(places) <= len(places) * self._limit**2
        if not (fits and speeds.dot(speeds) <= len(speeds) * _FASTEST**2 and joints.dot(joints) < math.inf):
            raise self._diverged(
                f"something is {np.abs(places).max():g} m off, at {np.abs(speeds).max():g} m/s or rad/s"
            )

    def _diverged(self, reason: str) -> DivergedError:
        text = f"the simulation failed at {self.time_ns / 1e9:.4f} s, step {self._steps}: {reason}"
        self.tell(None, text)
        self._failure = DivergedError(text)
        return self._failure


class Robot:
    """One robot of a world: its board, its line and its place in the physics.

    Attributes:
        name: e.g. "khepera0".
        firmware: its command interpreter.
        uart: its serial line.
        registers: the board's state (N_REGISTERS,).
    """

    def __init__(self, world: World, index: int, noise_seed: int | None, unpaced: bool) -> None:
        model, data = world.model, world.data
        entry = world.playpen.robots[index]
        self.name = f"khepera{index}"
        turrets = {kind: kind.make() for kind in find(entry.turrets)}
        self.firmware = Firmware(ROMS[entry.rom], entry.mode, turrets)
        self._turret_bodies = [
            kind.fit(model, data, f"{self.name}/{kind.name}/", turret.registers)
            for kind, turret in turrets.items()
            if kind.fit is not None
        ]
        self.registers = self.firmware.registers
        self._cells = self.firmware.cells
        self.uart = Uart(0 if unpaced else self.firmware.baud)
        self._unpaced = unpaced
        self._world = world
        self._index = index
        self._left_angle, self._right_angle = (
            int(model.joint(f"{self.name}/{side}_axle").qposadr[0]) for side in ("left", "right")
        )
        self._left_motor, self._right_motor = (
            model.actuator(f"{self.name}/{side}_motor").id for side in ("left", "right")
        )
        self._supply = Supply(entry.battery_used_min)
        self._force: NDArray[np.float64] = data.actuator_force
        self._qpos: NDArray[np.float64] = data.qpos
        self._ctrl: NDArray[np.float64] = data.ctrl
        self._lights = [_Light(model, f"{self.name}/led_{led}") for led in range(len(_LEDS))]
        self._pose = int(model.joint(f"{self.name}/pose").qposadr[0])
        noise = None if noise_seed is None else partial(stream, noise_seed, "robot", index)
        self._scan = InfraredScan(model, data, f"{self.name}/", calibration.read(entry.calibration)[0], noise)

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] in the playpen."""
        x, y, _, qw, qx, qy, qz = self._qpos[self._pose : self._pose + 7].tolist()
        return x, y, math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))

    def send(self, data: bytes) -> None:
        """Puts bytes of the host on the line, now."""
        self.uart.rx.put(data, self._world.time_ns)

    def hang_up(self) -> None:
        """The host has gone: its whole commands are carried out unanswered, one just begun is forgotten."""
        time_ns = self._world.time_ns
        rx, tx = self.uart.rx, self.uart.tx
        if sent := rx.read(rx.arrival(len(rx)) or time_ns):
            self._tap(time_ns, True, sent)
            self.firmware.receive(sent)
        self.firmware.forget_line()
        tx.read(time_ns)
        for line in (rx, tx):
            line.take_back(time_ns)

    def next_command_ns(self) -> int | None:
        """When the firmware takes the next whole command [ns], None if there is none on the line.

        That is when it has arrived, and the replies before it have all but left.
        """
        rx, tx = self.uart.rx, self.uart.tx
        count = rx.count_to(*LINE_ENDS)
        arrival_ns = None if count is None else rx.arrival(count)
        if arrival_ns is None:
            return None
        return max(arrival_ns, tx.arrival(len(tx) - REPLY_LIMIT) or 0)

    def exchange(self, time_ns: int) -> None:
        """Lets the firmware take what arrives by `time_ns` and puts its answers on the line."""
        rx = self.uart.rx
        while (taken_ns := self.next_command_ns()) is not None and taken_ns <= time_ns:
            line = rx.read(taken_ns, rx.count_to(*LINE_ENDS))
            self._tap(taken_ns, True, line)
            answer = self.firmware.receive(line)
            if answer:
                self._tap(self.uart.tx.put(answer, taken_ns), False, answer)
            if not self._unpaced and self.firmware.baud != self.uart.tx.baud:
                # The tool `serial`, or a restart after it: from the next byte on.
                self.uart.rx.baud = self.uart.tx.baud = self.firmware.baud
        # Of a line that has not ended, what is there is taken at once; a whole one that waits stays whole.
        count = rx.arrived(time_ns)
        if taken_ns is None and count:
            arrival_ns = rx.arrival(count) or time_ns
            begun = rx.read(time_ns)
            self._tap(arrival_ns, True, begun)
            self.firmware.receive(begun)

    def convert(self, channel: int) -> None:
        """Converts one sensor of the scan."""
        kernel.convert(self._cells, *self._scan.convert(channel))

    def tick(self) -> None:
        """One control period: from encoders to motor voltages."""
        qpos, ctrl, cells = self._qpos, self._ctrl, self._cells
        left = units.wheel_pulses(qpos[self._left_angle])
        right = units.wheel_pulses(qpos[self._right_angle])
        voltage = self.measure_supply()
        if voltage < units.PROCESSOR_VOLTAGE and self.firmware.powered:
            self._brown_out(voltage)
        for body in self._turret_bodies:
            body.sense()
        self.firmware.tick(left, right)
        for body in self._turret_bodies:
            body.drive()
        ctrl[self._left_motor] = units.duty_voltage(cells[_LEFT_DUTY], voltage)
        ctrl[self._right_motor] = units.duty_voltage(cells[_RIGHT_DUTY], voltage)

    def show_leds(self) -> None:
        """Brings the lights of lit LEDs to the LEDs, those of unlit ones back into the body."""
        for led, light in zip(_LEDS, self._lights, strict=True):
            light.show(bool(self._cells[led]))

    def zero_encoders(self) -> None:
        """Makes the encoders start from where the wheels stand."""
        self.registers[LEFT + Wheel.ENCODER] = units.wheel_pulses(self._qpos[self._left_angle])
        self.registers[RIGHT + Wheel.ENCODER] = units.wheel_pulses(self._qpos[self._right_angle])

    def measure_supply(self) -> float:
        """Measures what feeds the robot and what it draws; returns the voltage [V]."""
        cells = self._cells
        voltage = self._supply.voltage(self._world.time_ns)
        current = units.IDLE_CURRENT
        for duty, motor in ((_LEFT_DUTY, self._left_motor), (_RIGHT_DUTY, self._right_motor)):
            current += units.supply_current(cells[duty], self._force[motor] / units.MOTOR_CONSTANT)
        kernel.measure(cells, units.supply_counts(voltage), round(current * 1000))
        return voltage

    def _brown_out(self, voltage: float) -> None:
        self.firmware.brown_out()
        self.uart.tx.take_back(self._world.time_ns)
        text = f"the supply fell to {voltage:.2f} V: the processor stands still, the motors keep their duty"
        self._world.tell(self._index, text)

    def _tap(self, time_ns: int, to_robot: bool, data: bytes) -> None:
        for tap in self._world.taps:
            tap.wire(time_ns, self._index, to_robot, data)


class _Light:
    """The light of one LED in the scene: a body without mass."""

    def __init__(self, model: mujoco.MjModel, led: str) -> None:
        self._position: NDArray[np.float64] = model.body_pos[model.body(led + "_light").id]
        self._hidden = self._position.copy()
        self._place: NDArray[np.float64] = model.site_pos[model.site(led).id]
        self._lit = False

    def show(self, lit: bool) -> None:
        """Puts it to its place or away."""
        if lit != self._lit:
            self._position[:] = self._place if lit else self._hidden
            self._lit = lit


def _keep_quiet(warning: str) -> None:
    """Leaves a warning to the check of MuJoCo's counters."""


_LEFT_DUTY, _RIGHT_DUTY = DUTIES
_LEDS = (int(Board.LED_0), int(Board.LED_1))
