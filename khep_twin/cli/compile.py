"""`khep-twin compile`: compilation in advance."""

from typing import Annotated

import typer

from khep_twin import playpen as playpens
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import usage
from khep_twin.errors import KhepTwinError, choices
from khep_twin.robots.registry import default_model, find_family, installed_families

_ARENA = 'version = 1\nname = "compile"\n[arena]\nwidth_mm = {width}\nheight_mm = 600\n'
_ROBOT = '[[robot]]\nmodel = "{model}"\nx_mm = {x}\ny_mm = 300\nheading_deg = 0\n'


@with_help
def compile_all(parts: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """Compile the stepping core with numba, for later commands.

    They load it from numba's cache.

    Args:
        parts: world, episodes, plane, vision or shadow, all of them by default; or world.FAMILY, with further
            families behind dots, for worlds of these robots.
    """
    from khep_twin.simulation import ready

    for part in parts or ():
        if not ready.is_part(part):
            worlds = (f"world.{family}" for family in installed_families())
            raise usage(f"part {part!r}: unknown; {choices(part, (*ready.CODE, *worlds))}")
    functions = [function for part in parts or ready.CODE for function in ready.functions_of(part)]
    if not all(map(ready.can_cache, functions)):
        raise KhepTwinError(f"nothing is compiled, as {ready.NO_CACHE_REASON}")
    from khep_twin.simulation.announcement import ANNOUNCER

    with ANNOUNCER.group(function for function in functions if not ready.is_cached(function)):
        for part in parts or ready.CODE:
            with ready.compile_lock(part):
                _compile_part(part)


def _compile_part(part: str) -> None:
    """Call the functions of a part, a key of `ready.CODE`, once, which compiles them."""
    import numpy as np

    from khep_twin.episodes.episode import Episode
    from khep_twin.episodes.episode_setup import EpisodeSetup
    from khep_twin.shadow.sensor_model import SensorModel
    from khep_twin.shadow.start import PUBLISHED, draw_particles
    from khep_twin.vision.camera import take_test_image
    from khep_twin.world import World

    kind, *families = part.split(".")
    models = [find_family(family) for family in families] or [default_model()]
    text = _ARENA.format(width=600 * len(models))
    text += "".join(_ROBOT.format(model=model.name, x=300 + 600 * i) for i, model in enumerate(models))
    playpen = playpens.parse(text, part)
    if kind == "world":
        world = World(playpen, compiled=True)
        world.advance_to(world.timing.step_ns)
    elif part == "vision":
        take_test_image()
    elif kind == "shadow":
        lamps = playpens.Playpen.load("two-lamps").lamps
        playpen = playpen.model_copy(update={"lamps": lamps})
        setup, rng = EpisodeSetup(playpen, planar=True), np.random.default_rng(0)
        particles = draw_particles(setup, None, PUBLISHED, 1, rng)
        twins = particles.twins
        twins.command("D", 0, 0)
        twins.advance(1)
        readings = np.zeros(twins.n_sensors, np.int64)
        SensorModel(twins).observe(particles, readings, readings == 0)
    else:
        Episode(EpisodeSetup(playpen, planar=kind == "plane"), compiled=True).begin()
