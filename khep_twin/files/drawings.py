"""Drawings of khep_twin, which may be drawn again: pictures and pages end with a checksum of their content.

What another program has made or changed since has none that fits, and is kept as any other file.
"""

import hashlib
import struct
import zlib
from pathlib import Path

from khep_twin.files.atomic import read_regular, write_whole

_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", 12
"""First bytes of a PNG, and the size of its last chunk [bytes]."""

_LARGEST = 64 << 20
"""Largest file that is looked at [bytes]; drawings are smaller."""


def write_drawing(path: Path, data: bytes, replace: bool = True) -> None:
    """Write a PNG, SVG, PDF or HTML file with its checksum, as by `write_whole`.

    With `replace` false, another file that is there by now is kept, if it is no unchanged drawing.

    Raises:
        KhepTwinError: It cannot be written.
    """
    write_whole(path, marked(data), replace or is_replaceable(path))


def is_replaceable(path: Path) -> bool:
    """Return whether a name has no file, an empty one or an unchanged drawing, so that nothing is lost."""
    try:
        size = path.stat().st_size if path.is_file() else 0
        return not size or (size <= _LARGEST and _is_marked(read_regular(path)))
    except OSError:
        return False


def marked(data: bytes) -> bytes:
    """Return a file's content with its checksum."""
    end = _end(data)
    return data[:end] + _mark(data) + data[end:]


def _is_marked(data: bytes) -> bool:
    end, size = _end(data), len(_mark(data))
    return end > size and marked(data[: end - size] + data[end:]) == data


def _end(data: bytes) -> int:
    """Return the place of the checksum's end: the last one, but in a PNG that of its last chunk."""
    return len(data) - (_PNG_END if data.startswith(_PNG) else 0)


def _mark(data: bytes) -> bytes:
    """Return a checksum in the form of a comment of the file's kind, always of the same size."""
    digest = b"khep_twin\0" + hashlib.sha256(data).hexdigest().encode()
    if data.startswith(_PNG):
        chunk = b"tEXt" + digest
        return struct.pack(">I", len(digest)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    text = digest.replace(b"\0", b" ")
    return b"%" + text + b"\n" if data.startswith(b"%PDF") else b"<!-- " + text + b" -->\n"
