"""Worlds that step by compiled code from their first step, with the same results in less time."""

from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from unittest.mock import patch

import khep_twin.process.status_line  # noqa: F401 - before a simulation: compilation reports by it
from khep_twin.playpen import Playpen
from khep_twin.vision import camera
from khep_twin.world import World


@contextmanager
def compiled_worlds() -> Generator[None]:
    """Let worlds, and cameras, be compiled, as those of long runs are."""
    defaults = World.__init__.__kwdefaults__
    assert defaults is not None
    _load()
    with patch.dict(defaults, compiled=True), patch.object(camera, "_CHECK_INTERVAL", 1):
        yield


@cache
def _load() -> None:
    """Load the compiled code, or compile it, here: the product would start a process that does."""
    World(Playpen.load("default"), compiled=True)
    camera.take_test_image()
