"""Tasks for several robots in one playpen, as a PettingZoo parallel environment (extra `rl`).

    environment = ParallelEnvironment("ObstacleAvoidance", robots=3)
    observations, infos = environment.reset(seed=1)
    while environment.agents:
        actions = {agent: environment.action_space(agent).sample() for agent in environment.agents}
        observations, rewards, terminated, truncated, infos = environment.step(actions)

Agents are the robots, named as in logs: khepera0, khepera1, ... Their observations and actions are those of
`gymnasium`, normalized to -1 to 1. They are obstacles to each other; a robot reflects a sixth of the light of
white paper, so others see it at about 5 mm. A robot whose charge has run out stops; the others continue.
"""

# pyright: reportMissingTypeStubs=false

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.copies import CopiedByArguments
from khep_twin.envs.arguments import check_mapping
from khep_twin.envs.gymnasium import open_window, render_metadata, spaces
from khep_twin.envs.info import Info, end_info, ground_truth, start_info, step_info
from khep_twin.envs.renderer import Picture, Renderer, View
from khep_twin.envs.reset_options import ResetOptions, validate_seed
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import Observation, Task
from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.process.one_thread import one_thread
from khep_twin.robots.model import robot_name

try:
    from gymnasium.spaces import Space
    from gymnasium.utils import seeding
    from pettingzoo import ParallelEnv
except ModuleNotFoundError as error:
    raise MissingExtraError("pettingzoo", "rl") from error


class ParallelEnvironment(CopiedByArguments, ParallelEnv[str, Observation, NDArray[np.float32]]):
    """A task for several robots.

    A copy, also by `pickle`, has the same arguments and random numbers, and needs a `reset`.

    Args:
        task: Task, or its name.
        robots: Number of robots; in a playpen with spots, at most one per spot.
        render_mode: "rgb_array", "human" for a window that shows each step in real time, or None.
        view: View of pictures: "scene" by MuJoCo, "map", or "auto".
        options: Options of `TaskSetup`: playpen, start (one for each robot), lamps, randomize, noise, vary,
            period_ns, seconds, max_episode_steps, planar (one robot), compiled, normalize, details.

    Attributes:
        max_episode_steps: Time limit of an episode in steps.
        guard: Lock by which its methods refuse a second thread (`one_thread`).
    """

    COPIED_ATTRIBUTES = ("_rng",)

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
        self._renderer = Renderer(view)
        self._rng = seeding.np_random(None)[0]
        self.guard = self._episode.guard
        self._has_started = False
        self.render_mode = render_mode
        self.metadata: Info = {
            "name": f"khep_twin/{self._setup.task.name}-v0",
            **render_metadata(render_mode, self._setup.period_ns),
        }
        self._window = open_window(render_mode, self.metadata)
        self.max_episode_steps = self._setup.n_steps
        self.possible_agents = [robot_name(index) for index in range(robots)]
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
            options: Options that replace the environment's in this episode: seed, drawn (one for each
                robot), lamps, playpen.
        """
        reset_options = check_mapping("options", options)
        # PettingZoo's API test passes an option "options".
        request = ResetOptions.of({key: value for key, value in reset_options.items() if key != "options"})
        if seed is not None:
            self._rng = seeding.np_random(validate_seed(seed))[0]
        drawn_seed = int(self._rng.integers(2**31))
        observations = self._episode.begin(drawn_seed if request.seed is None else request.seed, request)
        self.agents = list(self.possible_agents)
        self._has_started = True
        self._show()
        drawn = start_info(self._episode.batch)
        infos = {agent: ground_truth(self._episode.batch, robot) | drawn for agent, robot in self._active()}
        return dict(zip(self.agents, observations, strict=True)), infos

    @one_thread
    def step(
        self, actions: Mapping[str, NDArray[np.float32]]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        """Advance by a control period, with speeds of left and right wheel (2,) of each agent.

        Raises:
            KhepTwinError: There is no action for an agent.
            ValueError: An action is not two numbers, or no episode has started.
        """
        if not self._has_started:
            raise ValueError("no episode has started; expected reset() first")
        if not self.agents:
            return {}, {}, {}, {}, {}
        actions = check_mapping("actions", actions)
        robot_actions: list[object] = [(0.0, 0.0)] * len(self.possible_agents)
        for agent in self.agents:
            if agent not in actions:
                raise KhepTwinError(
                    f"no action for {agent}; expected one for each of {', '.join(self.agents)}"
                )
            robot_actions[self.possible_agents.index(agent)] = actions[agent]
        results = dict(zip(self.possible_agents, self._episode.step(robot_actions), strict=True))
        outcomes, truncated = {agent: results[agent] for agent in self.agents}, self._episode.over
        infos, batch = dict[str, Info](), self._episode.batch
        self._show()
        for agent, robot in self._active():
            infos[agent] = ground_truth(batch, robot) | step_info(batch, robot)
            if truncated or outcomes[agent].terminated:
                infos[agent] |= end_info(batch, robot)
        self.agents = [] if truncated else [agent for agent in outcomes if not outcomes[agent].terminated]
        return (
            {agent: outcome.observation for agent, outcome in outcomes.items()},
            {agent: outcome.reward for agent, outcome in outcomes.items()},
            {agent: outcome.terminated for agent, outcome in outcomes.items()},
            dict.fromkeys(outcomes, truncated),
            infos,
        )

    @one_thread
    def render(self) -> Picture | None:
        """Return a picture of the current state in mode "rgb_array"; otherwise None."""
        if self.render_mode != "rgb_array":
            return None
        return self._renderer.picture(self._episode.episode)

    @one_thread
    def close(self) -> None:
        """Release the resources of rendering."""
        self._renderer.close()
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._renderer.picture(self._episode.episode))

    def _active(self) -> list[tuple[str, int]]:
        """Return the active agents and their robots' indices."""
        robots = enumerate(self.possible_agents)
        return [(agent, robot) for robot, agent in robots if agent in self.agents]
