"""
Policies without training, as baselines for learned ones, and a function that evaluates any policy.

A policy is a callable that maps the observations of a batch, {agent: array [n_envs, width]}, to actions, {agent: array
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
    Let every car drive on.

    :param obs: {agent: array [n_envs, width]}
    :return: {agent: int array [n_envs]}
    """
    return {agent: np.full(len(values), GAS) for agent, values in obs.items()}


def all_brake(obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    Let every car wait.

    :param obs: {agent: array [n_envs, width]}
    :return: {agent: int array [n_envs]}
    """
    return {agent: np.full(len(values), BRAKE) for agent, values in obs.items()}


class RandomPolicy:
    """
    Policy that chooses gas or brake with equal probability.

    :param seed: Seed of the policy's own random generator, or None
    """

    def __init__(self, seed: int | None = None):
        self.generator = np.random.default_rng(seed)

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Choose an action for each car.

        :param obs: {agent: array [n_envs, width]}
        :return: {agent: int array [n_envs]}
        """
        return {agent: self.generator.integers(GAS, BRAKE + 1, size=len(values)) for agent, values in obs.items()}


class RulePolicy:
    """
    Hand-written rule of right of way.

    A car brakes if it sees a car in its next cell, or if it sees a car with a lower id that has the same next cell (so the
    lowest id leaves a shared entry cell first). Otherwise it drives on. The policy is decentralised: a car knows the roads and
    its own id, and decides by its own observation alone.

    If several cars are in one cell, an observation does not say which of them has which route. The rule then assumes that each
    of them may have any of the routes. In an entry cell all cars have the same next cell, and in any other cell they have
    already collided.

    :param env_kwargs: Arguments of the environment that determine the layout of observations (level, vision, ...). Others are
        checked but not used
    """

    def __init__(self, **env_kwargs: Any):
        config = JunctionConfig(**env_kwargs)
        roads = build_layout(config.level)
        self.layout = ObservationLayout.of(config)
        self.size = size = roads.level.size
        # The next cell for each route and cell. -1 where the route ends or that it does not pass
        self._next = np.full((roads.n_routes, size * size), -1)
        on_road = np.flatnonzero(roads.cell < size * size)
        self._next[roads.route[on_road], roads.cell[on_road]] = roads.next_cell[on_road]

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Choose an action for each car.

        :param obs: {agent: array [n_envs, width]}, the agents in the order of ``possible_agents``
        :return: {agent: int array [n_envs]}. A slot without a car brakes
        """
        return {agent: self._actions_of(number, values) for number, (agent, values) in enumerate(obs.items())}

    def _actions_of(self, number: int, obs: np.ndarray) -> np.ndarray:
        layout, n_cars = self.layout, self.layout.n_cars
        active = obs[:, layout.active] > 0
        # Observations hold row / (size - 1) and column / (size - 1)
        row, column = (np.rint(obs[:, k] * (self.size - 1)).astype(np.int64) for k in (layout.row, layout.column))
        route = obs[:, layout.route : layout.row].argmax(axis=1)
        target = self._next[route, row * self.size + column]

        # One row per pair of a copy and a cell in view that is not empty
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
    Result of :func:`evaluate_junction_policy`.

    :param success_rate: Fraction of episodes without a collision
    :param standard_error: Standard error of the success rate
    :param mean_return: Mean over episodes of the team's return (scaled rewards, mean over slots)
    :param occupancy: Mean fraction of slots that hold a car, taken after each step
    :param visible: Mean number of other cars that a car sees when it acts
    :param episodes: Number of episodes
    """

    success_rate: float
    standard_error: float
    mean_return: float
    occupancy: float
    visible: float
    episodes: int


def evaluate_junction_policy(
    policy: Policy, episodes: int = 1024, seed: int = 0, n_envs: int = 64, **env_kwargs: Any
) -> Evaluation:
    """
    Evaluate a policy on the Traffic Junction.

    :param policy: Callable that maps {agent: observations [n_envs, width]} to {agent: actions [n_envs]}
    :param episodes: Smallest number of episodes, at least 1. Every copy plays the same number, so it is rounded up to a
        multiple of ``n_envs``
    :param seed: Copy i is seeded with ``seed + i``
    :param n_envs: Number of environment copies
    :param env_kwargs: Arguments of the environment
    :return: Success rate and other statistics
    :raises ValueError: If ``episodes`` is not positive
    """
    # Imported here, because the policies themselves do not need the vectorised environment
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
        # At the end of an episode these observations show the empty roads of the next one, so no car is counted twice
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
    Return the fraction of episodes without a collision.

    :param policy: See :func:`evaluate_junction_policy`
    :param episodes: See :func:`evaluate_junction_policy`
    :param seed: See :func:`evaluate_junction_policy`
    :param n_envs: See :func:`evaluate_junction_policy`
    :param env_kwargs: See :func:`evaluate_junction_policy`
    :return: Success rate in [0, 1]
    """
    return evaluate_junction_policy(policy, episodes, seed, n_envs, **env_kwargs).success_rate
