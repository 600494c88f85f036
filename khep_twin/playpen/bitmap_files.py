"""Bitmaps from files: scanned playpens of the Khepera Toolbox (MAT), and pictures.

The first bytes identify the format. Files are not trusted: sizes are checked before anything is decoded, and
of a PNG only the chunks that make its pixels reach the decoder.
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
from khep_twin.files.mat_file import SIZE_LIMIT, Foreign, Variable, read_variables
from khep_twin.files.paths import StrPath
from khep_twin.playpen.bitmap import SIDE_LIMIT, Pixels

SCAN = "btmap1"
"""Name of the variable of a scanned playpen."""

SOLID = 44
"""Colour index of its solid pixels."""

LEAST_SIDE = 10
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

# Messages of Pillow about damaged files are in the errors here; without a handler Python prints it.
logging.getLogger("PIL").addHandler(logging.NullHandler())

_EXPECTED = "a MAT file of Matlab 4 to 7.2, or a PNG, TIFF, GIF, BMP, JPEG, PBM, PGM or PPM"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")


@dataclass(frozen=True, slots=True)
class Bitmap:
    """A bitmap as stored in its file.

    Attributes:
        solid: Solid pixels (rows, columns).
        what: Name in messages: that of a variable, or "picture".
        scanned: True if it comes from a MAT file, as the toolbox's upside-down scans do.
    """

    solid: Pixels
    what: str
    scanned: bool


def read(path: StrPath, variable: str | None = None, solid: int | None = None) -> Bitmap:
    """Read the bitmap in a file.

    Args:
        path: Path of a MAT file or a picture.
        variable: Variable of a MAT file; by default btmap1, or else the only one that can be a bitmap.
        solid: Value of the solid pixels; 44 by default.

    Raises:
        BitmapError: The file does not exist, or holds no bitmap.
    """
    try:
        with open_regular(Path(path)) as file:
            data = file.read(SIZE_LIMIT + 1)
    except (OSError, ValueError) as trouble:
        reason = trouble.strerror if isinstance(trouble, OSError) else trouble
        raise BitmapError(f"{path}: cannot be read: {reason}") from None
    try:
        return decode(data, variable, solid)
    except (BitmapError, MatError) as error:
        raise BitmapError(f"{path}: {error}") from None


def decode(data: bytes, variable: str | None = None, solid: int | None = None) -> Bitmap:
    """Decode the bitmap in the bytes of a file; arguments as for `read`.

    Raises:
        BitmapError: There is none.
        MatError: The data is neither a picture nor a whole MAT file.
    """
    if len(data) > SIZE_LIMIT:
        raise BitmapError(f"larger than {SIZE_LIMIT} bytes, the most that is read")
    kind = next((kind for kind, heads in PICTURES.items() if data.startswith(heads)), None)
    if kind is not None:
        if variable is not None or solid is not None:
            raise BitmapError(f"a {kind}; expected a MAT file for --variable and --solid")
        return Bitmap(_dark(data, kind), "picture", False)
    if not _may_be_mat(data):
        raise BitmapError(f"begins {data[:8]!r}; expected {_EXPECTED}")
    name, matrix = _chosen(read_variables(data), variable)
    value = SOLID if solid is None else solid
    pixels: Pixels = np.asarray(matrix == value)
    if not pixels.any():
        some: list[float] = np.unique(matrix.reshape(-1)[: 2**20]).tolist()
        listed = ", ".join(f"{each:g}" for each in some[:8]) + (", ..." if len(some) > 8 else "")
        raise BitmapError(
            f"{name}: no pixel is {value}", f"; expected --solid with one of its values ({listed})"
        )
    return Bitmap(pixels, name, True)


def _chosen(variables: Mapping[str, Variable], wanted: str | None) -> tuple[str, NDArray[np.generic]]:
    told = {_plain(name): value for name, value in variables.items()}
    wanted = SCAN if wanted is None and SCAN in told else wanted
    if wanted is None:
        bitmaps = [name for name, value in told.items() if _may_be_bitmap(value)]
        if len(bitmaps) > 1:
            raise BitmapError(
                f"several matrices ({_listed(told, bitmaps)})", "; expected --variable with one of them"
            )
        if not bitmaps:
            raise BitmapError(
                f"no bitmap among its variables ({_listed(told, list(told))}): probably an editable playpen; "
                f"expected the scanned one, with {SCAN}, which Scan Playpen writes"
            )
        wanted = bitmaps[0]
    if wanted not in told:
        raise BitmapError(f"no variable {wanted[:40]!r}; {choices(wanted, list(told)[:20])}")
    matrix = told[wanted]
    if not isinstance(matrix, np.ndarray) or matrix.ndim != 2 or not matrix.size:
        raise BitmapError(f"{wanted}: is {_kind(matrix)}; expected a full matrix of real numbers")
    if max(matrix.shape) > SIDE_LIMIT:
        raise BitmapError(f"{wanted}: is {_kind(matrix)}; expected up to {SIDE_LIMIT} rows and columns")
    return wanted, matrix


def _may_be_bitmap(value: Variable) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 2 and min(value.shape) >= LEAST_SIDE


def _listed(variables: Mapping[str, Variable], names: list[str]) -> str:
    more = ", ..." if len(names) > 10 else ""
    return ", ".join(f"{name}: {_kind(variables[name])}" for name in names[:10]) + more or "none"


def _kind(value: Variable) -> str:
    if isinstance(value, Foreign):
        return value.kind
    return "text" if isinstance(value, tuple) else " x ".join(map(str, value.shape))


def _plain(name: str) -> str:
    return "".join(each if each.isprintable() else "?" for each in name)[:63]


def _may_be_mat(data: bytes) -> bool:
    """Return whether bytes begin as a MAT file of any version, whole or not."""
    low, high = (int.from_bytes(data[:4], order) for order in ("little", "big"))
    return (
        data[:4] in (b"\x89HDF", b"MATL")
        or data[_BYTE_ORDER : _BYTE_ORDER + 2] in (b"IM", b"MI")
        or min(low, high) < _LARGEST_KIND
    )


_BYTE_ORDER = 126
"""Place of the order of bytes in a file of Matlab 5 to 7."""

_LARGEST_KIND = 10_000
"""Numbers below begin a file of Matlab 4: the kind of its first matrix."""


def _dark(data: bytes, kind: str) -> Pixels:
    """Return the dark pixels of a picture: luminance, over white if transparent, below one half."""
    try:
        with warnings.catch_warnings(), _silent_libtiff():
            warnings.simplefilter("error")
            plain = _pixel_chunks(data) if kind == "PNG" else data
            with Image.open(BytesIO(plain), formats=[kind]) as picture:
                _check_size(*picture.size)
                dark = _dark_pixels(picture)
    except BitmapError:
        raise
    except UnidentifiedImageError:
        raise BitmapError(f"no whole {kind}: its head is damaged; expected the file as saved") from None
    # Pillow raises arbitrary exceptions for a damaged file.
    except Exception as error:
        reason = str(error).split("\n")[0][:100] or type(error).__name__
        raise BitmapError(f"no whole {kind}: {reason}; expected the file as saved") from None
    if not dark.any():
        raise BitmapError("no pixel is dark; expected a picture with dark walls or blocks on a bright floor")
    return dark


@contextmanager
def _silent_libtiff() -> Generator[None]:
    """Keep libtiff from printing what it finds, as it does by itself, where Pillow's one can be reached."""
    with ExitStack() as restored:
        with suppress(AttributeError, OSError):
            library = ctypes.CDLL(Image.core.__file__)
            for name in ("TIFFSetErrorHandler", "TIFFSetWarningHandler"):
                exchange = getattr(library, name)
                exchange.argtypes, exchange.restype = [ctypes.c_void_p], ctypes.c_void_p
                restored.callback(exchange, exchange(None))
        yield


