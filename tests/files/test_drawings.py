"""Drawings may be replaced if they are unchanged."""

from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import complaint, good
from PIL import Image

from khep_twin.files.drawings import add_checksum, is_replaceable


def _paint(path: Path) -> None:
    with Image.open(path) as picture:
        picture.putpixel((5, 5), (0, 0, 0))
        picture.save(path, pnginfo=picture.info.get("pnginfo"))


def _add_note(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"</svg>", b"<!-- a note --></svg>"))


@pytest.mark.share(3)
@pytest.mark.parametrize(("name", "change"), [("map.png", _paint), ("map.svg", _add_note), ("map.pdf", None)])
def test_a_map_is_drawn_again_until_someone_changes_it(
    name: str, change: Callable[[Path], None] | None, tmp_path: Path
) -> None:
    words, file = ("playpen", "draw", "default", "-o", name), tmp_path / name
    good(*words, folder=tmp_path)
    drawn = file.read_bytes()
    good(*words, folder=tmp_path)
    assert file.read_bytes() == drawn
    if change is not None:
        change(file)
        changed = file.read_bytes()
        assert "is there already" in complaint(*words, folder=tmp_path)
        assert file.read_bytes() == changed != drawn
        good(*words, "--force", folder=tmp_path)
        assert file.read_bytes() == drawn


def test_a_scan_that_was_imported_is_no_drawing(tmp_path: Path) -> None:
    """The default name of the playpen's picture is that of the scan."""
    scan = tmp_path / "maze.png"
    picture = Image.new("L", (300, 300), 255)
    picture.paste(0, (100, 100, 150, 200))
    picture.save(scan)
    scan_data = scan.read_bytes()
    good("playpen", "import", "maze.png", folder=tmp_path)
    message = complaint("playpen", "draw", "maze.toml", folder=tmp_path)
    assert message == "maze.png: is there already; expected another name, or --force to replace it"
    assert scan.read_bytes() == scan_data


@pytest.mark.parametrize("head", [b"\x89PNG\r\n\x1a\n", b"<svg>", b"%PDF-1.4\n", b"<!doctype html>"])
def test_a_drawing_is_known_by_all_of_its_bytes(head: bytes, tmp_path: Path) -> None:
    file, data = tmp_path / "drawing", add_checksum(head + bytes(range(100)))
    for changed in (data, data[:-1], data + b"\n", data.replace(b"\5", b"\6"), b"", b"\x89PNG\r\n\x1a\n"):
        file.write_bytes(changed)
        assert is_replaceable(file) == (changed in (data, b""))
