"""The robots of packages outside the product, installed: a Toy, and a Scout (`second_robot`)."""

import sys
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tomllib import loads
from typing import Any

import pytest

from khep_twin.playpen import Playpen
from khep_twin.ports.network import TcpPort
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.serve import serve
from khep_twin.ports.twin import open_twin
from khep_twin.robots.registry import installed_models

FOLDER = Path(__file__).parent


def install(package: str, site: Path) -> None:
    """Install a package of this folder: the folder of its entry points, as pip writes it."""
    (site / package).symlink_to(FOLDER / package)
    project = loads((FOLDER / package / "pyproject.toml").read_text())["project"]
    (points,) = project["entry-points"].items()
    information = site / f"{project['name']}-{project['version']}.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = [f"[{points[0]}]", *(f"{name} = {value}" for name, value in points[1].items())]
    (information / "entry_points.txt").write_text("\n".join(lines))


def installed(*packages: str) -> Callable[..., Any]:
    """Return a fixture of a module that installs packages, and returns their folder."""

    @pytest.fixture(scope="module")
    def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
        folder = tmp_path_factory.mktemp("site-packages")
        for package in packages:
            install(package, folder)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "path", [str(folder), *sys.path])
            installed_models.cache_clear()
            yield folder
        installed_models.cache_clear()

    return site


installed_toy = installed("toy_robot")
installed_robots = installed("toy_robot", "second_robot")


@pytest.fixture(params=["pty", "tcp"])
def served(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    """Return a context that serves the first robot of a playpen on a pty or by TCP, and returns its URL."""

    @contextmanager
    def serve_playpen(playpen: Playpen) -> Generator[str]:
        stop = threading.Event()
        with open_twin(playpen) as twin:
            port: Any = PtyPort(str(tmp_path / "link")) if request.param == "pty" else TcpPort("localhost", 0)
            with closing(port):
                server = threading.Thread(target=serve, args=(twin, [port]), kwargs={"stop": stop.is_set})
                server.start()
                try:
                    yield port.path
                finally:
                    stop.set()
                    server.join()

    return serve_playpen
