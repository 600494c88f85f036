"""The command `khep-twin playpen import`: its files, output and errors."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import complaint, good, khep_twin
from drawn_bitmap import drawn, seen_from_above
from PIL import Image
from scipy.io import savemat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from khep_twin.cli.playpen import check
from khep_twin.playpen import Playpen
from khep_twin.world import World

DRAWN = drawn()
PAGE = (Path(__file__).parents[2] / "docs" / "import.md").read_text()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One with scans, which stand upside down, and a picture."""
    scan = np.where(DRAWN, 44, 1)[::-1]
    savemat(tmp_path / "old scan.mat", {"btmap1": scan.astype(np.float64)}, format="4")
    savemat(tmp_path / "scan.mat", {"btmap1": scan.astype(np.uint8)}, do_compression=True)
    Image.fromarray(~DRAWN).save(tmp_path / "painted.png")
    return tmp_path


@pytest.mark.share(3)
@pytest.mark.parametrize("file", ["old scan.mat", "scan.mat", "painted.png"])
def test_scan_and_picture_become_the_playpen_as_it_was_drawn(file: str, folder: Path) -> None:
    good("playpen", "import", file, "-o", "out.toml", folder=folder)
    imported = Playpen.load(folder / "out.toml")
    np.testing.assert_array_equal(seen_from_above(imported), DRAWN[10:-10, 10:-10])
    assert imported.name == Path(file).stem.replace(" ", "-")
    text = (folder / "out.toml").read_text()
    assert text.startswith(f'# Imported from "{file}" by khep-twin playpen import.\n\nversion = 1\n')
    good("playpen", "check", "out.toml", folder=folder)


def test_the_command_reports_what_it_found_and_made(folder: Path) -> None:
    assert good("playpen", "import", "scan.mat", folder=folder) == (
        f"bitmap   btmap1, 500 x 600 pixels of 1 mm, {DRAWN.sum()} of them solid\n"
        "flip     its first row is the bottom (the toolbox's scan turned the right way up); "
        "--no-flip for the other way\n"
        "walls    10 mm left, 10 mm right, 10 mm bottom, 10 mm top; now 10 mm thick\n"
        "arena    580 x 480 mm within the walls\n"
        "blocks   136\n"
        "robot    at (290, 240), heading 90 degrees\n"
        "playpen  scan.toml\n"
    )
    output = good("playpen", "import", "painted.png", folder=folder)
    assert "flip     its first row is the top; --flip for the other way\n" in output


@pytest.mark.parametrize(("file", "option"), [("scan.mat", "--no-flip"), ("painted.png", "--flip")])
def test_the_other_way_up_is_an_option(file: str, option: str, folder: Path) -> None:
    good("playpen", "import", file, option, "-o", "out.toml", folder=folder)
    imported = Playpen.load(folder / "out.toml")
    np.testing.assert_array_equal(seen_from_above(imported), DRAWN[::-1][10:-10, 10:-10])


def test_options_name_scale_and_place(folder: Path) -> None:
    words = "--name maze --mm-per-pixel 2 --height-mm 80 --robot 500,240.5,-45 -o out.toml".split()
    output = good("playpen", "import", "scan.mat", *words, folder=folder)
    imported = Playpen.load(folder / "out.toml")
    (robot,) = imported.robots
    assert (robot.x_mm, robot.y_mm, robot.heading_deg) == (500, 240.5, -45)
    assert (imported.name, imported.arena.width_mm, imported.arena.wall_thickness_mm) == ("maze", 1160, 20)
    assert {block.height_mm for block in imported.blocks} == {80}
    assert "robot    at (500, 240.5), heading -45 degrees\n" in output


def test_a_playpen_may_have_no_robot(folder: Path) -> None:
    assert "robot    none\n" in good("playpen", "import", "scan.mat", "--robot", "none", folder=folder)
    assert Playpen.load(folder / "scan.toml").robots == ()


