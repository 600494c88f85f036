"""Which file may import which: the floors of the design, as a table."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "khep_twin"

FLOORS = [
    [
        "errors",
        "stopping",
        "files",
        "invocation",
        "status_line",
        "units",
        "randomness",
        "clock",
        "fitness",
    ],
    [
        "toml_lines",
        "toml_edit",
        "toml_files",
        "footprint",
        "outline",
        "placement",
        "surfaces",
        "playpen_parts",
        "playpen_checks",
        "playpen",
        "mat_file",
        "calibration",
        "protocol",
        "rom",
        "kernel",
        "compiled_kernel",
        "uart",
        "supply",
        "faults",
        "turrets",
    ],
    [
        "bios",
        "firmware",
        "gripper",
        "gripper_body",
        "merging",
        "obstacle_field",
        "perspective",
        "playpen_to_mjcf",
        "lamps",
        "sightlines",
        "casting",
        "optics",
        "ambient",
        "sensors",
        "sensor_bars",
        "illumination",
        "labels",
        "symbols",
        "drawing",
        "bitmap",
        "bitmap_files",
    ],
    ["robot", "world", "placing", "switching", "mujoco_viewer"],
    ["ports", "host", "log"],
    ["lab", "scale"],
    ["web"],
    ["cli_completion", "cli_options", "cli_progress", "cli_streams"],
    [
        "cli",
        "cli_design",
        "cli_drive",
        "cli_fast",
        "cli_fit",
        "cli_log",
        "cli_playpen",
        "cli_ports",
        "cli_report",
        "cli_run",
        "cli_run_logs",
        "cli_sense",
        "cli_series",
        "cli_serve",
        "cli_sweep",
        "cli_view",
    ],
    ["__main__"],
]
"""From the ground up; a file imports from floors below its own."""

WITHIN_A_FLOOR = {
    ("files", "errors"),
    ("files", "stopping"),
    ("stopping", "errors"),
    ("compiled_kernel", "kernel"),
    ("firmware", "bios"),
    ("gripper_body", "gripper"),
    ("outline", "footprint"),
    ("placement", "footprint"),
    ("placement", "outline"),
    ("placement", "toml_files"),
    ("playpen_parts", "footprint"),
    ("playpen_parts", "outline"),
    ("playpen_parts", "surfaces"),
    ("playpen_parts", "toml_files"),
    ("playpen_parts", "turrets"),
    ("playpen_checks", "footprint"),
    ("playpen_checks", "outline"),
    ("playpen_checks", "placement"),
    ("playpen_checks", "playpen"),
    ("playpen_checks", "playpen_parts"),
    ("playpen_checks", "rom"),
    ("playpen_checks", "surfaces"),
    ("playpen_checks", "toml_files"),
    ("playpen_checks", "turrets"),
    ("playpen", "playpen_checks"),
    ("playpen", "playpen_parts"),
    ("toml_files", "toml_edit"),
    ("toml_files", "toml_lines"),
    ("playpen", "footprint"),
    ("playpen", "placement"),
    ("playpen", "rom"),
    ("playpen", "surfaces"),
    ("playpen", "toml_files"),
    ("playpen", "turrets"),
    ("surfaces", "toml_files"),
    ("world", "robot"),
    ("placing", "world"),
    ("switching", "world"),
    ("mujoco_viewer", "world"),
    ("playpen_to_mjcf", "merging"),
    ("perspective", "playpen_to_mjcf"),
    ("ambient", "lamps"),
    ("ambient", "sightlines"),
    ("ambient", "optics"),
    ("optics", "casting"),
    ("sensors", "casting"),
    ("sensors", "optics"),
    ("sensors", "ambient"),
    ("calibration", "toml_files"),
    ("bitmap_files", "bitmap"),
    ("symbols", "illumination"),
    ("symbols", "labels"),
    ("drawing", "labels"),
    ("drawing", "illumination"),
    ("drawing", "symbols"),
    ("host", "ports"),
    ("ports", "log"),
    ("cli", "cli_design"),
    ("cli", "cli_drive"),
    ("cli_run", "cli_fast"),
    ("cli", "cli_fit"),
    ("cli", "cli_run"),
    ("cli", "cli_series"),
    ("cli", "cli_serve"),
    ("cli", "cli_sweep"),
    ("scale", "lab"),
    ("cli_run", "cli_run_logs"),
    ("cli_serve", "cli_playpen"),
    ("cli", "cli_log"),
    ("cli", "cli_playpen"),
    ("cli", "cli_ports"),
    ("cli", "cli_report"),
    ("cli", "cli_sense"),
    ("cli", "cli_view"),
}
"""(importer, imported) pairs of one floor that are allowed all the same."""

SIMULATORS = {"mujoco", "dm_control", "rerun", "matplotlib", "numpy", "mcap"}
"""What `khep_twin.host` must do without, to run on a laptop beside the robot."""

ARRAYS = {"toolbox.py": {"numpy"}}
"""Files of it that may have one of them all the same: the toolbox's rows are arrays."""


def modules() -> list[Path]:
    """All that the package imports: templates, in assets, are programs of their users."""
    found = (path for path in PACKAGE.rglob("*.py") if PACKAGE / "assets" not in path.parents)
    return sorted(path for path in found if path.parent != PACKAGE or path.stem != "__init__")


def part_of(path: Path) -> str:
    """The file's or folder's name as the table has it."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            members = {f"khep_twin.{alias.name}" for alias in node.names}
            names |= members if node.module == "khep_twin" else {node.module}
    return names


def floor_of(part: str) -> int:
    return next(level for level, floor in enumerate(FLOORS) if part in floor)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_imports_only_from_floors_below(path: Path) -> None:
    own = part_of(path)
    for name in imports_of(path):
        package, _, rest = name.partition(".")
        part = rest.split(".")[0]
        if package != "khep_twin" or part in ("", "__version__", own):
            continue
        assert floor_of(part) < floor_of(own) or (own, part) in WITHIN_A_FLOOR, f"{path.name} imports {name}"


@pytest.mark.parametrize("path", sorted((PACKAGE / "host").glob("*.py")), ids=lambda path: path.name)
def test_the_host_imports_no_simulator(path: Path) -> None:
    packages = {name.split(".")[0] for name in imports_of(path)}
    assert not packages & (SIMULATORS - ARRAYS.get(path.name, set()))
