"""Choice of where the episodes of a batch run: on the CPU's cores, or on an NVIDIA card (`cuda`)."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Literal, get_args

from khep_twin.episodes.controllers import Driver, Function, Policy
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes
from khep_twin.errors import DeviceError, choices, pip_install_extra
from khep_twin.playpen import Lamp
from khep_twin.sensing.lamps import are_steady

Device = Literal["cpu", "cuda", "auto"]


def chosen_device(
    wanted: str,
    setup: EpisodeSetup,
    driver: Driver,
    line: LineTimes,
    count: int,
    lamps: Sequence[Sequence[Lamp]] | None = None,
    like: EpisodeSetup | None = None,
) -> Device:
    """Return "cpu" or "cuda" for the episodes of a batch.

    Args:
        wanted: Device, or "auto" for a card that can run the episodes, if they fill it.
        setup: Setup of the episodes.
        driver: Controller of the robots.
        line: Line between controllers and robots.
        count: Number of episodes.
        lamps: Lamps of each episode; None for the playpen's.
        like: Setup of other episodes of the batch.

    Raises:
        DeviceError: The device is unknown, there is no card, or it cannot run such episodes.
    """
    if wanted not in get_args(Device):
        raise DeviceError(f"device = {wanted!r}: unknown; {choices(str(wanted), get_args(Device))}")
    if wanted == "cpu":
        return "cpu"
    trouble = refusal(setup, driver, line, lamps, like) or missing_card()
    if trouble and wanted == "cuda":
        raise DeviceError(f'device = "cuda": {trouble}')
    if trouble:
        return "cpu"
    from khep_twin.episodes.cuda import card

    return "cuda" if wanted == "cuda" or count >= card.FILLING * card.n_processors() else "cpu"


def missing_card() -> str:
    """Return why no card can run episodes here, and what is expected; empty if one can."""
    if find_spec("numba_cuda") is None:
        return f"numba-cuda is not installed; to install it: {pip_install_extra('cuda13')}"
    from khep_twin.episodes.cuda import card

    return card.trouble()


def refusal(
    setup: EpisodeSetup,
    driver: Driver,
    line: LineTimes,
    lamps: Sequence[Sequence[Lamp]] | None = None,
    like: EpisodeSetup | None = None,
) -> str:
    """Return what a card does not run, and what is expected; empty if it runs these episodes."""
    if setup.planar_scene is None:
        return "episodes in MuJoCo; expected episodes in the plane (planar)"
    if isinstance(driver, Function):
        return "a Function; expected a Network, Braitenberg, ConstantSpeed or Policy"
    if isinstance(driver, Policy) and line is not None:
        return f"a controller in plain Python at a line of {line}; expected no line"
    lighting = setup.playpen.lighting
    if not all(are_steady(each, lighting) for each in lamps or [setup.playpen.lamps]):
        return "lamps that change; expected steady ones"
    if like is not None and (found := _obstacles(setup)) != (expected := _obstacles(like)):
        return f"{setup.playpen.name} has {found}; expected {expected}, as in {like.playpen.name}"
    return ""


def _obstacles(setup: EpisodeSetup) -> str:
    """Return the numbers of obstacles in words."""
    scene = setup.planar_scene
    return "" if scene is None else f"{len(scene.things)} obstacles, {len(scene.bodies)} of them movable"
