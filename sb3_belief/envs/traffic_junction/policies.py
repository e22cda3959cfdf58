"""
Policies that need no training, and the measure of any policy: the bars beside which a learned one is shown.

A policy is a callable from the observations of a batch, {agent: array [n_envs, width]}, to its actions, {agent: array
[n_envs]}.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from sb3_belief.envs.traffic_junction.config import JunctionConfig
from sb3_belief.envs.traffic_junction.core import BRAKE, GAS
from sb3_belief.envs.traffic_junction.layout import build_layout
from sb3_belief.envs.traffic_junction.observation import ObservationLayout

Policy: TypeAlias = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]


def all_gas(obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    :param obs: {agent: array [n_envs, width]}
    :return: everyone drives on
    """
    return {agent: np.full(len(values), GAS) for agent, values in obs.items()}


def all_brake(obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    :param obs: {agent: array [n_envs, width]}
    :return: everyone waits
    """
    return {agent: np.full(len(values), BRAKE) for agent, values in obs.items()}


class RandomPolicy:
    """
    Gas or brake with equal chances.

    :param seed: of its own generator; None: unseeded
    """

    def __init__(self, seed: int | None = None):
        self.generator = np.random.default_rng(seed)

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {agent: self.generator.integers(GAS, BRAKE + 1, size=len(values)) for agent, values in obs.items()}


class RulePolicy:
    """
    The hand rule. A car brakes if it sees a car in its next cell, or if it sees a car with a lower id that has the same
    next cell (so the lowest id leaves a shared entry cell first); otherwise it drives on. It is a decentralised policy: a
    car decides by its own observation and its own id alone, and knows the roads.

    Where several cars stand in one cell, an observation does not tell whose route is whose; the rule then takes it that any of
    them may have any of the routes. In an entry cell all have the same next cell, and elsewhere they have collided already.

    :param env_kwargs: the arguments of the environment that decide what an observation holds (level, vision, ...); others
        are checked and not used
    """

    def __init__(self, **env_kwargs: Any):
        config = JunctionConfig(**env_kwargs)
        roads = build_layout(config.level)
        self.layout = ObservationLayout.of(config)
        self.size = size = roads.level.size
        # where each route leads on from each cell; -1 where it ends or does not pass
        self._next = np.full((roads.n_routes, size * size), -1)
        on_road = np.flatnonzero(roads.cell < size * size)
        self._next[roads.route[on_road], roads.cell[on_road]] = roads.next_cell[on_road]

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        :param obs: {agent: array [n_envs, width]}, the agents in the order of ``possible_agents``
        :return: {agent: int array [n_envs]}; a slot without a car brakes
        """
        return {agent: self._actions_of(number, values) for number, (agent, values) in enumerate(obs.items())}

    def _actions_of(self, number: int, obs: np.ndarray) -> np.ndarray:
        layout, n_cars = self.layout, self.layout.n_cars
        active = obs[:, layout.active] > 0
        row, column = (np.rint(obs[:, k] * (self.size - 1)).astype(np.int64) for k in (layout.row, layout.column))
        route = obs[:, layout.route : layout.row].argmax(axis=1)
        target = self._next[route, row * self.size + column]

        window = obs[:, layout.cells :].reshape(len(obs), layout.window**2, layout.cell_width)
        copies, seen = np.nonzero(window[:, :, 0])
        down, right = seen // layout.window - layout.vision, seen % layout.window - layout.vision
        cell = (row[copies] + down) * self.size + column[copies] + right
        in_view = window[copies, seen]
        lower = in_view[:, 1 : 1 + number].any(axis=1)
        routes = in_view[:, 1 + n_cars : 1 + n_cars + layout.n_routes] > 0
        same_target = (routes & (self._next.T[cell] == target[copies, None])).any(axis=1)
        blocked = (cell == target[copies]) | (lower & same_target & (target[copies] >= 0))
        brake = ~active
        brake[copies[blocked]] = True
        return np.where(brake, BRAKE, GAS)


@dataclass(frozen=True)
class Evaluation:
    """
    :param success_rate: share of episodes without a collision
    :param standard_error: of the success rate
    :param mean_return: mean over episodes of the team's return (rewards as scaled, mean over slots)
    :param occupancy: share of the slots that hold a car, seen after each step
    :param visible: mean number of other cars that a car sees when it acts
    :param episodes: number of episodes
    """

    success_rate: float
    standard_error: float
    mean_return: float
    occupancy: float
    visible: float
    episodes: int


def evaluate(policy: Policy, episodes: int = 1024, seed: int = 0, n_envs: int = 64, **env_kwargs: Any) -> Evaluation:
    """
    Measure any policy on the Traffic Junction.

    :param policy: {agent: observations [n_envs, width]} -> {agent: actions [n_envs]}
    :param episodes: at least so many episodes; every copy plays the same number, so it is rounded up to a multiple of
        ``n_envs``
    :param seed: the traffic of copy i comes from the seed ``seed + i``
    :param n_envs: number of copies
    :param env_kwargs: arguments of the environment
    :return: what was measured
    :raises ValueError: if ``episodes`` is not positive
    """
    # imported here: the policies themselves do not need the team room
    from sb3_belief.envs.traffic_junction.vec_env import TrafficJunctionVecEnv

    if episodes < 1:
        raise ValueError(f"episodes={episodes} must be at least 1.")
    env = TrafficJunctionVecEnv(n_envs, **env_kwargs)
    env.seed(seed)
    obs = env.reset()
    rounds = -(-episodes // n_envs)
    successes, returns = [], []
    n_visible = n_active = n_on_road = 0
    for _ in range(rounds * env.core.max_steps):
        obs, _, _, infos = env.step(policy(obs))
        for info in infos:
            n_visible += int(info["visible"].sum())
            n_active += int(info["active"].sum())
            final = info.get("terminal_observation", None)
            if final is not None:
                n_on_road += sum(int(values[0]) for values in final.values())
                successes.append(info["is_success"])
                returns.append(info["episode"]["r"])
        # at an episode's end these are the empty roads of the next one, so nothing is counted twice
        n_on_road += sum(int(values[:, 0].sum()) for values in obs.values())
    env.close()
    rate, n = float(np.mean(successes)), len(successes)
    return Evaluation(
        success_rate=rate,
        standard_error=float(np.sqrt(rate * (1 - rate) / n)),
        mean_return=float(np.mean(returns)),
        occupancy=n_on_road / (n * env.core.max_steps * env.core.n_cars),
        visible=n_visible / max(n_active, 1),
        episodes=n,
    )


def success_rate(policy: Policy, episodes: int = 1024, seed: int = 0, n_envs: int = 64, **env_kwargs: Any) -> float:
    """
    The share of episodes without a collision; the arguments are those of :func:`evaluate`.
    """
    return evaluate(policy, episodes, seed, n_envs, **env_kwargs).success_rate
