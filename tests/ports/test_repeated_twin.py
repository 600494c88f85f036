"""The twin of a log, opened from its attachments."""

import tempfile
from pathlib import Path

import pytest

from khep_twin.errors import LogError
from khep_twin.ports.replay import Setup
from khep_twin.ports.twin import TwinOptions, open_twin


def test_without_room_for_temporary_files_a_log_cannot_be_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    open_twin("default", TwinOptions(log=str(path))).close()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "full"))
    with pytest.raises(LogError) as error:
        Setup.of(path).open()
    reason = "no calibration can be saved in a temporary folder: No such file or directory"
    assert str(error.value) == f"{path}: cannot be repeated: {reason}"
