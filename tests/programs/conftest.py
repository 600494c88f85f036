"""Programs in C, compiled once, and the cache folder of the preload library."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "sources"


@pytest.fixture(scope="session")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache folder of the tests, not the user's."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def separate_cache(cache_folder: Path) -> Iterator[None]:
    """Keep the preload library of the tests out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache_folder))
        yield


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the compiled programs."""
    folder = tmp_path_factory.mktemp("programs")
    for source in sorted(FOLDER.glob("*.c")):
        subprocess.run(["cc", "-w", "-o", folder / source.stem, source, "-lpthread"], check=True)
    strict = ["cc", "-O2", "-D_FORTIFY_SOURCE=2", "-w"]
    for name in ("limits", "paths"):
        subprocess.run(
            [*strict, "-o", folder / f"{name}-strict", FOLDER / f"{name}.c", "-lpthread"], check=True
        )
    return folder
