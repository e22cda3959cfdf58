"""
Policies without training for the aisles, as bounds of what can be learned, and a function that evaluates them.

A policy is called with the observations of a batch, {agent: array [n_envs, width]}, and returns actions, {agent: array
[n_envs]}. One that remembers also has ``watch``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from sb3_belief.envs.aisle_sides.config import LEFT, MIDDLE, RIGHT, AisleConfig, convention_sides
from sb3_belief.envs.aisle_sides.vec_env import AisleSidesVecEnv

Policy: TypeAlias = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]

SPANS = ("copy", "copies", "rollout")


class KeepSide:
    """
    Policy that always keeps to one side. No policy without memory is better, since all conventions are equally likely.

    :param side: 1 (left) or 2 (right)
    """

    def __init__(self, side: int = RIGHT):
        self.side = side

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Choose an action for each robot.

        :param obs: {agent: array [n_envs, width]}
        :return: {agent: int array [n_envs]}
        """
        return {agent: np.full(len(values), self.side) for agent, values in obs.items()}


class KnowConvention:
    """
    Policy that is told the convention, which no other can beat.

    :param env_kwargs: Arguments of the environment, which needs ``reveal_partner=True``
    :raises ValueError: Without it
    """

    def __init__(self, **env_kwargs: Any):
        self.config = AisleConfig(**env_kwargs)
        if not self.config.reveal_partner:
            raise ValueError("KnowConvention reads the convention from the observation: pass reveal_partner=True.")

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Choose an action for each robot.

        :param obs: {agent: array [n_envs, width]}
        :return: {agent: int array [n_envs]}
        """
        return {agent: self._sides_of(values) for agent, values in obs.items()}

    def _sides_of(self, obs: np.ndarray) -> np.ndarray:
        # Left where nobody is in sight, where it does not matter
        return obs[:, -2:].argmax(axis=1) + LEFT


class Remember:
    """
    Policy with an ideal memory: it acts by the conventions that are compatible with all that it has seen since the last draw.

    It knows when a convention is drawn and which ones can be, and guesses (left) where both sides are equally likely.

    :param span: What it remembers: ``"copy"``, the meetings of the same copy; ``"copies"``, those of all copies, which must
        share a convention; ``"rollout"``, those of all copies in the rollout before, as a history that changes between
        rollouts
    :param env_kwargs: Arguments of the environment
    :raises ValueError: For another span, or for one over copies of which each has a convention of its own
    """

    def __init__(self, span: str = "copy", **env_kwargs: Any):
        self.config, self.span = AisleConfig(**env_kwargs), span
        if span not in SPANS:
            raise ValueError(f"span={span!r} is not one of {', '.join(map(repr, SPANS))}.")
        if span != "copy" and (self.config.per_copy or self.config.redraw_unit != "rollouts"):
            raise ValueError(f"span={span!r} pools the copies, which needs per_copy=False and redraw_unit='rollouts'.")
        self._sides = convention_sides(self.config.kinds)
        self._compatible = self._new = np.zeros((0, len(self.config.weights)))
        self._age = self._episodes = np.zeros(0, dtype=np.int64)

    def __call__(self, obs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Choose an action for each robot.

        :param obs: {agent: array [n_envs, width]}
        :return: {agent: int array [n_envs]}
        """
        n_envs = len(next(iter(obs.values())))
        if len(self._compatible) != n_envs:
            self._compatible = self._new = np.tile(self.config.weights, (n_envs, 1))
            self._age, self._episodes = np.zeros((2, n_envs), dtype=np.int64)
        right = self._compatible @ (self._sides == RIGHT) / self._compatible.sum(axis=1, keepdims=True)
        chosen = np.where(right > 0.5, RIGHT, LEFT)
        return {agent: chosen[np.arange(n_envs), _kinds_of(values, self.config)] for agent, values in obs.items()}

    def watch(self, obs: dict[str, np.ndarray], infos: list[dict[str, Any]], dones: np.ndarray) -> None:
        """
        Remember what the others did.

        :param obs: The observations before the step
        :param infos: The infos of the step
        :param dones: Whether an episode has ended with it, bool [n_envs]
        """
        n_robots = self.config.n_robots
        did = np.array([info["scripted_actions"] for info in infos]).reshape(len(infos), n_robots, -1).argmax(axis=-1)
        visible = np.array([info["visible"] for info in infos])
        new = self._new.copy()
        for i, values in enumerate(obs.values()):
            seen = visible[:, i, n_robots - 1 + i] & (did[:, i] != MIDDLE)
            fits = self._sides[:, _kinds_of(values, self.config)].T == did[:, i, None]
            new *= fits | ~seen[:, None]
        self._new = new if self.span == "copy" else np.tile(new.min(axis=0), (len(new), 1))
        self._age += 1
        self._episodes += dones
        rules = self.config
        by_rollouts = rules.redraw_unit == "rollouts"
        passed, ends = (self._age, self._age % rules.rollout_steps == 0) if by_rollouts else (self._episodes, dones)
        unit = rules.rollout_steps if by_rollouts else 1
        drawn = ends & (passed % ((rules.redraw_every or len(ends) + passed.max() + 1) * unit) == 0)
        if self.span != "rollout":
            self._compatible = self._new
        elif ends.all():
            self._compatible, self._new = self._new, np.tile(rules.weights, (len(ends), 1))
        if drawn.any():
            self._compatible, self._new = self._compatible.copy(), self._new.copy()
            self._compatible[drawn] = self._new[drawn] = rules.weights


