"""Options of a shadow: its start, and its particles."""

import math
import re
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.options import usage
from khep_twin.errors import PlaypenError

if TYPE_CHECKING:
    from khep_twin.playpen import Playpen
    from khep_twin.shadow.shadow import ShadowSettings

_NUMBER = r"-?\d{1,6}(?:\.\d{1,6})?"
_POSE = re.compile(rf"({_NUMBER}),({_NUMBER}),({_NUMBER})")
_WITHIN = re.compile(r"(\d{1,4}(?:\.\d{1,6})?),(\d{1,3}(?:\.\d{1,6})?)")


@dataclass(frozen=True, slots=True)
class ShadowOptions:
    """Options of a shadow."""

    start: Annotated[
        str,
        typer.Option(help="Start: known, as the playpen has it; X,Y,HEADING in mm and degrees; or unknown."),
    ] = "known"
    within: Annotated[str, typer.Option(metavar="MM,DEG", help="Standard deviations of a known start.")] = (
        "10,5"
    )
    seed: Annotated[int, typer.Option(help="Seed of the particles.")] = 0
    particles: Annotated[
        int, typer.Option(min=10, max=100_000, help="Number of particles, once the pose is known.")
    ] = 1000

    def words(self) -> list[str]:
        """Return these options as words of a command line."""
        return [f"--{field.name}={getattr(self, field.name)}" for field in fields(self)]

    def load(self, name: str, robot: int = 0) -> "Playpen":
        """Return the playpen with the robot alone, at its start."""
        from khep_twin.playpen import Playpen, at_start

        found = Playpen.load(name)
        if not 0 <= robot < len(found.robots):
            wanted = f"0 to {len(found.robots) - 1}" if len(found.robots) > 1 else "0"
            raise PlaypenError(f"{name}: robot {robot}; expected {wanted}, as it has {len(found.robots)}")
        found = found.model_copy(update={"robots": (found.robots[robot],)})
        if pose := _POSE.fullmatch(self.start):
            x_mm, y_mm, heading_deg = map(float, pose.groups())
            arena = found.arena
            if not (0 <= x_mm <= arena.width_mm and 0 <= y_mm <= arena.height_mm):
                wanted = f"a place in the arena of {arena.width_mm:g} x {arena.height_mm:g} mm"
                raise usage(f"--start {self.start}: outside; expected {wanted}")
            found = at_start(found, 0, (x_mm, y_mm, heading_deg))
        return found

    def settings(self, baud: int) -> "ShadowSettings":
        """Return the settings of a shadow."""
        from khep_twin.shadow.shadow import ShadowSettings
        from khep_twin.shadow.start import PUBLISHED

        if self.start not in ("known", "unknown") and not _POSE.fullmatch(self.start):
            raise usage(f"--start {self.start}: expected known, unknown or X,Y,HEADING, such as 100,250,90")
        if (within := _WITHIN.fullmatch(self.within)) is None:
            raise usage(f"--within {self.within}: expected MM,DEG, such as 10,5")
        place, heading = float(within[1]) / 1e3, math.radians(float(within[2]))
        spread = PUBLISHED._replace(place=place, heading=heading)
        return ShadowSettings(self.seed, self.particles, self.start != "unknown", spread, baud)
