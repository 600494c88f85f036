"""A fuzz target: damaged playpen files, MAT files, pictures, networks and snapshots.

    python -m checks fuzz-files toml 1000000 --jobs 2

Each input depends on the kind's seeds and its number alone, so that a finding is reproducible:
`--first NUMBER` starts there. A job may use 512 MB more than after all imports. An input that takes 2 s is a
finding, and 10 s end the job.
"""

import random
import re
import resource
import signal
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image, ImageDraw

from tools.command_table import ROOT, command_line

if TYPE_CHECKING:
    from khep_twin.world import World

CORPUS = ROOT / "tests" / "data" / "corpus"
PLAYPENS = ROOT / "khep_twin" / "assets" / "playpens"
SECONDS, MEMORY = 2.0, 2**29

SNAPSHOT_HEAD = 26
"""Length of a snapshot's head [bytes]."""

_TAGS = 0, 1, 4, 256, 259, 273, 277, 279, 2**16 - 1

TOKENS = {
    "toml": [
        *(b"nan inf -1 0 1e999 1_0 0x10 1979-05-27 true [ ] [[ ]] { } = . , #".split()),
        *(b"\" ' \"\"\" ''' \\u0000 \\".split()),
        *(b"\n[[block]]\n \n[[robot]]\n \n[arena]\n \xff \xef\xbb\xbf \0 x_mm name a.a.a.a.a.a".split(b" ")),
        *(b'model = "khepera4"', b'"kh4server"', b'rom = "5.02"', b'turrets = ["gripper"]'),
        *(b"[" * 3000, b"a." * 3000, b"9" * 5000, b"{a=" * 500),
    ],
    "mat": [
        *(number.to_bytes(4, order) for number in (0, 1, 2, 5, 9, 14, 15) for order in ("little", "big")),
        *(number.to_bytes(4, "little") for number in (2**31 - 1, 2**31, 2**32 - 1, 44, 0x0801, 0x40009)),
    ],
    "png": [
        *(b"IHDR PLTE tRNS IDAT IEND iCCP zTXt iTXt tEXt acTL fdAT gAMA eXIf".split()),
        *(number.to_bytes(4, "big") for number in (0, 1, 13, 4096, 4097, 2**31 - 1, 2**32 - 1)),
    ],
    "npz": [
        *(b"PK\1\2 PK\3\4 PK\5\6 \x93NUMPY <f8 |O <U1 <U999999 >i8 <f2 |b1 True".split()),
        *(b"(99999999999,) (-1,) () (8, 1)".split(b" ")),
        *(number.to_bytes(4, "little") for number in (0, 1, 8, 2**31 - 1, 2**32 - 1, 0xD800, 0x110000)),
    ],
    "snapshot": [
        *(b'null true false NaN Infinity -1 1e999 0.5 [] {} AAAAAAAA AAAAAAA= __-_ / + " [ ] , :'.split()),
        *(b"9223372036854775807", b"9" * 400, b"[" * 3000, b"\\ud800", b"kh4server", b"\0"),
    ],
    "picture": [
        *(b"P1 P2 P3 P4 P5 P6 GIF89a BM II*\0 MM\0* II+\0".split(b" ")),
        *(b"\n# a\n", b" 65535\n", b"4096 4096\n", b"9" * 5000),
        *(b"\x21\xf9\x04", b"\x21\xff\x0b", b"\x2c\0\0\0\0", b"\x3b"),
        *(b"\xff%c\0\x08" % marker for marker in b"\xc0\xc2\xc4\xd8\xd9\xda\xdb\xdd\xe0\xee"),
        *(number.to_bytes(2, order) for number in _TAGS for order in ("little", "big")),
        *(number.to_bytes(4, order) for number in (1, 4097, 2**31 - 1) for order in ("little", "big")),
    ],
}
"""Bytes that mutations insert."""


def toml_target(data: bytes) -> None:
    """Check a playpen."""
    from khep_twin import playpen
    from khep_twin.errors import PlaypenError

    try:
        text = data.decode()
    except UnicodeDecodeError:
        return
    message = ""
    try:
        playpen.parse(text, "x.toml")
    except PlaypenError as error:
        message = str(error)
    assert message.replace("\n", "").isprintable(), message
    assert all(re.match(r"x\.toml:(\d+:)? ", line) for line in message.split("\n") if message), message


