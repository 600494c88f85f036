"""Choice of the device for the episodes of a batch: the CPU's cores, or an NVIDIA GPU (`cuda`)."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Literal, get_args

from khep_twin.episodes.controllers import Driver, Function, Policy
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.line import LineTimes
from khep_twin.errors import DeviceError, choices, pip_install_extra, value_text
from khep_twin.playpen import Lamp
from khep_twin.sensing.lamps import are_constant

Device = Literal["cpu", "cuda", "auto"]


def choose_device(
    requested: str,
    setup: EpisodeSetup,
    driver: Driver,
    line: LineTimes,
    n_episodes: int,
    lamps: Sequence[Sequence[Lamp]] | None = None,
    template: EpisodeSetup | None = None,
) -> Device:
    """Return "cpu" or "cuda" for the episodes of a batch.

    Args:
        requested: Device, or "auto" for a GPU that can run the episodes, if they fill it.
        setup: Setup of the episodes.
        driver: Controller of the robots.
        line: Line between controllers and robots.
        n_episodes: Number of episodes.
        lamps: Lamps of each episode; None for the playpen's.
        template: Setup whose numbers of obstacles all episodes of the batch must share; None for no check.

    Raises:
        DeviceError: The device is unknown, there is no GPU, or it cannot run these episodes.
    """
    if (text := value_text(requested)) not in map(repr, get_args(Device)):
        raise DeviceError(f"device = {text}: unknown; {choices(requested, get_args(Device))}")
    if requested == "cpu":
        return "cpu"
    error = find_unsupported(setup, driver, line, lamps, template) or find_gpu_error()
    if error and requested == "cuda":
        raise DeviceError(f'device = "cuda": {error}')
    if error:
        return "cpu"
    from khep_twin.episodes.cuda import card

    fills_gpu = n_episodes >= card.EPISODES_PER_PROCESSOR * card.n_processors()
    return "cuda" if requested == "cuda" or fills_gpu else "cpu"


def find_gpu_error() -> str:
    """Return why no GPU can run episodes here, and the remedy; empty if one can."""
    if find_spec("numba_cuda") is None:
        return f"numba-cuda is not installed; to install it: {pip_install_extra('cuda13')}"
    from khep_twin.episodes.cuda import card

    return card.find_error()


def find_unsupported(
    setup: EpisodeSetup,
    driver: Driver,
    line: LineTimes,
    lamps: Sequence[Sequence[Lamp]] | None = None,
    template: EpisodeSetup | None = None,
) -> str:
    """Return why a GPU does not support these episodes, and the remedy; empty if it does."""
    if setup.planar_scene is None:
        turrets = "".join(f" with a {name}" for name in setup.entry.turrets)
        return f"episodes in MuJoCo{turrets}; expected episodes in the plane (planar)"
    if isinstance(driver, Function):
        return "a Function; expected a Network, Braitenberg, ConstantSpeed or Policy"
    if isinstance(driver, Policy) and line is not None:
        return f"a controller in plain Python at a line of {line}; expected no line"
    lighting = setup.playpen.lighting
    if not all(are_constant(episode_lamps, lighting) for episode_lamps in lamps or [setup.playpen.lamps]):
        return "lamps that change; expected steady ones"
    if template is not None:
        obstacles, expected = _describe_obstacles(setup), _describe_obstacles(template)
        if obstacles != expected:
            return f"{setup.playpen.name} has {obstacles}; expected {expected}, as in {template.playpen.name}"
    return ""


def _describe_obstacles(setup: EpisodeSetup) -> str:
    """Return the numbers of obstacles as text."""
    scene = setup.planar_scene
    return "" if scene is None else f"{len(scene.obstacles)} obstacles, {len(scene.bodies)} of them movable"
