"""Bitmaps from files: scanned playpens of the Khepera Toolbox (MAT), and pictures.

The first bytes identify the format. Files are not trusted: sizes are checked before decoding, and only the
chunks of a PNG that define its pixels reach the decoder.
"""

import ctypes
import logging
import struct
import warnings
from collections.abc import Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from khep_twin.errors import BitmapError, MatError, choices
from khep_twin.files.atomic import open_regular
from khep_twin.files.mat_file import SIZE_LIMIT, UnsupportedVariable, Variable, read_variables
from khep_twin.files.paths import StrPath
from khep_twin.playpen.bitmap import SIDE_LIMIT, Pixels

SCAN = "btmap1"
"""Name of the variable of a scanned playpen."""

SOLID = 44
"""Colour index of its solid pixels."""

MIN_SIDE = 10
"""Fewest rows and columns of a matrix that may be a bitmap."""

CHUNK_LIMIT = 100_000
"""Most chunks of a PNG."""

_PNG = b"\x89PNG\r\n\x1a\n"

PICTURES = {
    "PNG": (_PNG,),
    "TIFF": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    "GIF": (b"GIF87a", b"GIF89a"),
    "BMP": (b"BM",),
    "JPEG": (b"\xff\xd8\xff",),
    "PPM": tuple(b"P%d%c" % (kind, space) for kind in range(1, 7) for space in b"\n\r\t #"),
}
"""First bytes of pictures, by Pillow's name of their format; PPM is also PBM and PGM."""

# The errors here contain Pillow's messages about damaged files; without a handler Python prints them.
logging.getLogger("PIL").addHandler(logging.NullHandler())

_EXPECTED = "a MAT file of Matlab 4 to 7.2, or a PNG, TIFF, GIF, BMP, JPEG, PBM, PGM or PPM"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_BYTE_ORDER_OFFSET = 126  # of the byte order mark in a file of Matlab 5 to 7
_MATLAB_4_LIMIT = 10_000  # of the first number in a file of Matlab 4, the kind of its first matrix


@dataclass(frozen=True, slots=True)
class Bitmap:
    """A bitmap as stored in its file.

    Attributes:
        solid: Solid pixels (rows, columns).
        label: Name in messages: a variable, or "picture".
        is_scan: True for a bitmap of a MAT file; the toolbox's scans are upside down.
    """

    solid: Pixels
    label: str
    is_scan: bool


def read(path: StrPath, variable: str | None = None, solid: int | None = None) -> Bitmap:
    """Read the bitmap in a file.

    Args:
        path: Path of a MAT file or a picture.
        variable: Variable of a MAT file; by default btmap1, or the only one that can be a bitmap.
        solid: Value of the solid pixels; 44 by default.

    Raises:
        BitmapError: The file does not exist, or contains no bitmap.
    """
    try:
        with open_regular(Path(path)) as file:
            data = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        raise BitmapError(f"cannot be read: {error.strerror}", file=path) from None
    try:
        return decode(data, variable, solid)
    except (BitmapError, MatError) as error:
        raise BitmapError(error, file=path) from None


def decode(data: bytes, variable: str | None = None, solid: int | None = None) -> Bitmap:
    """Decode the bitmap in the bytes of a file; arguments as for `read`.

    Raises:
        BitmapError: There is none.
        MatError: The data is neither a picture nor a complete MAT file.
    """
    if len(data) > SIZE_LIMIT:
        raise BitmapError(f"larger than {SIZE_LIMIT} bytes, the most that is read")
    file_type = next((kind for kind, heads in PICTURES.items() if data.startswith(heads)), None)
    if file_type is not None:
        if variable is not None or solid is not None:
            raise BitmapError(f"a {file_type}; expected a MAT file for --variable and --solid")
        return Bitmap(_decode_picture(data, file_type), "picture", False)
    if not _may_be_mat(data):
        raise BitmapError(f"begins {data[:8]!r}; expected {_EXPECTED}")
    name, matrix = _find_matrix(read_variables(data), variable)
    value = SOLID if solid is None else solid
    pixels: Pixels = np.asarray(matrix == value)
    if not pixels.any():
        values: list[float] = np.unique(matrix.reshape(-1)[: 2**20]).tolist()
        values_text = ", ".join(f"{value:g}" for value in values[:8]) + (", ..." if len(values) > 8 else "")
        raise BitmapError(
            f"{name}: no pixel is {value}", f"; expected --solid with one of its values ({values_text})"
        )
    return Bitmap(pixels, name, True)


def _find_matrix(variables: Mapping[str, Variable], requested: str | None) -> tuple[str, NDArray[np.generic]]:
    """Return name and matrix of the requested variable, or of the only one that can be a bitmap."""
    variables = {_printable(name): value for name, value in variables.items()}
    requested = SCAN if requested is None and SCAN in variables else requested
    if requested is None:
        bitmaps = [name for name, value in variables.items() if _may_be_bitmap(value)]
        if len(bitmaps) > 1:
            text = f"several matrices ({_summary(variables, bitmaps)})"
            raise BitmapError(text, "; expected --variable with one of them")
        if not bitmaps:
            raise BitmapError(
                f"no bitmap among its variables ({_summary(variables, list(variables))}): probably an "
                f"editable playpen; expected the scanned one, with {SCAN}, which Scan Playpen writes"
            )
        requested = bitmaps[0]
    if requested not in variables:
        raise BitmapError(f"no variable {requested[:40]!r}; {choices(requested, list(variables)[:20])}")
    matrix = variables[requested]
    if not isinstance(matrix, np.ndarray) or matrix.ndim != 2 or not matrix.size:
        raise BitmapError(f"{requested}: is {_describe(matrix)}; expected a full matrix of real numbers")
    if max(matrix.shape) > SIDE_LIMIT:
        kind = _describe(matrix)
        raise BitmapError(f"{requested}: is {kind}; expected up to {SIDE_LIMIT} rows and columns")
    return requested, matrix


