"""Electronics of the gripper turret: orders of the T bus and the registers that they write and read.

    B        versions                              b,1,0
    D,state  opens (0) or closes (1) the fingers   d
    E,…      moves the arm to 152 (up) … 255       e
    F        resistivity of the gripped object     f,255 for an insulator … 0 for a short circuit
    G        light barrier between the fingers     g,0 for free … 255 for dark
    H,0      position of the fingers, to 200 open  h,…
    H,1      position of the arm, 152 … 255        h,…
    J        jumpers                               j,0

Orders and positions are from public host programs and simulators; the turret's manual is not available.
Fingers and arm move to their targets at a fixed speed. A position beyond 152 to 255 moves the arm to the
nearer end. A reset stops both at their present positions.
"""

from enum import IntEnum

import numpy as np

from khep_twin.board.kernel import clip
from khep_twin.board.protocol import PROTOCOL_ERROR, Malformed, parse_turret_order, turret_reply
from khep_twin.units import ARM_DOWN, ARM_UP, FINGERS_OPEN, GRIPPER_NUMBER

VERSION, REVISION = 1, 0
"""Version and revision in the reply to B (assumed), integers because hosts parse them as integers."""

FRACTION = 256
"""Resolution of the setpoints [1/position]."""

ARM_SPEED = 320
"""Speed of the arm [positions/256 per 10 ms]: from up to down in 0.82 s (assumed)."""

FINGER_SPEED = 512
"""Speed of the fingers [positions/256 per 10 ms]: from open to closed in a second (assumed)."""

_ARGUMENT_COUNTS = {"B": 0, "D": 1, "E": 1, "F": 0, "G": 0, "H": 1, "J": 0}


class Register(IntEnum):
    """Registers of the gripper."""

    ARM_TARGET = 0  # target of the arm [positions]
    ARM_SETPOINT = 1  # profile's setpoint [positions/256]
    ARM_POSITION = 2  # position of the arm
    FINGER_TARGET = 3
    FINGER_SETPOINT = 4
    FINGER_POSITION = 5
    BARRIER = 6  # 0 free to 255 dark
    RESISTIVITY = 7  # 255 for an insulator


_ARM_LIMIT = 1024
"""Limit of the arm's positions beyond its stops, which a collision exceeds: more than a full turn."""

RANGES: dict[int, tuple[int, int]] = {
    **dict.fromkeys((Register.ARM_TARGET, Register.ARM_POSITION), (-_ARM_LIMIT, _ARM_LIMIT)),
    Register.ARM_SETPOINT: (-_ARM_LIMIT * FRACTION, _ARM_LIMIT * FRACTION),
    **dict.fromkeys((Register.FINGER_TARGET, Register.FINGER_POSITION), (0, FINGERS_OPEN)),
    Register.FINGER_SETPOINT: (0, FINGERS_OPEN * FRACTION),
    **dict.fromkeys((Register.BARRIER, Register.RESISTIVITY), (0, 255)),
}
"""Range of each register."""


class GripperElectronics:
    """Electronics of the gripper, a `Turret`.

    Attributes:
        registers: State of the electronics (8,).
    """

    def __init__(self) -> None:
        self.registers = np.zeros(len(Register), np.int64)
        self.registers[[Register.ARM_POSITION, Register.FINGER_POSITION]] = ARM_UP, FINGERS_OPEN
        self.registers[Register.RESISTIVITY] = 255
        self._register_view = self.registers.data
        self.reset()

    def receive(self, message: bytes) -> bytes:
        """Execute an order; return its reply."""
        order = parse_turret_order(message, _ARGUMENT_COUNTS)
        if isinstance(order, Malformed):
            return order.reply
        view = self._register_view
        values: tuple[int, ...] = ()
        match order.letter, order.arguments:
            case "B", ():
                values = VERSION, REVISION
            case "D", (0 | 1 as closed,):
                view[Register.FINGER_TARGET] = 0 if closed else FINGERS_OPEN
            case "E", (position,):
                view[Register.ARM_TARGET] = min(max(position, ARM_UP), ARM_DOWN)
            case "F", ():
                values = (view[Register.RESISTIVITY],)
            case "G", ():
                values = (view[Register.BARRIER],)
            case "H", (0 | 1 as arm,):
                values = (view[Register.ARM_POSITION if arm else Register.FINGER_POSITION],)
            case "J", ():
                values = (0,)
            case _:
                return PROTOCOL_ERROR
        return turret_reply(GRIPPER_NUMBER, order.letter, *values)

    def tick(self) -> None:
        """Move both setpoints towards their targets."""
        self._approach(Register.ARM_SETPOINT, Register.ARM_TARGET, ARM_SPEED)
        self._approach(Register.FINGER_SETPOINT, Register.FINGER_TARGET, FINGER_SPEED)

    def reset(self) -> None:
        """Stop arm and fingers at their present positions."""
        view = self._register_view
        for position in (Register.ARM_POSITION, Register.FINGER_POSITION):
            target, setpoint = position - 2, position - 1
            view[target] = view[position]
            view[setpoint] = view[position] * FRACTION

    def _approach(self, setpoint: Register, target: Register, speed: int) -> None:
        view = self._register_view
        view[setpoint] += clip(view[target] * FRACTION - view[setpoint], speed)