def bitmap_target(data: bytes) -> None:
    """Check a bitmap and the playpen converted from it."""
    from khep_twin.errors import BitmapError, MatError
    from khep_twin.playpen import bitmap, bitmap_files

    message = ""
    try:
        bitmap.to_playpen(bitmap_files.decode(data).solid, "x", mm_per_pixel=5.0)
    except (BitmapError, MatError) as error:
        message = str(error)
    assert message.isprintable(), message


def network_target(data: bytes) -> None:
    """Check a network."""
    from khep_twin.episodes import network_file
    from khep_twin.errors import ControllerError

    message = ""
    try:
        network_file.decode(data, Path("x.npz"))
    except ControllerError as error:
        message = str(error)
    assert message.isprintable(), message
    assert len(message) < 1000, message


def snapshot_target(data: bytes) -> None:
    """Restore a snapshot, and continue its run."""
    from khep_twin.errors import KhepTwinError

    message = ""
    try:
        world, head = _snapshot_world()
        world.restore(head + zlib.compress(data, 1))
        world.advance(0.02)
        world.snapshot()
    except KhepTwinError as error:
        message = str(error)
    assert message.isprintable(), message
    assert len(message) < 1000, message


@cache
def _snapshot_world() -> "tuple[World, bytes]":
    """Return a world of a Khepera and two Kheperas IV, and the head of its snapshots."""
    from khep_twin.world import World

    world = World("arena4-two", compiled=False)
    return world, world.snapshot()[:SNAPSHOT_HEAD]


def _snapshots() -> Iterator[bytes]:
    """Yield the texts of snapshots of a run."""
    world, _ = _snapshot_world()
    world.reset(seed=1)
    for robot, command in zip(world.robots, (b"D,150,120\r\n", b"A,0\r\n", b"D,5,9\n"), strict=True):
        robot.send(command)
    for _ in range(4):
        world.advance(0.1175)
        yield zlib.decompress(world.snapshot()[SNAPSHOT_HEAD:])


TARGETS: dict[str, Callable[[bytes], None]] = {
    "toml": toml_target,
    "mat": bitmap_target,
    "png": bitmap_target,
    "picture": bitmap_target,
    "npz": network_target,
    "snapshot": snapshot_target,
}

PICTURES = {
    "TIFF": ("1", "L", "P", "LA", "RGB", "CMYK", "I;16"),
    "GIF": ("1", "L", "P"),
    "BMP": ("1", "L", "P", "RGB"),
    "PPM": ("1", "L", "RGB", "I;16"),
    "JPEG": ("L", "RGB", "CMYK"),
}
"""Modes of the pictures of each format, by Pillow's names."""

PACKINGS = "packbits", "tiff_lzw", "tiff_adobe_deflate", "jpeg"
PLAIN = b"P1\n# plain\n4 4\n1111 1001\n1001 1111\n", b"P2\n4 3\n255\n0 0 0 0 0 9 255 0 0 0 0 0\n"


def seeds_of(kind: str) -> list[bytes]:
    """Return the undamaged files from which inputs of a kind are derived."""
    if kind == "snapshot":
        return [*_snapshots()]
    if kind == "picture":
        return [*_pictures(), *PLAIN]
    paths = sorted(CORPUS.glob(f"*.{kind}"))
    if kind == "toml":
        paths += sorted(PLAYPENS.glob("arena4*.toml"))
    return [path.read_bytes() for path in paths]


def _pictures() -> Iterator[bytes]:
    picture = Image.new("L", (30, 24), 255)
    ImageDraw.Draw(picture).rectangle((0, 0, 29, 23), outline=0, width=2)
    ImageDraw.Draw(picture).rectangle((9, 8, 15, 13), fill=0)
    for name, modes in PICTURES.items():
        for mode in modes:
            yield _saved(picture.convert(mode), name)
    for packing in PACKINGS:
        yield _saved(picture, "TIFF", compression=packing)
    yield _saved(picture.convert("1"), "TIFF", compression="group4")
    yield _saved(picture, "TIFF", big_tiff=True)
    yield _saved(picture, "JPEG", progressive=True)
    for name in ("GIF", "TIFF"):
        yield _saved(picture, name, save_all=True, append_images=[picture.rotate(90)])


