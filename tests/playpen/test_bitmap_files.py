"""Bitmaps from files: scans and pictures are read alike, other files are refused in one line."""

import io
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_bitmap import drawn
from numpy.typing import NDArray
from PIL import Image
from scipy.io import savemat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from khep_twin.errors import BitmapError
from khep_twin.playpen import bitmap_files
from khep_twin.playpen.bitmap_files import Bitmap, decode

DRAWN = drawn()
SCAN = np.where(DRAWN, 44, 1)


def mat_data(values: dict[str, Any], **options: Any) -> bytes:
    file = io.BytesIO()
    savemat(file, values, **options)
    return file.getvalue()


def png(picture: Image.Image, **options: Any) -> bytes:
    return picture_data("PNG", picture, **options)


def picture_data(kind: str, picture: Image.Image, **options: Any) -> bytes:
    file = io.BytesIO()
    picture.save(file, kind, **options)
    return file.getvalue()


def grey(values: NDArray[Any]) -> Image.Image:
    return Image.fromarray(values.astype(np.uint8))


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_header(width: int, height: int, bits: int = 8, colours: int = 0) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">II5B", width, height, bits, colours, 0, 0, 0))


def refusal(data: bytes, *arguments: Any) -> str:
    with pytest.raises(BitmapError) as caught:
        decode(data, *arguments)
    return str(caught.value)


@pytest.mark.parametrize("version", ["4", "5"])
@pytest.mark.parametrize("dtype", ["u1", "f8"])
def test_a_scan_is_read_as_it_lies_in_the_file(version: str, dtype: str) -> None:
    bitmap = decode(mat_data({"btmap1": SCAN.astype(dtype), "other": np.eye(20)}, format=version))
    assert (bitmap.label, bitmap.is_scan) == ("btmap1", True)
    np.testing.assert_array_equal(bitmap.solid, DRAWN)


def test_the_only_matrix_is_the_bitmap_whatever_its_name_and_values() -> None:
    data = mat_data({"map": DRAWN, "small": np.eye(3), "note": "text"})
    np.testing.assert_array_equal(decode(data, None, 1).solid, DRAWN)
    np.testing.assert_array_equal(decode(data, "map", 0).solid, ~DRAWN)


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "LA"])
def test_a_picture_of_any_kind_is_solid_where_it_is_dark(mode: str) -> None:
    bitmap = decode(png(grey(np.where(DRAWN, 20, 230)).convert(mode, dither=Image.Dither.NONE)))
    assert (bitmap.label, bitmap.is_scan) == ("picture", False)
    np.testing.assert_array_equal(bitmap.solid, DRAWN)


def test_the_border_between_dark_and_bright_is_one_half() -> None:
    np.testing.assert_array_equal(decode(png(grey(np.array([[127, 128]])))).solid, [[True, False]])
    levels = Image.fromarray(np.array([[32767, 32768]], dtype=np.uint16))
    np.testing.assert_array_equal(decode(png(levels)).solid, [[True, False]])
    colours = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], dtype=np.uint8)
    np.testing.assert_array_equal(decode(png(Image.fromarray(colours))).solid, [[True, False, True]])


def test_what_is_transparent_is_free() -> None:
    ink = np.zeros((1, 4, 4), dtype=np.uint8)
    ink[0, :, 3] = [0, 127, 128, 255]
    np.testing.assert_array_equal(decode(png(Image.fromarray(ink))).solid, [[False, False, True, True]])
    for mode in ("L", "P", "1"):
        picture = grey(np.array([[0, 255]])).convert(mode)
        if mode != "P":
            assert refusal(png(picture, transparency=0)).startswith("no pixel is dark")
    indices = Image.fromarray(np.array([[0, 1]], dtype=np.uint8))
    indices.putpalette([0, 0, 0, 10, 10, 10])
    np.testing.assert_array_equal(decode(png(indices, transparency=0)).solid, [[False, True]])
    levels = Image.fromarray(np.array([[7, 8]], dtype=np.uint16))
    np.testing.assert_array_equal(decode(png(levels, transparency=7)).solid, [[False, True]])


