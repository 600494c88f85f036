"""The Toy of `toy_robot`, installed."""

import sys
from collections.abc import Iterator
from pathlib import Path
from tomllib import loads

import pytest

from khep_twin.robots.registry import installed_models

FOLDER = Path(__file__).parent / "toy_robot"


@pytest.fixture(scope="module")
def installed_toy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Install the package of the Toy: the folder of its entry points, as pip writes it."""
    folder = tmp_path_factory.mktemp("site-packages")
    (folder / "toy_robot").symlink_to(FOLDER)
    project = loads((FOLDER / "pyproject.toml").read_text())["project"]
    (points,) = project["entry-points"].items()
    information = folder / f"{project['name']}-{project['version']}.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = [f"[{points[0]}]", *(f"{name} = {value}" for name, value in points[1].items())]
    (information / "entry_points.txt").write_text("\n".join(lines))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(folder), *sys.path])
        installed_models.cache_clear()
        yield folder
    installed_models.cache_clear()
