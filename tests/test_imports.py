"""The order of packages: which may import which."""

import ast
import re
from collections.abc import Container
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "khep_twin"

ORDER = [
    ["compilable", "copies", "lazy", "renamed"],
    ["errors", "clock", "units"],
    ["randomness", "process"],
    ["files"],
    ["board"],
    ["observers", "robots"],
    ["robots.khepera.model", "robots.khepera3.registers", "robots.khepera4.registers"],
    ["robots.khepera3.model", "robots.khepera4.model"],
    ["playpen"],
    ["sensing"],
    ["firmware", "sensors", "robots.to_mjcf"],
    ["robots.line_server"],
    ["playpen_to_mjcf", "robots.core"],
    ["step"],
    ["robots.khepera.core", "robots.measuring_core"],
    ["simulation"],
    ["vision"],
    ["robots.robot"],
    ["robots.khepera", "robots.measuring_robot"],
    ["stepper"],
    ["world"],
    ["programs"],
    ["interventions", "drawing"],
    ["log"],
    ["ports"],
    ["host"],
    ["episodes"],
    ["shadow"],
    ["envs"],
    ["lab.conformance", "lab.experiment", "lab.sensor_test"],
    ["robots.khepera3", "robots.khepera4"],
    ["lab.challenge", "lab.fit", "lab.report", "sweep"],
    ["lab.dataset"],
    ["toolbox"],
    ["web"],
    ["ros"],
    ["cli"],
    ["__main__"],
]
"""Packages and the modules of the top level; each imports only from lines above its own."""

SIMULATORS = {"mujoco", "dm_control", "rerun", "matplotlib", "numpy", "mcap"}
"""What `khep_twin.host` must do without, to run on a laptop beside the robot."""


NAMES_OF_PACKAGES = {PACKAGE / folder / "__init__.py" for folder in ("", "envs", "host", "lab")}
"""What names the packages below it, for type checkers and when a name is used."""


def modules() -> list[Path]:
    """Return all modules of the package, without the templates in assets, which are programs of users."""
    paths = (path for path in PACKAGE.rglob("*.py") if "assets" not in path.relative_to(PACKAGE).parts)
    return sorted(path for path in paths if path not in NAMES_OF_PACKAGES)


def part_of(name: str) -> str:
    """Return a module's part of ORDER, the longest that it is or is in."""
    parts = (part for parts in ORDER for part in parts if f"{name}.".startswith(f"{part}."))
    return max(parts, key=len)


def imports_of(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            members = {f"khep_twin.{alias.name}" for alias in node.names}
            names |= members if node.module == "khep_twin" else {node.module}
    return names


def name_of(path: Path) -> str:
    """Return the name of a module, or of a package for its `__init__`."""
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def imported_modules(path: Path, known_modules: Container[str]) -> set[str]:
    """Return the modules that a module imports, or whose names it does, also those for its types alone."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            members = [f"{node.module}.{alias.name}" for alias in node.names]
            names.update(member if member in known_modules else node.module for member in members)
    return {name for name in names if name in known_modules}


def place_of(part: str) -> int:
    return next(place for place, parts in enumerate(ORDER) if part in parts)


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_imports_only_from_packages_before_its_own(path: Path) -> None:
    own_part = part_of(".".join(path.relative_to(PACKAGE).with_suffix("").parts))
    for name in imports_of(path):
        package, _, rest = name.partition(".")
        if package != "khep_twin" or rest in ("", "__version__"):
            continue
        part = part_of(rest)
        assert part == own_part or place_of(part) < place_of(own_part), f"{path.name} imports {name}"


def test_no_module_imports_itself_by_way_of_others_not_even_for_its_types() -> None:
    paths = {name_of(path): path for path in modules()}
    left = {name: imported_modules(path, paths.keys()) - {name} for name, path in paths.items()}
    assert "khep_twin.host.moves" in left["khep_twin.host.khepera"]
    assert "khep_twin.playpen.model" in left["khep_twin.playpen"]
    while free := [name for name, imported in left.items() if not imported & left.keys()]:
        for name in free:
            del left[name]
    assert not left, f"in a circle, or above one: {', '.join(left)}"


@pytest.mark.parametrize("path", sorted((PACKAGE / "host").glob("*.py")), ids=lambda path: path.name)
def test_the_host_imports_no_simulator(path: Path) -> None:
    packages = {name.split(".")[0] for name in imports_of(path)}
    assert not packages & SIMULATORS


PAGE = (PACKAGE.parent / "docs" / "architecture.md").read_text()


def test_the_page_of_the_architecture_has_the_packages_in_this_order() -> None:
    rows = re.findall(r"^\| (`.*?`) \|", PAGE, re.MULTILINE)
    listed = [[part.replace("/", ".") for part in re.findall("`([^`]*)`", row)] for row in rows]
    assert [part for parts in listed for part in parts] == [part for parts in ORDER[:-1] for part in parts]


def test_the_files_on_that_page_are_there() -> None:
    named = re.findall(r"`(khep_twin/[^`]*|tests/[^`]*)`", PAGE)
    assert len(named) > 20
    assert not [name for name in named if not (PACKAGE.parent / name).exists()]
