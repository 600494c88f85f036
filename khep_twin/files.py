"""Writing files so that each is there as a whole or not at all."""

import os
from pathlib import Path

from khep_twin.errors import KhepTwinError


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file beside `path` and gives it its name when it is whole.

    Raises:
        KhepTwinError: that is not possible; what was there before is untouched.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        try:
            part.write_bytes(data)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise KhepTwinError(f"{path}: cannot be written: {error.strerror}") from error
