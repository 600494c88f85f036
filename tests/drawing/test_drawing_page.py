"""docs/drawing.md: its programs draw their pictures, here of shorter runs."""

from functools import partial
from pathlib import Path

import pytest
from docs_reader import ROOT, blocks
from matplotlib.figure import Figure

import khep_twin
from khep_twin import TwinOptions, open_twin

PAGE = blocks((ROOT / "docs" / "drawing.md").read_text())


def test_each_program_of_the_page_saves_its_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    (playpen,) = (block.text for block in PAGE if block.language == "toml")
    Path("trio.toml").write_text(playpen)
    for name, place in (("run", "obstacles"), ("trio", "trio.toml")):
        with open_twin(place, TwinOptions(robot=None, log=f"{name}.mcap")) as twin:
            for robot in twin.robots:
                robot.send(b"D,5,5\nN\n")
            twin.advance_to(200_000_000)
    monkeypatch.setattr(khep_twin, "rollout", partial(khep_twin.rollout, compiled=False))
    saved: dict[str, Figure] = {}
    monkeypatch.setattr(Figure, "savefig", lambda figure, name: saved.update({name: figure}))
    for block in PAGE:
        if block.language == "python":
            program = block.text.replace("60.0, paths_every=0.1", "0.4, paths_every=0.1").replace("out/", "")
            exec(compile(program.replace("6.0, starts", "0.2, starts"), "drawing.md", "exec"), {})
    assert [*saved] == ["path.png", "paths.png", "trio.png", "sensors.png", "where.png"]
    assert [len(figure.axes[0].collections) for figure in saved.values()] == [1, 24, 3, 0, 1]
    assert len(saved["sensors.png"].axes[0].lines) == 8
    for name in saved:
        assert (ROOT / "docs" / "pictures" / f"drawing_{name}").exists()
