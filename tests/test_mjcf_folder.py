"""The folder mjcf: the shipped playpens as they are compiled now, each with a picture."""

from pathlib import Path

import mujoco
import pytest
from PIL import Image

from khep_twin import playpen
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import at_spots
from khep_twin.playpen_to_mjcf import to_mjcf

FOLDER = Path(__file__).parents[1] / "mjcf"


@pytest.mark.parametrize("name", playpen.names())
def test_a_shipped_playpen_is_there_as_it_is_compiled_and_opens_without_khep_twin(name: str) -> None:
    file = FOLDER / f"{name}.xml"
    assert file.read_text(encoding="utf-8") == to_mjcf(at_spots(Playpen.load(name), 0)), "tools mjcf"
    model = mujoco.MjModel.from_xml_path(str(file))
    assert model.keyframe("home").id == 0
    with Image.open(FOLDER / f"{name}.png") as picture:
        assert picture.size == (640, 480)


def test_the_list_has_every_playpen_and_nothing_else_lies_there() -> None:
    names = playpen.names()
    listed = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert all(f"[{name}]({name}.xml)" in listed for name in names)
    file_names = {path.name for path in FOLDER.iterdir()}
    assert file_names == {"README.md", *(f"{name}{end}" for name in names for end in (".xml", ".png"))}
