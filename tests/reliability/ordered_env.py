"""An environment that dies, hangs or raises when a file says so."""

import os
import signal
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class OrderedEnv(ParallelEnv):
    """
    Two agents that are rewarded for choosing the number that the other one sees. Its state is what its attributes are.

    :param orders: A file. The copy that finds it first takes it away and does what it says: "die", "hang" or "raise"
    """

    metadata: ClassVar = {"name": "ordered_v0"}

    def __init__(self, orders=None):
        self.orders = orders
        self.possible_agents = ["one", "other"]
        self.observation_spaces = {agent: spaces.Box(0.0, 1.0, (4,), np.float32) for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(4) for agent in self.possible_agents}
        self.agents = []
        self.rng = np.random.default_rng()
        self.steps, self.numbers = 0, [0, 0]

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def _draw(self):
        self.numbers = self.rng.integers(4, size=2).tolist()
        rows = np.eye(4, dtype=np.float32)[self.numbers]
        return dict(zip(self.agents, rows, strict=True))

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents, self.steps = list(self.possible_agents), 0
        return self._draw(), {agent: {} for agent in self.agents}

    def step(self, actions):
        self._obey()
        self.steps += 1
        rewards = {"one": float(actions["one"] == self.numbers[1]), "other": float(actions["other"] == self.numbers[0])}
        observations, agents = self._draw(), self.agents
        # Of drawn lengths, so that an episode that is lost or doubled shows
        ended = self.steps >= 4 and self.rng.random() < 0.15
        if ended:
            self.agents = []
        flags = dict.fromkeys(agents, bool(ended))
        return observations, rewards, flags, dict.fromkeys(agents, False), {agent: {} for agent in agents}

    def _obey(self):
        if self.orders is None or not os.path.exists(self.orders):
            return
        mine = f"{self.orders}.{os.getpid()}"
        try:
            os.rename(self.orders, mine)
        except FileNotFoundError:
            # Another copy was faster
            return
        order = Path(mine).read_text()
        os.unlink(mine)
        if order == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif order == "hang":
            time.sleep(10_000)
        else:
            raise RuntimeError("as ordered")


def make(orders=None):
    return OrderedEnv(orders)
