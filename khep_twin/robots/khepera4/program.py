"""C functions for programs of a Khepera IV that read registers and drive."""

from collections.abc import Sequence
from pathlib import Path

from khep_twin.robots.khepera4.measurements import WORDS


def bus_source(registers: Sequence[int]) -> str:
    """Return C functions that start the robot, read registers of 2 bytes, and drive."""
    places = [first + number * stride for first, _, _, stride, count in WORDS for number in range(count)]
    reads: list[list[int]] = []
    for place in map(places.__getitem__, registers):
        if reads and reads[-1][0] + 2 * reads[-1][1] == place:
            reads[-1][1] += 1
        else:
            reads.append([place, 1])
    table = ", ".join(f"{place}, {count}" for place, count in reads)
    source = (Path(__file__).parent / "assets" / "bus.c").read_text()
    return f"static unsigned char READS[] = {{{table}}};\n{source}"
