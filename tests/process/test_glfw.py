"""The library of GLFW, which mujoco imports."""

import os
import sys
from pathlib import Path

import pytest

from khep_twin.process.machine import name_glfw


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no wheels of GLFW with two libraries")
def test_glfw_is_named_unless_the_user_does(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("PYGLFW_LIBRARY", "PYGLFW_LIBRARY_VARIANT", "XDG_SESSION_TYPE"):
        monkeypatch.setenv(variable, "")
        monkeypatch.delenv(variable)
    monkeypatch.setenv("PYGLFW_LIBRARY_VARIANT", "wayland")
    name_glfw()
    assert "PYGLFW_LIBRARY" not in os.environ
    monkeypatch.delenv("PYGLFW_LIBRARY_VARIANT")
    name_glfw()
    path = Path(os.environ["PYGLFW_LIBRARY"])
    assert path.is_file()
    assert path.parent.name == "x11"
    monkeypatch.setenv("PYGLFW_LIBRARY", "mine.so")
    name_glfw()
    assert os.environ["PYGLFW_LIBRARY"] == "mine.so"
