"""Readings in the memory of a Khepera IV's dsPIC."""

from collections.abc import Sequence

from khep_twin.board.memory import write_number
from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.registers import DspicRegister


def set_words(dspic: Dspic, register: DspicRegister, values: Sequence[int]) -> None:
    """Set registers of 2 bytes each to readings, from a register on."""
    for index, value in enumerate(values):
        write_number(dspic.state.memory, register + 2 * index, 2, value)
