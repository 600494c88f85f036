"""Episodes without a serial line, compiled and on all cores."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.episodes.batch import Failure as Failure
    from khep_twin.episodes.batch import RolloutResult as RolloutResult
    from khep_twin.episodes.batch import rollout as rollout
    from khep_twin.episodes.controllers import Braitenberg as Braitenberg
    from khep_twin.episodes.controllers import ConstantSpeed as ConstantSpeed
    from khep_twin.episodes.controllers import Driver as Driver
    from khep_twin.episodes.controllers import Function as Function
    from khep_twin.episodes.controllers import Network as Network
    from khep_twin.episodes.controllers import Policy as Policy
    from khep_twin.episodes.episode import Episode as Episode
    from khep_twin.episodes.episode_batch import EpisodeBatch as EpisodeBatch
    from khep_twin.episodes.episode_options import EpisodeOptions as EpisodeOptions
    from khep_twin.episodes.episode_setup import EpisodeSetup as EpisodeSetup
    from khep_twin.episodes.line import MeasuredCycle as MeasuredCycle
    from khep_twin.episodes.metrics import METRICS as METRICS
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