def _kinds_of(obs: np.ndarray, config: AisleConfig) -> np.ndarray:
    # 0 where nobody is in sight, where it does not matter
    start = 2 + config.sight
    return obs[:, start : start + config.kinds].argmax(axis=1)


@dataclass(frozen=True)
class AisleResult:
    """
    Result of :func:`evaluate_aisle_policy`.

    :param mean_return: Mean return of an episode and robot: the number of aisles that it drove through
    :param standard_error: Standard error of the mean, over the episodes of the team
    :param meetings: Mean number of meetings of an episode and robot in which both stepped aside
    :param jams: Share of these that ended in a jam
    :param episodes: Number of episodes
    """

    mean_return: float
    standard_error: float
    meetings: float
    jams: float
    episodes: int


def evaluate_aisle_policy(
    policy: Policy, episodes: int = 2000, seed: int = 0, n_envs: int = 20, **env_kwargs: Any
) -> AisleResult:
    """
    Evaluate a policy on the aisles.

    :param policy: Callable that maps {agent: observations [n_envs, width]} to {agent: actions [n_envs]}
    :param episodes: Smallest number of episodes, at least 1. Every copy plays the same number, so it is rounded up to a
        multiple of ``n_envs``
    :param seed: Copy i is seeded with ``seed + i``
    :param n_envs: Number of environment copies
    :param env_kwargs: Arguments of the environment
    :return: Mean return and how meetings went
    :raises ValueError: If ``episodes`` is not positive
    """
    if episodes < 1:
        raise ValueError(f"episodes={episodes} must be at least 1.")
    env = AisleSidesVecEnv(n_envs, **env_kwargs)
    env.seed(seed)
    obs: dict[str, np.ndarray] = env.reset()
    watch = getattr(policy, "watch", None)
    returns: list[float] = []
    n_meetings = n_jams = 0
    for _ in range(-(-episodes // n_envs) * env.config.max_steps):
        actions = policy(obs)
        following, _, dones, infos = env.step(actions)
        if watch is not None:
            watch(obs, infos, dones)
        obs = following
        met = env.core.other_action != MIDDLE
        # At the last step of an episode the copy has been reset
        did = np.array([info["scripted_actions"] for info in infos]).reshape(*met.shape, -1).argmax(axis=-1)
        n_meetings += int((did != MIDDLE).sum())
        n_jams += int(((did != MIDDLE) & (did != np.stack(list(actions.values()), axis=1))).sum())
        returns += [info["episode"]["r"] for info in infos if "episode" in info]
    env.close()
    n = len(returns)
    return AisleResult(
        mean_return=float(np.mean(returns)),
        standard_error=float(np.std(returns) / np.sqrt(n)),
        meetings=n_meetings / n / env.config.n_robots,
        jams=n_jams / max(n_meetings, 1),
        episodes=n,
    )