def _dark_pixels(picture: Image.Image) -> Pixels:
    if picture.mode == "F" or (picture.mode == "I" and picture.format == "TIFF"):
        raise BitmapError("pixels of 32 bits; expected black and white, greys or colours of 8 or 16 bits")
    if picture.mode.startswith("I"):
        # 16 bits of grey; one value of them may stand for transparent.
        deep = np.asarray(picture)
        return np.asarray((deep < 2**15) & (deep != picture.info.get("transparency", -1)))
    grey, alpha = np.moveaxis(np.asarray(picture.convert("LA")), -1, 0)
    # 255 - (255 - grey) * alpha / 255 < 127.5
    return np.asarray((255 - grey).astype(np.uint16) * alpha > 127.5 * 255)


def _pixel_chunks(data: bytes) -> bytes:
    """Return a PNG without text, profiles and animation, which can be zip bombs; check its size.

    Pillow alone unpacks them all: 24 s for 10 MB of colour profiles.
    """
    kept, place, count = [_PNG], len(_PNG), 0
    while place < len(data):
        count += 1
        if count > CHUNK_LIMIT:
            raise BitmapError(f"a PNG of more than {CHUNK_LIMIT} parts; expected one saved anew")
        if place + 12 > len(data):
            break
        size, kind = struct.unpack(">I4s", data[place : place + 8])
        if count == 1:
            _check_header(kind, data[place + 8 : place + 16])
        if kind in _PIXEL_CHUNKS:
            kept.append(data[place : place + 12 + size])
        place += 12 + size
        if kind == b"IEND":
            break
    return b"".join(kept)


def _check_header(kind: bytes, header: bytes) -> None:
    if kind != b"IHDR" or len(header) != 8:
        raise BitmapError("no whole PNG: begins without its size; expected the file as saved")
    _check_size(*struct.unpack(">II", header))


def _check_size(width: int, height: int) -> None:
    if not (1 <= width <= SIDE_LIMIT and 1 <= height <= SIDE_LIMIT):
        raise BitmapError(f"{height} x {width} pixels; expected 1 to {SIDE_LIMIT} rows and columns")
