"""Reinforcement learning environments: Gymnasium, PettingZoo and dm_env."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.envs.dm_env import load as load
    from khep_twin.envs.gymnasium import KheperaEnvironment as KheperaEnvironment
    from khep_twin.envs.gymnasium import make as make
    from khep_twin.envs.gymnasium import make_vec as make_vec
    from khep_twin.envs.gymnasium_vector import KheperaVectorEnvironment as KheperaVectorEnvironment
    from khep_twin.envs.pettingzoo import ParallelEnvironment as ParallelEnvironment
    from khep_twin.envs.randomization import Randomization as Randomization
    from khep_twin.envs.task_episode import TaskEpisode as TaskEpisode
    from khep_twin.envs.task_setup import TaskSetup as TaskSetup
    from khep_twin.envs.tasks import TASKS as TASKS
    from khep_twin.envs.tasks import TERMS as TERMS
    from khep_twin.envs.tasks import ObservationTerm as ObservationTerm
    from khep_twin.envs.tasks import State as State
    from khep_twin.envs.tasks import Task as Task
    from khep_twin.envs.tasks import batched as batched
    from khep_twin.envs.tasks import with_parts as with_parts
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
