"""The controller in the log: exactly the text that was run, without data of the machine."""

import importlib.machinery
import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest
from command_line import good
from log_rewriting import rewritten

from khep_twin.lab.conformance.recording.conform import conform_recording
from khep_twin.lab.experiment import controller_source
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import source_of
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.reader import read_label, read_log
from khep_twin.log.recorded import read_recorded_run

TEXT = "def controller(robot):\r\n    robot.set_speed(3, 4)  # für beide Räder"
"""With the line ends of Windows, letters beyond ASCII and no line end at its end."""


def run(folder: Path, controller: object, *options: str) -> Path:
    """Runs a controller and returns the log."""
    log = folder / "run.mcap"
    good("run", controller, "--seconds", 0.5, "--log", log, *options)
    return log


def test_a_users_file_is_attached_as_it_was_read_and_the_run_repeats(tmp_path: Path) -> None:
    logs: list[Path] = []
    for name in ("here", "there"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "mine.py").write_bytes(TEXT.encode("utf-8"))
        logs.append(run(folder, folder / "mine.py"))
        assert sorted(path.name for path in folder.iterdir()) == ["mine.py", "run.mcap"]
    label = read_label(logs[0])
    assert label.attachments["controller/mine.py"] == TEXT
    assert label.metadata["controller"] == "mine.py:controller"
    # The log does not depend on the file's folder.
    data = logs[0].read_bytes()
    assert data == logs[1].read_bytes()
    assert str(tmp_path).encode() not in data
    assert [line.text for line in read_log(logs[0]).robots["khepera0"].serial][:2] == ["D,3,4", "d"]
    assert good("repeat", logs[0]).startswith("identical:")


def test_a_controller_in_a_log_is_never_run(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def controller(robot):\n    robot.set_speed(3, 4)\n")
    log = run(tmp_path, tmp_path / "mine.py")
    mark = tmp_path / "run"
    hostile = f"open({str(mark)!r}, 'w').close()\n\n\ndef controller(robot):\n    raise SystemExit\n"

    def replaced(name: str, data: bytes) -> bytes:
        return hostile.encode() if name.startswith("controller/") else data

    other = rewritten(log, tmp_path / "other.mcap", attachment=replaced)
    assert read_label(other).attachments["controller/mine.py"] == hostile
    assert repeat(read_recorded_run(other)) is None
    assert conform_recording(other).robots
    assert not mark.exists()
    exec(compile(hostile, "mine.py", "exec"), {})  # which would have been seen
    assert mark.exists()


def test_a_built_in_controller_is_attached_with_its_module() -> None:
    source = source_of(braitenberg)
    assert source.facts == {"controller": "braitenberg"}
    ((name, text),) = source.attachments.items()
    assert name == "controller/controllers.py"
    assert text == Path(sys.modules[braitenberg.__module__].__file__ or "").read_text("utf-8")
    assert "def braitenberg(robot" in text


def test_what_is_changed_after_it_was_read_is_kept_as_it_was_run(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def first(robot): ...\n")
    controller = find_controller(f"{file}:first")
    file.write_text("def second(robot): ...\n")
    source = source_of(controller)
    assert source.attachments == {"controller/mine.py": "def first(robot): ...\n"}
    assert source.facts == {"controller": "mine.py:first"}
    # The next one does not run from earlier bytecode.
    assert find_controller(str(file)).__name__ == "second"


def test_files_of_one_name_in_two_folders_are_kept_apart(tmp_path: Path) -> None:
    texts = [f"def controller(robot): {n}\n" for n in (1, 2)]
    for folder, text in zip("ab", texts, strict=True):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "ctl.py").write_text(text)
    controllers = [find_controller(str(tmp_path / folder / "ctl.py")) for folder in "ab"]
    assert [source_of(controller).attachments["controller/ctl.py"] for controller in controllers] == texts


def test_a_source_in_another_encoding_is_read_as_python_reads_it(tmp_path: Path) -> None:
    file = tmp_path / "old.py"
    text = "# -*- coding: latin-1 -*-\ndef controller(robot):\n    '''für alle'''\n"
    file.write_bytes(text.encode("latin-1"))
    assert source_of(find_controller(str(file))).attachments == {"controller/old.py": text}


def test_a_very_long_source_is_left_out_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controller_source, "MAX_BYTES", 50)
    file = tmp_path / "long.py"
    for length, is_stored in ((50, True), (51, False)):
        file.write_text("def controller(robot): ...\n".ljust(length, "#"))
        source = source_of(find_controller(str(file)))
        assert bool(source.attachments) is is_stored
    assert source.facts["controller_source"] == "left out: 51 bytes, more than 50"


def test_a_source_that_cannot_be_read_is_left_out_and_that_is_said(tmp_path: Path) -> None:
    # Loaded by another loader, and removed since.
    file = tmp_path / "gone.py"
    file.write_text("def controller(robot): ...\n")
    spec = importlib.util.spec_from_file_location("gone", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules["gone"] = module
    file.unlink()
    source = source_of(module.controller)
    del sys.modules["gone"]
    assert not source.attachments
    assert source.facts["controller_source"] == "left out: cannot be read: No such file or directory"


def test_a_controller_typed_into_python_has_no_source_and_that_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # As in `python -c`, whose module has no file.
    monkeypatch.setattr(sys.modules["__main__"], "__loader__", importlib.machinery.BuiltinImporter)
    names: dict[str, Any] = {"__name__": "__main__"}
    exec("def controller(robot): pass", names)
    assert "left out" in source_of(names["controller"]).facts["controller_source"]
