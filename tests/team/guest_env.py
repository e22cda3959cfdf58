"""A host who stays the same for some episodes, and a guest who can learn which one it is only in the first of them."""

from functools import partial
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_belief import Team, make_team_env

HOSTS = ("left", "right")
# Of a recurrent algorithm that learns to remember a host from its first episode to its second, in the steps of trained_guest()
_SETTINGS: dict[str, Any] = dict(n_steps=16, batch_size=256, n_epochs=4, learning_rate=1e-2, gamma=0.0, gae_lambda=0.0)


class GuestEnv(ParallelEnv):
    """
    Episodes of two steps in which the guest is rewarded for doing what the host does.

    The host always does the same, and is another from one partner to the next or not, by chance. Its action can be seen in the
    first episode beside a guest alone, where the observation [step, clue] says, too, which one it is: by a clue of -1 or 1. In
    the other episodes, whose clue is 0, only a memory of the first one helps.

    :param every: For how many episodes a host stays
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "guest"}
    render_mode = None

    def __init__(self, every: int = 4):
        self.possible_agents = ["guest"]
        self.agents: list[str] = []
        self.every, self.episode, self.t, self.host = every, -1, 0, 0
        self.rng = np.random.default_rng(0)
        self.scripted_action_spaces = {"host": spaces.Discrete(2)}

    @property
    def partner(self):
        """Name of the host who is there."""
        return HOSTS[self.host]

    def observation_space(self, agent):
        return spaces.Box(-1, 2, (2,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng, self.episode = np.random.default_rng(seed), -1
        self.agents, self.t = ["guest"], 0
        self.episode += 1
        if self.episode % self.every == 0:
            self.host = int(self.rng.integers(2))
        return self.observations(), {"guest": {}}

    def step(self, actions):
        self.t += 1
        over = self.t == 2
        reward = float(actions["guest"] == self.host)
        result: Any = self.observations(), {"guest": reward}, {"guest": False}, {"guest": over}, {"guest": {}}
        if over:
            self.agents = []
        return result

    def scripted_actions(self):
        return {"host": self.host}

    def visibility(self):
        return {"guest": np.array([self.episode % self.every == 0])}

    def observations(self):
        clue = 2 * self.host - 1 if self.episode % self.every == 0 else 0
        return {"guest": np.array([self.t, clue], dtype=np.float32)}


def trained_guest(algo):
    """Return a team of one guest who has met many hosts, each for two episodes, of which the second gives no clue."""
    env = make_team_env(partial(GuestEnv, every=2), n_envs=16, seed=0, partner_starts=True)
    kwargs = {**_SETTINGS, "policy_kwargs": {"net_arch": [16], "lstm_hidden_size": 16}}
    return Team(algo, "MultiInputLstmPolicy", env, seed=1, device="cpu", **kwargs).learn(10 * 256)