@pytest.mark.parametrize(
    ("values", "words", "line"),
    [
        (
            {"a": np.eye(50), "b": np.ones((20, 30))}, "",
            "several matrices (a: 50 x 50, b: 20 x 30); expected --variable with one of them",
        ),
        (
            {"objects": np.ones((5, 4))}, "",
            "no bitmap among its variables (objects: 5 x 4): probably an editable playpen; expected the "
            "scanned one, with btmap1, which Scan Playpen writes",
        ),
        (
            {"btmap1": np.eye(200) * 44}, "--robot 100,100,0",
            "robot 1 at (100, 100) overlaps block 81 at (119.5, 119.5); expected a place clear of it",
        ),
        (
            {"btmap1": np.eye(200) * 44}, "--mm-per-pixel 0.6",
            "a block of 0.6 mm; expected at least 1 mm, as from a picture of fewer pixels with a larger "
            "--mm-per-pixel",
        ),
        (
            {"btmap1": np.eye(200) * 44}, "--name a/b",
            "name = \"a/b\"; expected 1 to 64 letters, digits, '_' or '-'",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_imported_is_reported_in_one_line_and_nothing_is_written(
    values: dict[str, Any], words: str, line: str, tmp_path: Path
) -> None:
    savemat(tmp_path / "x.mat", values)
    arguments = ("playpen", "import", "x.mat", *words.split(), "-o", "out.toml")
    assert complaint(*arguments, folder=tmp_path, codes=[1]) == f"x.mat: {line}"
    assert not (tmp_path / "out.toml").exists()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("none.mat", "none.mat: cannot be read: No such file or directory"),
        ("painted.png --solid 1", "painted.png: a PNG; expected a MAT file for --variable and --solid"),
        ("painted.png --robot 1,2", '--robot 1,2: expected X,Y,HEADING, such as 300,250,90, or "none"'),
        (
            "painted.png -o no/out.toml",
            "no/out.toml: cannot be written: there is no directory no; to make it: mkdir -p no",
        ),
    ],
)
def test_a_mistake_in_the_command_is_reported_in_one_line(words: str, line: str, folder: Path) -> None:
    assert complaint("playpen", "import", *words.split(), folder=folder, codes=[1]) == line


def test_the_page_on_the_import_reports_what_the_command_does(tmp_path: Path, monkeypatch: Any) -> None:
    (paints,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (example,) = re.findall(r"```\n(bitmap .*?)```", PAGE, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(paints, "import.md", "exec"), {})
    assert good("playpen", "import", "scan.mat", "-o", "scan.toml", folder=tmp_path) == example
    (block,) = Playpen.load(tmp_path / "scan.toml").blocks
    assert (block.x_mm, block.y_mm) == (300, 120)


def test_the_head_of_a_random_playpen_makes_it_again(tmp_path: Path) -> None:
    words = ("--density", 0.05, "--seed", 3, "--width-mm", 2000, "--height-mm", 600)
    text = khep_twin("playpen", "random", *words, folder=tmp_path).stdout
    head = text.splitlines()[0].split()
    assert khep_twin(*head[2:], folder=tmp_path).stdout == text


def test_a_calibration_that_is_missing_is_named_with_its_playpen_and_robot(tmp_path: Path) -> None:
    tmp_path.joinpath("arena.toml").write_text(
        'version = 1\nname = "a"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
        '[[robot]]\nx_mm = 99\ny_mm = 99\nheading_deg = 0\ncalibration = "none.toml"\n'
    )
    process = khep_twin("playpen", "check", "arena.toml", folder=tmp_path)
    assert re.match(r"khep-twin: arena.toml: robot 1: calibration = .*none.toml: ", process.stderr), (
        process.stderr
    )


def test_a_scene_of_many_robots_is_announced_and_a_check_warns_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    check("default")
    World("default")
    output = capsys.readouterr()
    assert (output.out, output.err) == ("default: 1 robot: no problem\n", "")
    for module in ("khep_twin.playpen.model", "khep_twin.simulation.mujoco_forms"):
        monkeypatch.setattr(f"{module}.MANY_ROBOTS", 0)
    check("default")
    World("default")
    output = capsys.readouterr()
    assert output.out.splitlines()[1].startswith("note: with more than 0 robots a playpen compiles slowly")
    making = "khep_twin: making the scene of 1 robots"
    assert re.fullmatch(rf"{making}, which takes long\n{making}: \d+ s\n", output.err)


def test_a_log_of_another_playpen_is_not_drawn(tmp_path: Path) -> None:
    khep_twin("run", "braitenberg", "--seconds", 1, "--log", "run.mcap", folder=tmp_path)
    process = khep_twin("playpen", "draw", "two-lamps", "--log", "run.mcap", folder=tmp_path)
    assert process.stderr == "khep-twin: run.mcap: a run in playpen default; expected one in two-lamps\n"
    assert not tmp_path.joinpath("two-lamps.png").exists()
