"""Dead reckoning: a twin that drives by commands alone; its board shows the effect of each command."""

import math
from collections.abc import Iterator

import numpy as np

from khep_twin import firmware, units
from khep_twin.board import kernel
from khep_twin.board.protocol import Command
from khep_twin.board.rom import ROMS
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.firmware import Firmware, parse
from khep_twin.log.exchanges import Exchange
from khep_twin.shadow.actions import Action, RegisterWrite, WheelCommand
from khep_twin.shadow.planes import Twins
from khep_twin.shadow.wheel_commands import DUTY, POSITION, SPEED, TARGET

Pose = tuple[float, float, float]

COMMANDS = {"D": SPEED, "P": DUTY, "C": TARGET, "G": POSITION}
"""Commands whose effect depends on a board's registers."""

LIMITS = {
    "D": firmware.SPEED_LIMIT_PULSES,
    "P": units.DUTY_LIMIT,
    "C": firmware.TARGET_LIMIT_PULSES,
    "G": 2**31 - 1,
}
"""Largest arguments of these."""


class Reckoning:
    """Twin that drives by commands alone, as the calibration's robot would.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        twins: Twin, one.
    """

    def __init__(self, setup: EpisodeSetup, twins: Twins) -> None:
        entry = setup.entry
        self._planes = twins
        board = twins.registers[0], twins.processor[0]
        self._firmware = Firmware(ROMS[entry.rom], entry.mode, None, *board)

    @property
    def pose(self) -> Pose:
        """Pose x, y [m] and heading [rad]."""
        x, y, heading = self._planes.poses[0].tolist()
        return x, y, math.remainder(heading, math.tau)

    def reset(self) -> None:
        """Reset the board."""
        self._firmware.reset()

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]."""
        self._planes.advance_to(time_ns)

    def execute(self, time_ns: int, late_ns: int, exchange: Exchange) -> Iterator[Action]:
        """Execute a command; yield the actions by which particles with other wheels execute it.

        Args:
            time_ns: Earliest time at which the robot has executed it [ns].
            late_ns: Latest time [ns].
            exchange: Command with its reply.
        """
        self.advance_to(time_ns)
        board, line = self._planes.registers[0], exchange.command
        old_registers = board.copy()
        match parse(line):
            case Command(letter, (int(left), int(right))) if letter in COMMANDS:
                self._firmware.receive(line + b"\n")
                limit = LIMITS[letter]
                left, right = kernel.clip(left, limit), kernel.clip(right, limit)
                # The line may have lost the command, or its reply.
                is_unconfirmed = exchange.reply is None
                yield WheelCommand(time_ns, COMMANDS[letter], left, right, is_unconfirmed, late_ns)
            case Command():
                # Gains, profiles and LEDs: registers that do not depend on any other.
                self._firmware.receive(line + b"\n")
                if len(changed := np.flatnonzero(board != old_registers)):
                    yield RegisterWrite(time_ns, changed, board[changed])
            case _:
                pass
