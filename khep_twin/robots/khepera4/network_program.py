"""C functions of a Khepera IV for a network's program, see `khep_twin.episodes.network_program`."""

from collections.abc import Sequence

from khep_twin.robots.khepera4.core import WORDS
from khep_twin.robots.khepera4.preload import SOURCES

_PLACES = [first + number * stride for first, _, _, stride, count in WORDS for number in range(count)]
"""First byte on the bus of each register."""


def bus_source(registers: Sequence[int]) -> str:
    """Return functions that start the robot, read registers of 2 bytes, and drive."""
    reads: list[list[int]] = []
    for place in (_PLACES[register] for register in registers):
        if reads and reads[-1][0] + 2 * reads[-1][1] == place:
            reads[-1][1] += 1
        else:
            reads.append([place, 1])
    rows = ", ".join(f"{{{place}, {count}}}" for place, count in reads)
    return (
        f"#define N_READS {len(reads)}\n"
        f"static const unsigned char READS[][2] = {{{rows}}}; /* first register, number of values */\n"
        f"{(SOURCES / 'bus.c').read_text()}"
    )