def _saved(picture: Image.Image, name: str, **options: object) -> bytes:
    picture.save(file := BytesIO(), name, **options)
    return file.getvalue()


def mutate(seeds: list[bytes], kind: str, number: int) -> bytes:
    """Return the input of a number."""
    rng = random.Random(number)
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 4, 8))):
        place = rng.randrange(len(data) + 1)
        match rng.randrange(7):
            case 0 if data:
                data[place % len(data)] = rng.randrange(256)
            case 1 if data:
                data[place % len(data)] ^= 1 << rng.randrange(8)
            case 2:
                del data[place : place + rng.choice((1, 4, 30, len(data)))]
            case 3:
                piece = data[place : place + rng.randrange(1, 60)]
                data[rng.randrange(len(data) + 1) : 0] = piece * rng.choice((1, 1, 2, 20))
            case 4:
                other = rng.choice(seeds)
                start = rng.randrange(len(other))
                data[place:place] = other[start : start + rng.randrange(1, 200)]
            case 5:
                data[place:place] = rng.choice(TOKENS[kind])
            case _:
                token = rng.choice(TOKENS[kind])
                data[place : place + len(token)] = token
    # Most damage is caught by checksums; half of them are corrected.
    is_corrected = kind in ("png", "npz") and rng.random() < 0.5
    return (_fix_checksums if kind == "png" else _repack)(bytes(data)) if is_corrected else bytes(data)


def _repack(data: bytes) -> bytes:
    """Return an NPZ file whose arrays are packed again; a file with a damaged index stays unchanged."""
    packed = BytesIO()
    with suppress(zipfile.BadZipFile, ValueError, NotImplementedError):
        with zipfile.ZipFile(BytesIO(data)) as archive, zipfile.ZipFile(packed, "w") as target:
            for entry in archive.infolist():
                # Behind 30 bytes and the name, in which another length may stand than in the index.
                start = entry.header_offset + 30 + len(entry.filename)
                target.writestr(zipfile.ZipInfo(entry.filename), data[start : start + entry.file_size])
    return packed.getvalue() or data


def _fix_checksums(data: bytes) -> bytes:
    place, parts = 8, [data[:8]]
    while place + 12 <= len(data):
        size = int.from_bytes(data[place : place + 4], "big")
        content = data[place + 4 : place + 8 + size]
        parts += [data[place : place + 4], content, zlib.crc32(content).to_bytes(4, "big")]
        place += 12 + size
    return b"".join(parts)


def run(kind: str, runs: int, first: int) -> None:
    """Feed a target; the process ends at a finding.

    Raises:
        AssertionError: An input is a finding.
    """
    # Imports do not count.
    seeds = seeds_of(kind)
    for seed in seeds:
        TARGETS[kind](seed)
    status = Path("/proc/self/status").read_text()
    now = 1024 * int(status.split("VmSize:")[1].split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, now + MEMORY))
    run_start, slowest = time.perf_counter(), (0.0, first)
    for number in range(first, first + runs):
        data = mutate(seeds, kind, number)
        signal.setitimer(signal.ITIMER_REAL, 10)
        start = time.perf_counter()
        try:
            TARGETS[kind](data)
        except BaseException:
            print(f"{kind} input {number}: {data[:200]!r}", file=sys.stderr)
            raise
        slowest = max(slowest, (time.perf_counter() - start, number))
        assert slowest[0] < SECONDS, f"{kind} input {number} took {slowest[0]:.1f} s"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{kind}: {runs} inputs from {first} in {time.perf_counter() - run_start:.0f} s, "
        f"the slowest {slowest[0] * 1000:.0f} ms (input {slowest[1]}), {peak:.0f} MB"
    )


def main() -> int:
    """Distribute the inputs over jobs; return 1 if there is a finding."""
    parser = command_line(__doc__)
    parser.add_argument("kind", choices=list(TARGETS))
    parser.add_argument("runs", type=int, nargs="?", default=200_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    if options.jobs == 1:
        run(options.kind, options.runs, options.first)
        return 0
    share = -(-options.runs // options.jobs)
    command = [sys.executable, "-m", "checks", "fuzz-files", options.kind, str(share), "--first"]
    firsts = range(options.first, options.first + share * options.jobs, share)
    jobs = [subprocess.Popen([*command, str(first)]) for first in firsts]
    return max(bool(job.wait()) for job in jobs)