@pytest.mark.parametrize(
    ("values", "arguments", "line"),
    [
        (
            {"map": np.eye(12), "other": np.eye(20)}, (),
            "several matrices (map: 12 x 12, other: 20 x 20); expected --variable with one of them",
        ),
        (
            {"objects": np.eye(4), "axes": {"x": 1}, "note": "text"}, (),
            "no bitmap among its variables (objects: 4 x 4, axes: a struct, note: text): probably an "
            "editable playpen; expected the scanned one, with btmap1, which Scan Playpen writes",
        ),
        ({"btmap1": SCAN}, ("btmap",), "no variable 'btmap'; did you mean 'btmap1'? (choices: btmap1)"),
        ({"btmap1": {"a": 1}}, (), "btmap1: is a struct; expected a full matrix of real numbers"),
        ({"btmap1": "text"}, (), "btmap1: is text; expected a full matrix of real numbers"),
        ({"btmap1": np.zeros((2, 2, 2))}, (), "btmap1: is 2 x 2 x 2; expected a full matrix of real numbers"),
        (
            {"btmap1": np.zeros((5000, 2), np.uint8)}, (),
            "btmap1: is 5000 x 2; expected up to 4096 rows and columns",
        ),
        (
            {"btmap1": np.eye(20)}, (),
            "btmap1: no pixel is 44; expected --solid with one of its values (0, 1)",
        ),
    ],
)  # fmt: skip
def test_a_mat_file_without_a_bitmap_is_reported_in_one_line(
    values: dict[str, Any], arguments: tuple[Any, ...], line: str
) -> None:
    assert refusal(mat_data(values), *arguments) == line


def test_a_mat_file_of_nothing_is_no_bitmap() -> None:
    assert refusal(mat_data({})).startswith(
        "no bitmap among its variables (none): probably an editable playpen"
    )


PNG = png(grey(np.where(DRAWN, 0, 255)))


@pytest.mark.parametrize(
    ("data", "arguments", "line"),
    [
        (PNG, ("btmap1",), "a PNG; expected a MAT file for --variable and --solid"),
        (PNG, (None, 1), "a PNG; expected a MAT file for --variable and --solid"),
        (PNG[:8], (), "no whole PNG: its head is damaged; expected the file as saved"),
        (PNG[:20], (), "no whole PNG: begins without its size; expected the file as saved"),
        (PNG[:30], (), "no whole PNG: its head is damaged; expected the file as saved"),
        (PNG[:600], (), "no whole PNG: "),
        (
            png_header(4097, 10), (), "10 x 4097 pixels; expected 1 to 4096 rows and columns",
        ),
        (png_header(0, 10), (), "10 x 0 pixels; expected 1 to 4096 rows and columns"),
        (
            png_header(100_000, 100_000), (), "100000 x 100000 pixels; expected 1 to 4096 rows and columns",
        ),
        (
            png_header(9, 9) + chunk(b"tEXt", b"") * 100_000, (),
            "a PNG of more than 100000 parts; expected one saved anew",
        ),
        (
            b"\x89PNG\r\n\x1a\n" + chunk(b"IDAT", bytes(20)), (),
            "no whole PNG: begins without its size; expected the file as saved",
        ),
        (
            png(grey(np.full((9, 9), 255))), (),
            "no pixel is dark; expected a picture with dark walls or blocks on a bright floor",
        ),
        (
            b"GIF89a", (), "no whole GIF: its head is damaged; expected the file as saved",
        ),
        (
            b"%!PS-Adobe-3.0 EPSF-3.0\n........", (),
            "begins b'%!PS-Ado'; expected a MAT file of Matlab 4 to 7.2, or a PNG, TIFF, GIF, BMP, JPEG, "
            "PBM, PGM or PPM",
        ),
        (b"RIFF\x24\x00\x00\x00WEBPVP8 ", (), "begins b'RIFF$\\x00\\x00\\x00'; expected a MAT file of "),
        (b"P4\n9 100000\n", (), "100000 x 9 pixels; expected 1 to 4096 rows and columns"),
        (
            picture_data("TIFF", Image.fromarray(np.zeros((9, 9), np.float32))), (),
            "pixels of 32 bits; expected black and white, greys or colours of 8 or 16 bits",
        ),
    ],
    ids=range(17),
)  # fmt: skip
def test_what_is_no_usable_picture_is_reported_in_one_line(
    data: bytes, arguments: tuple[Any, ...], line: str
) -> None:
    message = refusal(data, *arguments)
    assert message.startswith(line)
    assert message.isprintable()


PICTURES = [
    (kind, mode, options)
    for kind, modes in (
        ("TIFF", ("1", "L", "P", "RGB", "LA", "RGBA", "CMYK")),
        ("GIF", ("1", "L", "P")),
        ("BMP", ("1", "L", "P", "RGB")),
        ("PPM", ("1", "L", "RGB")),
        ("JPEG", ("L", "RGB")),
    )
    for mode in modes
    for options in (({}, {"compression": "group4"}) if (kind, mode) == ("TIFF", "1") else ({},))
]


@pytest.mark.parametrize(("kind", "mode", "options"), PICTURES)
def test_pictures_of_many_kinds_are_read_alike(kind: str, mode: str, options: dict[str, str]) -> None:
    bitmap = decode(picture_data(kind, grey(np.where(DRAWN, 0, 255)).convert(mode), **options))
    assert (bitmap.label, bitmap.is_scan) == ("picture", False)
    # JPEG blurs the edges.
    assert np.mean(bitmap.solid != DRAWN) < (0.01 if kind == "JPEG" else 1e-9)


