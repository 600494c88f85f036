"""The radio turret in a world: transmissions between robots, their range, loss and transmission time.

Robot n of the playpen, counted from 1, has the radio number n. The transmission of a message starts in the
control period after its order. It arrives a whole number of control periods later at every addressed receiver
in range. Receivers accept it in that period; the sender checks for the acknowledgement in the next one, and
repeats the message without one. So no result depends on the order in which turrets run within a period.
Messages that arrive in the same period are received in the order of their senders' numbers.

Transmissions do not interfere, a turret receives while it sends, and no acknowledgement is lost (assumed).
A broadcast message is neither acknowledged nor repeated (manual of the radio base).
"""

import math

from khep_twin.board.radio import (
    CAPACITY,
    ENTRY_SIZE,
    NAMES,
    RANGES,
    REVISION,
    VERSION,
    RadioElectronics,
    RadioPhase,
)
from khep_twin.board.radio import RadioRegister as Register
from khep_twin.board.turrets import TurretContext, TurretKind
from khep_twin.sensing.noise import philox
from khep_twin.units import RADIO_ALL, RADIO_NUMBER, TICK_NS

_WORD = 0xFFFFFFFF

_MESSAGE = slice(Register.LENGTH, Register.BUFFER)
"""Registers of a sent message, which a receiver copies."""


class RadioBody:
    """Radio turret of one robot in a world, a `TurretBody`.

    Attributes:
        number: Radio number.
    """

    def __init__(self, context: TurretContext) -> None:
        self.number = context.robot + 1
        self._context = context
        self._registers = context.registers
        self._view = context.registers.data
        robot = context.prefix.partition("/")[0]
        self._qpos_start = int(context.model.joint(f"{robot}/pose").qposadr[0])
        settings = context.settings
        self._range = settings["range_mm"] / 1000
        self._loss = round(settings["loss"] * (_WORD + 1))
        self._air_ns = TICK_NS * math.ceil(settings["air_time_ms"] * 1e6 / TICK_NS)

    @property
    def position(self) -> tuple[float, float]:
        """Position of its robot: x and y [m]."""
        x, y = self._context.data.qpos[self._qpos_start : self._qpos_start + 2].tolist()
        return x, y

    def sense(self) -> None:
        """Do nothing; the turret runs in `drive`, after the orders of the period."""

    def drive(self) -> None:
        """Send and receive for a control period, if the electronics have run."""
        view = self._view
        if view[Register.IS_ON]:
            view[Register.IS_ON] = 0
            time_ns = self._context.time_ns
            self._send(time_ns)
            self._receive(time_ns)

    def _send(self, time_ns: int) -> None:
        """Finish a transmission in the period after its arrival, and start the next one."""
        view = self._view
        if view[Register.PHASE] == RadioPhase.IN_AIR:
            if time_ns <= view[Register.ARRIVAL]:
                return
            is_done = bool(view[Register.IS_HEARD]) or view[Register.TO] == RADIO_ALL
            if is_done or view[Register.TRIES] <= 0:
                view[Register.HAS_FAILED] = int(not is_done)
                view[Register.PHASE] = RadioPhase.IDLE
        if view[Register.PHASE] != RadioPhase.IDLE:
            view[Register.PHASE] = RadioPhase.IN_AIR
            view[Register.ARRIVAL] = time_ns + self._air_ns
            view[Register.IS_HEARD] = 0
            view[Register.TRIES] = max(view[Register.TRIES] - 1, 0)
            view[Register.TRANSMISSIONS] = (view[Register.TRANSMISSIONS] + 1) & _WORD

    def _receive(self, time_ns: int) -> None:
        """Receive the messages that arrive now, in the order of their senders' numbers."""
        view = self._view
        for peer in self._context.peers:
            if peer is self or not isinstance(peer, RadioBody) or not self._is_reached_by(peer, time_ns):
                continue
            received = view[Register.RECEIVED]
            if received >= CAPACITY:
                view[Register.HAS_OVERRUN] = 1
                continue
            entry = Register.BUFFER + received * ENTRY_SIZE
            view[entry] = peer.number
            self._registers[entry + 1 : entry + ENTRY_SIZE] = peer._registers[_MESSAGE]
            view[Register.RECEIVED] = received + 1
            peer._view[Register.IS_HEARD] = 1

    def _is_reached_by(self, peer: "RadioBody", time_ns: int) -> bool:
        """Return whether a message of a peer for this radio arrives now."""
        sender = peer._view
        if sender[Register.PHASE] != RadioPhase.IN_AIR or sender[Register.ARRIVAL] != time_ns:
            return False
        if sender[Register.TO] not in (self.number, RADIO_ALL):
            return False
        if math.dist(self.position, peer.position) > self._range:
            return False
        low, high = self._context.key
        draw, _ = philox(sender[Register.TRANSMISSIONS], (high + peer.number) & _WORD, low)
        return draw >= self._loss


RADIO = TurretKind(
    name="radio",
    number=RADIO_NUMBER,
    description="messages between robots",
    revision=f"{VERSION}.{REVISION}",
    make=RadioElectronics,
    fit=RadioBody,
    names=NAMES,
    ranges=RANGES,
)
"""The radio turret, as registered under the entry point "khep_twin.turrets"."""
