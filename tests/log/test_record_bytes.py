"""Records at an offset: known ones are verified, and unknown ones are no records."""

import pytest
from mcap.opcode import Opcode

from khep_twin.log.record_bytes import HEAD, MESSAGE, RecordBytes

SCHEMA = bytes.fromhex("0100 01000000 61 01000000 62 00000000")
"""Content of a schema: number 1, name "a", encoding "b", no data."""


@pytest.mark.parametrize(
    ("opcode", "content", "is_record"),
    [
        (Opcode.SCHEMA, SCHEMA, True),
        (Opcode.SCHEMA, SCHEMA[:-1], False),
        (Opcode.DATA_END, bytes(4), True),
        (Opcode.MESSAGE, bytes(MESSAGE.size + 3), True),
        (0x0E, bytes(4), True),
        (0x10, bytes(4), False),
        (0x7F, bytes(4), False),
    ],
)
def test_a_record_of_a_known_kind_is_one_and_of_an_unknown_kind_is_none(
    opcode: int, content: bytes, is_record: bool
) -> None:
    record = HEAD.pack(opcode, len(content)) + content
    next_record = HEAD.pack(Opcode.DATA_END, 4) + bytes(4)
    for data in (record, record + next_record):
        assert RecordBytes(data).is_record(0) == is_record
