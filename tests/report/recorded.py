"""An environment with every kind of action space, a scripted other, and steps out of play; and teams that play in it."""

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.report.recording import record_episodes

SPACES = {
    "discrete": spaces.Discrete(3),
    "several": spaces.MultiDiscrete([2, 3]),
    "switches": spaces.MultiBinary(3),
    "numbers": spaces.Box(-2.0, 2.0, (2,), np.float32),
}
SCRIPTED = spaces.Discrete(2)
LIMIT = 6


class EveryKind(ParallelEnv):
    """
    The scripted other alternates between its two actions. ``discrete`` is out of play at steps 2 and 3. Everybody sees
    everybody at even steps, and at odd ones only the first of its others.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "every_kind", "render_modes": ["rgb_array"]}
    action_names: ClassVar[dict[str, Any]] = {"discrete": ["stay", "<b>left</b>", "right"], "clock": ["wrong number of names"]}
    scripted_action_spaces: ClassVar[dict[str, spaces.Space]] = {"clock": SCRIPTED}

    def __init__(self, render_mode=None, masked=False, picture=True):
        self.possible_agents = list(SPACES)
        self.agents: list[str] = []
        self.render_mode, self.masked, self.picture = render_mode, masked, picture
        self.rng = np.random.default_rng(0)
        self.t = 0

    def observation_space(self, agent):
        return spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def action_space(self, agent):
        return SPACES[agent]

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents, self.t = self.possible_agents[:], 0
        return self.observations(), self.infos()

    def observations(self):
        return {agent: self.rng.normal(size=4).astype(np.float32) for agent in self.possible_agents}

    def infos(self):
        infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.possible_agents}
        infos["discrete"]["active"] = self.t - 1 not in (2, 3)
        if self.masked:
            infos["discrete"]["action_mask"] = np.array([True, False, self.t % 2 == 0])
        return infos

    def step(self, actions):
        self.t += 1
        reward = float(actions["discrete"]) + float(np.sum(actions["numbers"]))
        over = self.t == LIMIT
        infos = self.infos()
        if over:
            self.agents = []
            infos["discrete"]["is_success"] = reward > 0
        ends = dict.fromkeys(self.possible_agents, over)
        return self.observations(), dict.fromkeys(self.possible_agents, reward), dict.fromkeys(ends, False), ends, infos

    def visibility(self):
        return {agent: np.array([True, *[(self.t - 1) % 2 == 0] * 3]) for agent in self.possible_agents}

    def scripted_actions(self):
        return {"clock": (self.t - 1) % 2}

    def picture_positions(self):
        return {"discrete": (0.25, 0.5), "clock": (0.75, 0.5)}

    def render(self):
        return np.full((4, 6, 3), 40 * (self.t // 2), np.uint8) if self.picture else "no picture"


SMALL: dict[str, Any] = dict(
    n_steps=16, batch_size=16, n_epochs=1, policy_kwargs={"net_arch": [8], "embedding_dim": 8, "latent_dim": 4}
)


def trained(
    algo_class: Any = BeliefPPO,
    policy: Any = "BeliefPolicy",
    env_kwargs: dict[str, Any] | None = None,
    shared: dict[str, Any] = SMALL,
    **kwargs: Any,
) -> tuple[Any, Any]:
    """A team that has learned for a moment, with the arguments that all its agents share, and its environment."""
    env = make_team_env(EveryKind, n_envs=1, env_kwargs={"render_mode": "rgb_array", **(env_kwargs or {})})
    return Team(algo_class, policy, env, seed=0, **kwargs, **shared).learn(32), env


def recorded(team, env, seed=5, **kwargs):
    env.seed(seed)
    return record_episodes(team, env, **kwargs)
