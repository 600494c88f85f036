"""Index of a log: its records are accepted if they are apart and before the index, and no others are."""

import struct
import tempfile
from contextlib import nullcontext
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from khep_twin.log.content import Content
from khep_twin.log.decoding import DecodeError
from khep_twin.log.record_bytes import HEAD

MAGIC = len(MCAP0_MAGIC)
DATA = 60
"""Size of the data before the index [bytes]."""

START = MAGIC + DATA


def record(opcode: int, content: bytes) -> bytes:
    return HEAD.pack(opcode, len(content)) + content


def log_with_index(locations: list[tuple[int, int]]) -> bytes:
    """Return a log whose index names records of metadata: their offsets and lengths."""
    index = b"".join(
        record(Opcode.METADATA_INDEX, struct.pack("<QQ", *location) + bytes(4)) for location in locations
    )
    footer = record(Opcode.FOOTER, struct.pack("<QQI", START, 0, 0))
    return MCAP0_MAGIC + bytes(DATA) + index + footer + MCAP0_MAGIC


def check_index(locations: list[tuple[int, int]]) -> None:
    """Check whether an index is accepted: its records are between the magic bytes and it, and apart."""
    ordered = sorted(locations)
    is_apart = all(offset + length <= later for (offset, length), (later, _) in pairwise(ordered))
    is_inside = all(MAGIC <= offset and offset + length <= START for offset, length in locations)
    is_once = len({offset for offset, _ in locations}) == len(locations)
    accepted = is_apart and is_inside and is_once
    with tempfile.TemporaryFile() as file:
        file.write(log_with_index(locations))
        file.flush()
        with nullcontext() if accepted else pytest.raises(DecodeError, match="record at byte"):
            Content(file)


@given(st.lists(st.tuples(st.integers(0, START + 4), st.integers(0, 30)), max_size=4))
def test_an_index_is_accepted_where_its_records_are_apart_and_before_it(
    locations: list[tuple[int, int]],
) -> None:
    check_index(locations)


@given(st.lists(st.integers(MAGIC, START), min_size=2, max_size=6, unique=True), st.data())
def test_records_that_touch_are_accepted_and_those_a_byte_longer_are_not(
    bounds: list[int], data: st.DataObject
) -> None:
    bounds.sort()
    touching = [(offset, later - offset) for offset, later in pairwise(bounds)]
    check_index(touching)
    number = data.draw(st.integers(0, len(touching) - 1))
    offset, length = touching[number]
    for longer in ((offset, length + 1), (offset - 1, length + 1)):
        check_index([*touching[:number], longer, *touching[number + 1 :]])