def _may_be_bitmap(value: Variable) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 2 and min(value.shape) >= MIN_SIDE


def _summary(variables: Mapping[str, Variable], names: list[str]) -> str:
    ellipsis = ", ..." if len(names) > 10 else ""
    return ", ".join(f"{name}: {_describe(variables[name])}" for name in names[:10]) + ellipsis or "none"


def _describe(value: Variable) -> str:
    if isinstance(value, UnsupportedVariable):
        return value.kind
    return "text" if isinstance(value, tuple) else " x ".join(map(str, value.shape))


def _printable(name: str) -> str:
    return "".join(character if character.isprintable() else "?" for character in name)[:63]


def _may_be_mat(data: bytes) -> bool:
    """Return whether the first bytes are those of a MAT file of any version, complete or not."""
    low, high = (int.from_bytes(data[:4], order) for order in ("little", "big"))
    return (
        data[:4] in (b"\x89HDF", b"MATL")
        or data[_BYTE_ORDER_OFFSET : _BYTE_ORDER_OFFSET + 2] in (b"IM", b"MI")
        or min(low, high) < _MATLAB_4_LIMIT
    )


def _decode_picture(data: bytes, file_type: str) -> Pixels:
    """Return the dark pixels of a picture: luminance below one half, with transparency over white."""
    try:
        with warnings.catch_warnings(), _silent_libtiff():
            warnings.simplefilter("error")
            pixel_data = _pixel_chunks(data) if file_type == "PNG" else data
            with Image.open(BytesIO(pixel_data), formats=[file_type]) as picture:
                _check_size(*picture.size)
                dark = _dark_pixels(picture)
    except BitmapError:
        raise
    except UnidentifiedImageError:
        raise BitmapError(f"no whole {file_type}: its head is damaged; expected the file as saved") from None
    # Pillow raises arbitrary exceptions for a damaged file.
    except Exception as error:
        reason = str(error).split("\n")[0][:100] or type(error).__name__
        raise BitmapError(f"no whole {file_type}: {reason}; expected the file as saved") from None
    if not dark.any():
        raise BitmapError("no pixel is dark; expected a picture with dark walls or blocks on a bright floor")
    return dark


@contextmanager
def _silent_libtiff() -> Generator[None]:
    """Keep libtiff from printing errors and warnings, if Pillow's libtiff is accessible."""
    with ExitStack() as handlers:
        with suppress(AttributeError, OSError):
            library = ctypes.CDLL(Image.core.__file__)
            for name in ("TIFFSetErrorHandler", "TIFFSetWarningHandler"):
                set_handler = getattr(library, name)
                set_handler.argtypes, set_handler.restype = [ctypes.c_void_p], ctypes.c_void_p
                handlers.callback(set_handler, set_handler(None))
        yield


def _dark_pixels(picture: Image.Image) -> Pixels:
    if picture.mode == "F" or (picture.mode == "I" and picture.format == "TIFF"):
        raise BitmapError("pixels of 32 bits; expected black and white, greys or colours of 8 or 16 bits")
    if picture.mode.startswith("I"):
        # Grey of 16 bits, of which one value may mean transparent.
        levels = np.asarray(picture)
        return np.asarray((levels < 2**15) & (levels != picture.info.get("transparency", -1)))
    grey, alpha = np.moveaxis(np.asarray(picture.convert("LA")), -1, 0)
    # 255 - (255 - grey) * alpha / 255 < 127.5
    return np.asarray((255 - grey).astype(np.uint16) * alpha > 127.5 * 255)


def _pixel_chunks(data: bytes) -> bytes:
    """Return a PNG without text, profiles and animation, which can be zip bombs; check its size.

    Pillow decompresses them all: 24 s for 10 MB of colour profiles.
    """
    chunks = [_PNG]
    offset = len(_PNG)
    count = 0
    while offset < len(data):
        count += 1
        if count > CHUNK_LIMIT:
            raise BitmapError(f"a PNG of more than {CHUNK_LIMIT} parts; expected one saved anew")
        if offset + 12 > len(data):
            break
        size, chunk_type = struct.unpack(">I4s", data[offset : offset + 8])
        if count == 1:
            _check_header(chunk_type, data[offset + 8 : offset + 16])
        if chunk_type in _PIXEL_CHUNKS:
            chunks.append(data[offset : offset + 12 + size])
        offset += 12 + size
        if chunk_type == b"IEND":
            break
    return b"".join(chunks)


def _check_header(chunk_type: bytes, header: bytes) -> None:
    if chunk_type != b"IHDR" or len(header) != 8:
        raise BitmapError("no whole PNG: begins without its size; expected the file as saved")
    _check_size(*struct.unpack(">II", header))


def _check_size(width: int, height: int) -> None:
    if not (1 <= width <= SIDE_LIMIT and 1 <= height <= SIDE_LIMIT):
        raise BitmapError(f"{height} x {width} pixels; expected 1 to {SIDE_LIMIT} rows and columns")