@pytest.mark.parametrize("kind", ["TIFF", "PPM"])
def test_greys_of_16_bits_are_read(kind: str) -> None:
    picture = Image.fromarray(np.where(DRAWN, 20_000, 40_000).astype(np.uint16))
    assert np.array_equal(decode(picture_data(kind, picture)).solid, DRAWN)


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "GIF", "BMP", "PPM", "JPEG"])
def test_every_cut_of_a_picture_is_refused_or_read(kind: str) -> None:
    data = PNG if kind == "PNG" else picture_data(kind, grey(np.where(DRAWN[:60, :60], 0, 255)))
    for end in range(8, len(data), 7):
        try:
            assert isinstance(decode(data[:end]), Bitmap)
        except BitmapError as error:
            assert str(error).isprintable()  # noqa: PT017


def test_what_a_library_finds_in_a_damaged_picture_is_not_printed(capfd: pytest.CaptureFixture[str]) -> None:
    data = picture_data("TIFF", grey(np.where(DRAWN, 0, 255)), compression="tiff_lzw")
    assert refusal(data[:100] + b"\xff" * 99 + data[199:]).startswith("no whole TIFF: ")
    assert capfd.readouterr() == ("", "")


def test_packed_text_and_profiles_are_never_unpacked() -> None:
    packed = zlib.compress(bytes(2**20), 9)
    bombs = chunk(b"iCCP", b"a\0\0" + packed) + chunk(b"zTXt", b"a\0\0" + packed)
    start = time.process_time()
    bitmap = decode(PNG[:33] + bombs * 10_000 + PNG[33:])
    assert time.process_time() - start < 2
    np.testing.assert_array_equal(bitmap.solid, DRAWN)


def test_a_picture_in_very_many_pieces_is_read_in_time() -> None:
    packed = zlib.compress(np.random.default_rng(1).bytes(301 * 300), 0)
    pieces = b"".join(chunk(b"IDAT", bytes([byte])) for byte in packed)
    start = time.process_time()
    message = refusal(png_header(4000, 4000) + pieces[:-13])
    assert message.startswith("no whole PNG: ")
    assert time.process_time() - start < 2


PROGRAM = """
import resource, sys, time
from pathlib import Path
from khep_twin.playpen import bitmap, bitmap_files
size = int(Path("/proc/self/status").read_text().split("VmSize:")[1].split()[0]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (size + 2**29, size + 2**29))
start = time.process_time()
bitmap_read = bitmap_files.read(sys.argv[1])
print(time.process_time() - start, bitmap_read.solid.shape)
try:
    bitmap.to_playpen(bitmap_read.solid, "x")
except bitmap.BitmapError as error:
    print(error)
print(time.process_time() - start)
"""


@pytest.mark.long
@pytest.mark.parametrize("kind", ["grey", "colours", "deep", "scan"])
def test_the_largest_bitmaps_take_less_than_two_seconds_and_512_mb(kind: str, tmp_path: Path) -> None:
    checkers = (np.indices((4096, 4096), dtype=np.uint16).sum(axis=0) % 2).astype(np.uint8)
    path = tmp_path / "file"
    if kind == "scan":
        path.write_bytes(mat_data({"btmap1": checkers * 44}))
    else:
        bits, colours, pixel = {"grey": (8, 0, 1), "colours": (8, 6, 4), "deep": (16, 6, 8)}[kind]
        values = np.repeat(checkers * 255, pixel, axis=1)
        for alpha in range(pixel * 3 // 4, pixel if pixel > 1 else 0):
            values[:, alpha::pixel] = 255
        lines = np.pad(values, ((0, 0), (1, 0))).tobytes()
        packed = zlib.compress(lines, 1)
        data = png_header(4096, 4096, bits, colours) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")
        path.write_bytes(data)
    process = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path)], capture_output=True, text=True, timeout=60, check=False
    )
    assert process.returncode == 0, process.stderr
    first, message, second = process.stdout.splitlines()
    assert first.endswith(" (4096, 4096)")
    assert message.startswith("8388608 blocks; expected up to 4999")
    assert float(first.split()[0]) < 2
    assert float(second) < 4


def test_a_file_that_is_not_there_is_reported_by_its_path(tmp_path: Path) -> None:
    directory = "Is a directory; expected the name of a file"
    for path, reason in ((tmp_path / "none.mat", "No such file or directory"), (tmp_path, directory)):
        with pytest.raises(BitmapError) as caught:
            bitmap_files.read(path)
        assert str(caught.value) == f"{path}: cannot be read: {reason}"
