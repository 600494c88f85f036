"""Numbers in the memory of a microcontroller, a sequence of bytes. The functions are `compilable`."""

from khep_twin.board.kernel import Registers
from khep_twin.compilable import compilable


@compilable
def read_signed(memory: Registers, register: int, size: int) -> int:
    """Return a signed number of `size` bytes, the lowest first."""
    number = 0
    for offset in range(size):
        number |= memory[register + offset] << 8 * offset
    return number - ((number >> 8 * size - 1) << 8 * size)


@compilable
def write_number(memory: Registers, register: int, size: int, number: int) -> None:
    """Set a number of `size` bytes, truncated as in C."""
    for offset in range(size):
        memory[register + offset] = number >> 8 * offset & 0xFF
