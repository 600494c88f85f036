"""Drawings of khep_twin: pictures and pages that end with a checksum of their content.

A drawing with a valid checksum may be replaced. A file of another program, or a changed drawing, is kept.
"""

import hashlib
import struct
import zlib
from pathlib import Path

from khep_twin.files.atomic import read_regular, write_atomic

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_END = 12  # size of its last chunk [bytes]

_SIZE_LIMIT = 64 << 20
"""Largest file whose checksum is verified [bytes]; drawings are smaller."""


def write_drawing(path: Path, data: bytes, replace: bool = True) -> None:
    """Write a PNG, SVG, PDF or HTML file with its checksum, atomically.

    With `replace` false, an existing file is kept, unless it is an unchanged drawing.

    Raises:
        KhepTwinError: It cannot be written.
    """
    write_atomic(path, add_checksum(data), replace or is_replaceable(path))


def is_replaceable(path: Path) -> bool:
    """Return whether a path has no file, an empty one or an unchanged drawing, so that no data is lost."""
    try:
        size = path.stat().st_size if path.is_file() else 0
        return not size or (size <= _SIZE_LIMIT and _has_checksum(read_regular(path)))
    except OSError:
        return False


def add_checksum(data: bytes) -> bytes:
    """Return a file's content with its checksum."""
    end = _checksum_end(data)
    return data[:end] + _checksum_comment(data) + data[end:]


def _has_checksum(data: bytes) -> bool:
    end, size = _checksum_end(data), len(_checksum_comment(data))
    return end > size and add_checksum(data[: end - size] + data[end:]) == data


def _checksum_end(data: bytes) -> int:
    """Return the offset of the checksum's end: the end of the file, or the start of a PNG's last chunk."""
    return len(data) - (_PNG_END if data.startswith(_PNG) else 0)


def _checksum_comment(data: bytes) -> bytes:
    """Return the checksum as a comment in the file's format, of constant size for each format."""
    digest = b"khep_twin\0" + hashlib.sha256(data).hexdigest().encode()
    if data.startswith(_PNG):
        chunk = b"tEXt" + digest
        return struct.pack(">I", len(digest)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    text = digest.replace(b"\0", b" ")
    return b"%" + text + b"\n" if data.startswith(b"%PDF") else b"<!-- " + text + b" -->\n"
