"""Obstacles of a playpen: all that stands on the floor is in its scene, map, light, checks and statistics."""

from typing import Annotated

import numpy as np
import pytest
from pydantic import Field

from khep_twin import playpen as playpens
from khep_twin.drawing.light_map import illumination
from khep_twin.drawing.map import draw
from khep_twin.lab.experiment.run_statistics import clearance
from khep_twin.playpen import Block, Cylinder, Lamp, Patch, Playpen, RobotEntry, Spot, Wall
from khep_twin.playpen.checks import playpen_problems
from khep_twin.playpen.parts import Obstacle
from khep_twin.playpen_to_mjcf import to_spec

FENCE = Wall(points_mm=((100, 250), (250, 250)), surface="copper", stripes=((50, "black"),))


class FencedPlaypen(Playpen):
    """A playpen with one table more, of walls."""

    fences: Annotated[tuple[Wall, ...], Field(alias="fence")] = ()


@pytest.fixture
def fenced() -> FencedPlaypen:
    """A fence across the left half of the floor, below a lamp."""
    data = Playpen.load("default").model_dump(by_alias=True)
    lamp = Lamp(x_mm=200, y_mm=400, z_mm=15, power_w=7).model_dump()
    return FencedPlaypen.model_validate({**data, "lamp": (lamp,), "fence": (FENCE.model_dump(),)})


def test_a_new_table_of_walls_is_in_the_scene(fenced: FencedPlaypen) -> None:
    spec = to_spec(fenced)
    assert spec.geom("fence0_0").userdata[1] > 0
    assert any("fence0_0" in (pair.geomname1, pair.geomname2) for pair in spec.pairs)
    assert any(site.name.startswith("stripe_fence0_0_") for site in spec.sites)


def test_a_new_table_of_walls_is_on_the_map_with_its_shadow_and_its_stripes(fenced: FencedPlaypen) -> None:
    n_shapes, n_fenced = (
        len(draw(playpen).axes[0].patches) for playpen in (fenced.model_copy(update={"fences": ()}), fenced)
    )
    assert n_fenced > n_shapes
    labels = [text.get_text() for text in draw(fenced).legends[0].get_texts()]
    assert {"copper", "black"} <= set(labels)
    shadow = illumination(fenced, np.array([200.0]), np.array([100.0]))
    assert shadow == [0]


def test_a_new_table_of_walls_is_a_collision(fenced: FencedPlaypen) -> None:
    assert clearance(np.array([(0.2, 0.25), (0.2, 0.35)]), fenced) == pytest.approx([-0.005, 0.095])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"points_mm": ((100, 250), (500, 250))}, "robot 1 at (300, 250) overlaps fence 1 at (300, 250)"),
        ({"points_mm": ((100, 250), (650, 250))}, "fence 1: points_mm 2: 650: outside the arena"),
        ({"surface": "ice"}, 'fence 1: surface = "ice": unknown'),
        ({"stripes": ((10, "ice"),)}, 'fence 1: stripes 1: "ice": unknown'),
    ],
)
def test_a_new_table_of_walls_is_checked(
    fenced: FencedPlaypen, change: dict[str, object], problem: str
) -> None:
    changed = fenced.model_copy(update={"fences": (FENCE.model_copy(update=change),)})
    assert any(text.text.startswith(problem) for text in playpen_problems(changed))


EXAMPLES: dict[str, Obstacle | Patch | Lamp | Spot | RobotEntry] = {
    "block": Block(x_mm=100, y_mm=100, length_mm=20, width_mm=20, height_mm=50),
    "cylinder": Cylinder(x_mm=200, y_mm=100, radius_mm=10, height_mm=50),
    "wall": FENCE,
    "patch": Patch(x_mm=450, y_mm=100, radius_mm=20),
    "lamp": Lamp(x_mm=100, y_mm=400, power_w=7),
    "spot": Spot(name="start", x_mm=450, y_mm=400, heading_deg=0),
    "robot": RobotEntry(x_mm=450, y_mm=250, heading_deg=0),
}


def test_the_scene_has_each_part_that_the_file_has() -> None:
    playpen = Playpen.load("default")
    tables = {kind: (part.model_dump(exclude_none=True),) for kind, part in EXAMPLES.items()}
    full = Playpen.model_validate({**playpen.model_dump(by_alias=True), **tables})
    assert full.tables.keys() == EXAMPLES.keys()
    assert all(full.tables.values())
    spec = to_spec(full)
    names = {part.name for part in (*spec.geoms, *spec.sites, *spec.bodies)}
    prefixes = {kind: f"{kind}0" for kind in full.tables} | {"robot": "khepera0/base", "wall": "wall0_0"}
    del prefixes["spot"]  # a start, not a thing
    assert set(prefixes.values()) <= names


@pytest.mark.parametrize("name", playpens.names())
def test_the_scene_of_a_shipped_playpen_has_each_piece_of_its_walls_and_objects(name: str) -> None:
    playpen = Playpen.load(name)
    area = sum(
        shape.length_mm * shape.width_mm
        for item in playpen.walls
        for shape in item.footprints
        if hasattr(shape, "length_mm")
    )
    geoms = [
        geom for geom in to_spec(playpen).geoms if geom.name.startswith("wall") and "wall_" not in geom.name
    ]
    assert sum(4e6 * geom.size[0] * geom.size[1] for geom in geoms if geom.type == 6) == pytest.approx(area)
