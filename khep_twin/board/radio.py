"""Electronics of the radio turret: orders of the T bus and the registers that they write and read.

    B                        versions                                             b,1,0
    F                        status bits, `units.RadioStatus`                     f,1 for ready to send
    R                        reads and removes the oldest received message        r,sender,length,16 bytes
    S,to,length,16 bytes     sends a message to a radio number, -1 for all        s

Orders, replies and the first three status bits are those of a public simulator, KiKS. Numbers of radios,
acknowledgement, repetition and length are those of K-Team's manual of the radio base (1999). The turret's
manual is not available. Without a received message R reads zeros: no radio turret has the number 0. An order
S is refused while a message is sent.

A reset drops the message that is sent and all received ones.
"""

from enum import IntEnum

import numpy as np

from khep_twin.board.protocol import PROTOCOL_ERROR, Malformed, parse_turret_order, refusal, turret_reply
from khep_twin.units import RADIO_ALL, RADIO_BYTES, RADIO_NUMBER, RadioStatus

VERSION, REVISION = 1, 0
"""Version and revision in the reply to B (simulators)."""

TRANSMISSIONS = 4
"""Most transmissions of a message without acknowledgement (assumed; the manual says "a maximum number")."""

CAPACITY = 4
"""Most received messages in the buffer (assumed)."""

NUMBER_LIMIT = 255
"""Largest number of a radio (assumed: a byte)."""

ENTRY_SIZE = 2 + RADIO_BYTES
"""Registers of a received message: sender, length and bytes."""

BUSY = refusal("Radio is sending")
"""Reply to S while a message is sent (assumed)."""

_ARGUMENT_COUNTS = {"B": 0, "F": 0, "R": 0, "S": ENTRY_SIZE}


class RadioPhase(IntEnum):
    """Phases of the message that is sent."""

    IDLE = 0  # none
    WAITING = 1  # for the next control period
    IN_AIR = 2  # or for its acknowledgement


class RadioRegister(IntEnum):
    """Registers of the radio turret."""

    IS_ON = 0  # 1 after a control period, until the body has run
    PHASE = 1  # RadioPhase of the message that is sent
    ARRIVAL = 2  # time when its transmission arrives [ns]
    TRIES = 3  # its remaining transmissions
    IS_HEARD = 4  # 1 if its receiver has accepted it
    TRANSMISSIONS = 5  # transmissions since power-up, the counter of the random draws
    HAS_FAILED = 6  # 1 if the last message was not acknowledged
    HAS_OVERRUN = 7  # 1 if a message found the buffer full since the last read
    RECEIVED = 8  # messages in the buffer
    TO = 9  # radio that the message is for
    LENGTH = 10  # its length
    DATA = 11  # first of its 16 bytes
    BUFFER = DATA + RADIO_BYTES  # first of the received messages' registers, the oldest first


N_REGISTERS = RadioRegister.BUFFER + CAPACITY * ENTRY_SIZE
"""Number of registers."""

_BYTES = [f"byte_{number}" for number in range(RADIO_BYTES)]

NAMES = (
    *(register.name.lower() for register in RadioRegister if register < RadioRegister.DATA),
    *_BYTES,
    *(f"received_{entry}_{part}" for entry in range(CAPACITY) for part in ("sender", "length", *_BYTES)),
)
"""Names of the registers."""

_FLAG = 0, 1
_CONTENT = (0, RADIO_BYTES), *[(0, 255)] * RADIO_BYTES

_RANGES = (
    *(_FLAG, (0, max(RadioPhase)), (0, 2**62), (0, TRANSMISSIONS), _FLAG, (0, 2**32 - 1)),
    *(_FLAG, _FLAG, (0, CAPACITY), (RADIO_ALL, NUMBER_LIMIT), *_CONTENT),
    *((0, 2**31), *_CONTENT) * CAPACITY,  # from robots of any number
)
RANGES = dict(enumerate(_RANGES))
"""Range of each register."""


class RadioElectronics:
    """Electronics of the radio turret, a `Turret`.

    Attributes:
        registers: State of the electronics (N_REGISTERS,).
    """

    def __init__(self) -> None:
        self.registers = np.zeros(N_REGISTERS, np.int64)
        self._register_view = self.registers.data

    def receive(self, message: bytes) -> bytes:
        """Execute an order; return its reply."""
        order = parse_turret_order(message, _ARGUMENT_COUNTS)
        if isinstance(order, Malformed):
            return order.reply
        match order.letter, order.arguments:
            case "B", ():
                return self._reply("B", VERSION, REVISION)
            case "F", ():
                return self._reply("F", int(self._status()))
            case "R", ():
                return self._reply("R", *self._pop_message())
            case _:
                receiver, length, *data = order.arguments
                return self._send(receiver, length, data)

    def tick(self) -> None:
        """Enable the body: only a turret with power sends and receives."""
        self._register_view[RadioRegister.IS_ON] = 1

    def reset(self) -> None:
        """Drop the message that is sent and all received ones."""
        transmissions = self._register_view[RadioRegister.TRANSMISSIONS]
        self.registers[:] = 0
        # The random draws of a robot continue after its reset.
        self._register_view[RadioRegister.TRANSMISSIONS] = transmissions

    def _status(self) -> RadioStatus:
        view = self._register_view
        flags = (
            (RadioStatus.READY, view[RadioRegister.PHASE] == RadioPhase.IDLE),
            (RadioStatus.RECEIVED, view[RadioRegister.RECEIVED] > 0),
            (RadioStatus.FAILED, view[RadioRegister.HAS_FAILED] != 0),
            (RadioStatus.OVERRUN, view[RadioRegister.HAS_OVERRUN] != 0),
        )
        return RadioStatus(sum(flag for flag, is_set in flags if is_set))

    def _pop_message(self) -> list[int]:
        """Remove the oldest received message and return its registers; zeros without one."""
        view, buffer = self._register_view, self.registers[RadioRegister.BUFFER :]
        oldest: list[int] = buffer[:ENTRY_SIZE].tolist()
        buffer[:-ENTRY_SIZE] = buffer[ENTRY_SIZE:].copy()
        buffer[-ENTRY_SIZE:] = 0
        view[RadioRegister.RECEIVED] = max(view[RadioRegister.RECEIVED] - 1, 0)
        view[RadioRegister.HAS_OVERRUN] = 0
        return oldest

    def _send(self, receiver: int, length: int, data: list[int]) -> bytes:
        are_bytes_valid = all(0 <= byte <= 255 for byte in data)
        if not (RADIO_ALL <= receiver <= NUMBER_LIMIT and 0 <= length <= RADIO_BYTES and are_bytes_valid):
            return PROTOCOL_ERROR
        view = self._register_view
        if view[RadioRegister.PHASE] != RadioPhase.IDLE:
            return BUSY
        view[RadioRegister.PHASE] = RadioPhase.WAITING
        view[RadioRegister.TRIES] = TRANSMISSIONS
        view[RadioRegister.HAS_FAILED] = 0
        padded = data[:length] + [0] * (RADIO_BYTES - length)
        self.registers[RadioRegister.TO : RadioRegister.BUFFER] = [receiver, length, *padded]
        return self._reply("S")

    def _reply(self, letter: str, *values: int) -> bytes:
        return turret_reply(RADIO_NUMBER, letter, *values)
