"""Actions of the agents' models outside of their own ``learn()``."""

import inspect
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.team.arguments import check_agent_keys, partners_hint
from sb3_belief.vec_env.team_vec_env import JointObs, TeamObs

# Recurrent state of a policy, as SB3's predict() takes and returns it
PolicyState = tuple[np.ndarray, ...] | None


def takes_masks(model: BaseAlgorithm) -> bool:
    """
    Tell whether a model's ``predict`` takes action masks.

    :param model: Of an agent
    """
    return _has_masks_argument(getattr(model.predict, "__func__", model.predict))


def _misses_masks(model: BaseAlgorithm) -> bool:
    """Tell whether a model acts otherwise than in training if it is given no masks."""
    return takes_masks(model) and getattr(model, "learned_with_masks", True)


@cache
def _has_masks_argument(predict: Callable[..., Any]) -> bool:
    # Asked for each agent at each prediction, and slow to find out
    return "action_masks" in inspect.signature(predict).parameters


class Predictor:
    """
    Predicts with a model from observations as the team's environment returns them, before normalisation.

    :param model: Of the agent
    :param statistics: Its normalisation, if it has one; it is used as it is and never updated
    """

    def __init__(self, model: BaseAlgorithm, statistics: VecNormalize | None):
        self.model, self._statistics = model, statistics
        #: Whether the model's ``predict`` takes action masks
        self.takes_masks = takes_masks(model)
        self._state: PolicyState = None

    @property
    def normalizes(self) -> bool:
        """Whether the model gets other observations than the environment returns."""
        return self._statistics is not None

    def observed(self, obs: Any) -> Any:
        """
        Return observations as the model gets them: normalised, if it is.

        :param obs: Observations as the team's environment returns them
        """
        return obs if self._statistics is None else self._statistics.normalize_obs(obs)

    def rewarded(self, rewards: np.ndarray) -> np.ndarray:
        """
        Return rewards as the model gets them in training: normalised, if it is.

        :param rewards: Rewards as the team's environment returns them
        """
        return rewards if self._statistics is None else self._statistics.normalize_reward(rewards)

    def predict(
        self,
        obs: np.ndarray,
        state: PolicyState = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, PolicyState]:
        """
        Predict as SB3's ``predict`` does.

        :param obs: One observation or a batch of them, not normalised
        :param state: Recurrent state, None at first
        :param episode_start: Where the recurrent state starts anew, bool ``[n_envs]``
        :param deterministic: Whether to take the most likely action instead of a sample
        :param masks: Possible actions, bool ``[n_envs, k]`` or ``[k]``; for models whose ``predict`` takes them
        :return: Action(s) and the next recurrent state
        """
        obs = self.observed(obs)
        kwargs: dict[str, Any] = {} if masks is None or not self.takes_masks else {"action_masks": masks}
        return self.model.predict(obs, state, episode_start, deterministic, **kwargs)

    def act(self, obs: np.ndarray, episode_start: np.ndarray, masks: np.ndarray | None) -> np.ndarray:
        """
        Sample actions as in training, keeping the recurrent state, for an agent that has finished learning before others.

        :param obs: ``[num_envs, ...]``
        :param episode_start: bool ``[num_envs]``
        :param masks: bool ``[num_envs, k]``, or None
        :return: ``[num_envs, ...]``
        """
        actions, self._state = self.predict(obs, self._state, episode_start, masks=masks)
        return actions


class TeamPredictor:
    """
    Predicts for the agents of a team: all of them, or those that are in play.

    :param models: The models by agent
    :param statistics: The normalisation of the agents that have one
    :param scripted: Names of the scripted others, who act in the environment by themselves
    """

    def __init__(
        self,
        models: Mapping[str, BaseAlgorithm],
        statistics: Mapping[str, VecNormalize],
        scripted: Collection[str] = (),
    ):
        self._models, self._statistics, self._scripted = models, statistics, scripted
        self._has_warned = self._has_warned_of_lives = False

    @property
    def takes_masks(self) -> bool:
        """Whether a model takes action masks."""
        return any(map(takes_masks, self._models.values()))

    def predict(
        self,
        observation: Mapping[str, Any],
        state: Mapping[str, PolicyState] | None,
        episode_start: np.ndarray | Mapping[str, np.ndarray] | None,
        deterministic: bool,
        action_masks: Mapping[str, np.ndarray] | Sequence[Mapping[str, np.ndarray]] | np.ndarray | None,
    ) -> tuple[TeamObs, dict[str, PolicyState] | None]:
        """
        Predict as ``Team.predict`` does.

        :param observation: As there
        :param state: As there
        :param episode_start: As there
        :param deterministic: As there
        :param action_masks: As there
        :return: As there
        :raises TypeError: If the observation is not a dict
        :raises ValueError: If an agent is unknown
        """
        if not isinstance(observation, Mapping):
            raise TypeError(
                f"A team predicts from {{agent: observation}}, not from {type(observation).__name__}; a single agent's model,"
                " team.agents[name], predicts from its own observation."
            )
        try:
            check_agent_keys("The observation", observation, list(self._models))
        except ValueError as error:
            raise ValueError(f"{error}{partners_hint(self._scripted, observation)}") from None
        if action_masks is None and not self._has_warned and any(map(_misses_masks, self._models.values())):
            self._has_warned = True
            warnings.warn(
                "A team whose models take action masks predicts without any, and so with other actions than in training. SB3's"
                " own evaluate_policy and EvalCallback pass none: use those of sb3_contrib.common.maskable (evaluation,"
                " callbacks.MaskableEvalCallback), or team.predict(obs, action_masks=env.action_masks())."
            )
        if action_masks is not None and not isinstance(action_masks, Mapping):
            action_masks = {agent: np.stack([copy[agent] for copy in action_masks]) for agent in action_masks[0]}
        actions: TeamObs = {}
        # Those who are absent keep the states that they had
        states: dict[str, PolicyState] = {agent: None if state is None else state.get(agent) for agent in self._models}
        for agent, model in self._models.items():
            if agent in observation:
                actions[agent], states[agent] = Predictor(model, self._statistics.get(agent)).predict(
                    observation[agent],
                    states[agent],
                    None if states[agent] is None else self._starts(agent, observation, episode_start),
                    deterministic,
                    None if action_masks is None else action_masks.get(agent),
                )
        return actions, states if any(s is not None for s in states.values()) else None

    def _starts(
        self, agent: str, observation: Mapping[str, Any], episode_start: np.ndarray | Mapping[str, np.ndarray] | None
    ) -> np.ndarray | None:
        """Return where an agent's recurrent state starts anew, as in training: where its own return has ended."""
        if isinstance(episode_start, Mapping):
            return episode_start.get(agent)
        if isinstance(observation, JointObs):
            ends = observation.life_ends(agent)
            if ends is None or episode_start is None:
                return ends if episode_start is None else episode_start
            return ends | np.asarray(episode_start, dtype=bool)
        if episode_start is not None and not self._has_warned_of_lives:
            self._has_warned_of_lives = True
            warnings.warn(
                "Recurrent agents start anew only with the team's episode here. If lives of single agents end within it, give"
                " predict() the observations of a TeamVecEnv as they are, which say so (a wrapper or a copy has replaced"
                " these), or episode_start={agent: bool[n_envs]}."
            )
        return episode_start
