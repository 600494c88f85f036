"""Tables of a playpen file: its parts by kind, each validated separately."""

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Annotated, Any, get_args

from pydantic import Field

from khep_twin.files.toml_files import Name, TomlTable
from khep_twin.playpen.parts import (
    Arena,
    Block,
    Cylinder,
    Lamp,
    Lighting,
    Obstacle,
    Patch,
    RadioChannel,
    RobotEntry,
    Spot,
    Wall,
)
from khep_twin.playpen.stripes import Panel, panels, panels_within
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES, Surface


class PlaypenTables(TomlTable):
    """Tables of a playpen file, each validated separately."""

    version: Annotated[int, Field(ge=1, le=1, description="1")]
    name: Name
    arena: Arena
    lighting: Lighting = Lighting()
    radio: RadioChannel = RadioChannel()
    surfaces: Annotated[Mapping[Name, Surface], Field(default_factory=dict[str, Surface])]
    blocks: Annotated[tuple[Block, ...], Field(alias="block")] = ()
    cylinders: Annotated[tuple[Cylinder, ...], Field(alias="cylinder")] = ()
    walls: Annotated[tuple[Wall, ...], Field(alias="wall")] = ()
    patches: Annotated[tuple[Patch, ...], Field(alias="patch")] = ()
    lamps: Annotated[tuple[Lamp, ...], Field(alias="lamp")] = ()
    spots: Annotated[tuple[Spot, ...], Field(alias="spot")] = ()
    robots: Annotated[tuple[RobotEntry, ...], Field(alias="robot")] = ()

    @property
    def tables(self) -> dict[str, tuple[Obstacle | Patch | Lamp | Spot | RobotEntry, ...]]:
        """Parts by kind, as their tables are named."""
        return self._tables_of(object)

    @property
    def obstacles(self) -> dict[str, tuple[Obstacle, ...]]:
        """Walls and objects on the floor, by the name of their table."""
        return self._tables_of(Block, Cylinder, Wall)

    @property
    def objects(self) -> dict[str, tuple[Block | Cylinder, ...]]:
        """Objects that stand on the floor, by the name of their table."""
        return self._tables_of(Block, Cylinder)

    def _tables_of(self, *types: type) -> dict[str, Any]:
        """Return the parts of these types, by the name of their table."""
        return {
            field.alias: getattr(self, name)
            for name, field in type(self).model_fields.items()
            if field.alias and issubclass(get_args(field.annotation)[0], types)
        }

    @property
    def turret_settings(self) -> Mapping[str, Mapping[str, float]]:
        """Values of the tables for turrets, by the name of the turret."""
        return {"radio": self.radio.model_dump()}

    def surface(self, name: str) -> Surface:
        """Return the surface of a name, built-in or defined in this playpen."""
        return BUILT_IN_SURFACES.get(name) or self.surfaces[name]

    def reflectance(self, part: Arena | Obstacle) -> float:
        """Return the infrared reflectance of a part, or the mean over its stripes."""
        if not part.stripes:
            return self.surface(part.surface).reflectance
        widths_mm = [width_mm for width_mm, _ in part.stripes]
        weighted = (width_mm * self.surface(name).reflectance for width_mm, name in part.stripes)
        return sum(weighted) / sum(widths_mm)

    @property
    def panels(self) -> Iterator[Panel]:
        """Panels of all stripes, seen from above."""
        yield from panels_within(self.arena.corners, self.arena.stripes)
        for item in chain(*self.obstacles.values()):
            for shape in item.footprints:
                yield from panels(shape, item.stripes)
