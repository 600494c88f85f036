"""Playpens with robots that carry radios."""

from collections.abc import Sequence

from khep_twin import playpen
from khep_twin.playpen import Playpen


def playpen_with_radios(
    places: Sequence[tuple[float, float]], more: str = "", turrets: str = '"radio"'
) -> Playpen:
    """Return a playpen with a robot at each of these places [mm], and more tables."""
    robots = "".join(
        f"[[robot]]\nx_mm = {x}\ny_mm = {y}\nheading_deg = 0\nturrets = [{turrets}]\n" for x, y in places
    )
    arena = 'version = 1\nname = "radios"\n[arena]\nwidth_mm = 1000\nheight_mm = 500\n'
    return playpen.parse(f"{arena}{more}\n{robots}", "radios.toml")
