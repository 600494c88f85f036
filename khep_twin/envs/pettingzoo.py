"""Tasks for several robots in one playpen, in PettingZoo's parallel form (extra `rl`).

    environment = ParallelEnvironment("ObstacleAvoidance", robots=3)
    observations, infos = environment.reset(seed=1)
    while environment.agents:
        actions = {agent: environment.action_space(agent).sample() for agent in environment.agents}
        observations, rewards, terminated, truncated, infos = environment.step(actions)

Agents are the robots by their names in logs, khepera0 on. Their observations and actions are those of
`gymnasium`, normalized to -1 to 1. They are obstacles to each other; a robot reflects a sixth of what white
paper does, so that others see it from some 5 mm. One whose charge has run out stops while the others go on.
"""

# pyright: reportMissingTypeStubs=false

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import MadeAnew
from khep_twin.envs.gymnasium import rendering, spaces
from khep_twin.envs.info import Info, ground_truth, of_end, of_start, of_step
from khep_twin.envs.renderer import Picture, Renderer, View
from khep_twin.envs.reset_options import ResetOptions
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation, Task
from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.one_thread import one_thread

try:
    from gymnasium.spaces import Space
    from gymnasium.utils import seeding
    from pettingzoo import ParallelEnv
except ModuleNotFoundError as error:
    raise MissingExtraError("pettingzoo", "rl") from error


class ParallelEnvironment(MadeAnew, ParallelEnv[str, Observation, NDArray[np.float32]]):
    """A task for several robots.

    A copy, also by `pickle`, has the same arguments and random numbers; its episodes begin with `reset`.

    Args:
        task: Task, or its name.
        robots: Number of robots; a playpen with spots has room for as many as it has spots.
        render_mode: "rgb_array", or None for no pictures.
        view: View of pictures: "scene" by MuJoCo, "map", or "auto".
        options: Options of `TaskSetup`: playpen, start (one for each robot), lamps, randomize, noise, vary,
            period_ns, seconds, planar (one robot), compiled, normalize, details.

    Attributes:
        guard: Guard of its methods.
    """

    KEPT = ("_rng",)

    def __init__(
        self,
        task: Task | str = "ObstacleAvoidance",
        robots: int = 2,
        *,
        render_mode: str | None = None,
        view: View = "auto",
        **options: Any,
    ) -> None:
        self._setup = TaskSetup(task, robots=robots, **options)
        self._episode = TaskEpisode(self._setup)
        self._painter = Renderer(view)
        self._rng = seeding.np_random(None)[0]
        self.guard, self._begun = self._episode.guard, False
        self.render_mode = render_mode
        self.metadata: Info = {
            "name": f"khep_twin/{self._setup.task.name}-v0",
            **rendering(render_mode, self._setup),
        }
        self.possible_agents = [f"khepera{index}" for index in range(robots)]
        self.agents: list[str] = []
        self.labels = self._setup.task.labels
        self.observation_spaces: dict[str, Space[Any]] = {}
        self.action_spaces: dict[str, Space[Any]] = {}
        for agent in self.possible_agents:
            self.observation_spaces[agent], self.action_spaces[agent] = spaces(self._setup)

    def observation_space(self, agent: str) -> Space[Any]:
        """Return the observation space of a robot."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space[Any]:
        """Return the action space of a robot."""
        return self.action_spaces[agent]

    @one_thread
    def reset(
        self, seed: int | None = None, options: Info | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Start an episode; a seed makes it and all later episodes reproducible.

        Args:
            seed: Seed of this and all later episodes.
            options: Options in place of the environment's own in this episode: seed, start (one for each
                robot), lamps, playpen.
        """
        # PettingZoo's own test gives an option "options".
        given = ResetOptions.of({name: value for name, value in (options or {}).items() if name != "options"})
        if seed is not None:
            self._rng = seeding.np_random(seed)[0]
        drawn = int(self._rng.integers(2**31))
        seen = self._episode.begin(drawn if given.seed is None else given.seed, given)
        self.agents, self._begun = list(self.possible_agents), True
        begun = of_start(self._episode.batch)
        infos = {agent: ground_truth(self._episode.batch, robot) | begun for agent, robot in self._present()}
        return dict(zip(self.agents, seen, strict=True)), infos

    @one_thread
    def step(
        self, actions: Mapping[str, NDArray[np.float32]]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        """Advance by a control period with these speeds of left and right wheel (2,) of each agent.

        Raises:
            KhepTwinError: There is no action for an agent.
            ValueError: An action is not two numbers, or no episode has begun.
        """
        if not self._begun:
            raise ValueError("no episode has begun; expected reset() first")
        if not self.agents:
            return {}, {}, {}, {}, {}
        given: list[object] = [(0.0, 0.0)] * len(self.possible_agents)
        for agent in self.agents:
            if agent not in actions:
                raise KhepTwinError(
                    f"no action for {agent}; expected one for each of {', '.join(self.agents)}"
                )
            given[self.possible_agents.index(agent)] = actions[agent]
        became = dict(zip(self.possible_agents, self._episode.step(given), strict=True))
        outcomes, late = {agent: became[agent] for agent in self.agents}, self._episode.over
        infos, batch = dict[str, Info](), self._episode.batch
        for agent, robot in self._present():
            infos[agent] = ground_truth(batch, robot) | of_step(batch, robot)
            if late or outcomes[agent].ended:
                infos[agent] |= of_end(batch, robot)
        self.agents = [] if late else [agent for agent, outcome in outcomes.items() if not outcome.ended]
        return (
            {agent: outcome.observation for agent, outcome in outcomes.items()},
            {agent: outcome.reward for agent, outcome in outcomes.items()},
            {agent: outcome.ended for agent, outcome in outcomes.items()},
            dict.fromkeys(outcomes, late),
            infos,
        )

    @one_thread
    def render(self) -> Picture | None:
        """Return a picture of the present state; None without a render mode."""
        if self.render_mode is None:
            return None
        return self._painter.picture(self._episode.episode)

    @one_thread
    def close(self) -> None:
        """Release the resources of rendering."""
        self._painter.close()

    def _present(self) -> list[tuple[str, int]]:
        """Return the present agents and their robots."""
        robots = enumerate(self.possible_agents)
        return [(agent, robot) for robot, agent in robots if agent in self.agents]
