"""One model for all agents of a team, which acts for each with the same weights. It shares weights: not decentralised."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.references.adapters import SharedVecEnv, to_rows
from sb3_belief.references.mappo import MAPPO, OWN, MaskableMAPPO

SelfShared = TypeVar("SelfShared", bound="SharedWeightsMixin")

if TYPE_CHECKING:
    _Algorithm = OnPolicyAlgorithm
else:
    _Algorithm = object


class SharedWeightsMixin(_Algorithm):
    """
    Makes an on-policy algorithm one that learns in the rows of a :class:`~sb3_belief.references.adapters.SharedVecEnv`.

    As the one learner of a team (``OneLearnerVecEnv``) it counts joint steps as the others do: ``learn(total)`` makes
    ``total`` steps of all copies, in which the model itself counts n rows each. Its ``n_steps`` and ``batch_size`` are those
    of SB3, where a rollout has ``n_steps * n_envs * n`` rows.
    """

    #: What the team's environment shows and takes, which for the model are rows
    team_observation_space: spaces.Space
    team_action_space: spaces.Space

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any) -> None:
        if kwargs.setdefault("belief", "none") != "none":
            raise ValueError(
                f"belief is {kwargs['belief']!r}; with shared weights there are no others to hold one about: leave it 'none'"
            )
        # Before SB3's constructor, which wraps the environment
        if isinstance(env, VecEnv):
            self.team_observation_space, self.team_action_space = env.observation_space, env.action_space
        super().__init__(policy, env, *args, **kwargs)

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        # SB3 calls it for the environment of a new model, of one that is loaded, and of set_env()
        inner = env
        while isinstance(inner, VecEnvWrapper) and not isinstance(inner, SharedVecEnv):
            inner = inner.venv
        if isinstance(env, VecEnv) and not isinstance(inner, SharedVecEnv):
            env = SharedVecEnv(env)
        return BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)

    @property
    def n_agents(self) -> int:
        """How many agents it acts for."""
        shape = self.team_action_space.shape
        assert shape is not None
        return int(shape[0])

    def learn(self: SelfShared, total_timesteps: int, *args: Any, **kwargs: Any) -> SelfShared:
        """
        Learn as the algorithm itself does.

        :param total_timesteps: Number of joint steps, over all copies
        :param args: As of the algorithm
        :param kwargs: As of the algorithm
        :return: The model
        """
        return super().learn(total_timesteps * self.n_agents, *args, **kwargs)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        **kwargs: Any,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Predict as the algorithm itself does, for one agent's own observation, a batch of them, or a batch of whole teams.

        :param observation: ``[...]``, ``[n, ...]`` or ``[n_envs, n, ...]``; with ``agent_id=True`` its last part is the id
        :param state: None: there is no recurrent state
        :param episode_start: As in SB3
        :param deterministic: As in SB3
        :param kwargs: As in SB3 or sb3-contrib
        :return: Actions, of the same leading shape
        """
        if not self._is_of_teams(observation):
            return super().predict(observation, state, episode_start, deterministic, **kwargs)
        actions, state = super().predict(to_rows(observation), state, episode_start, deterministic, **kwargs)
        return actions.reshape(-1, self.n_agents, *actions.shape[1:]), state

    def _is_of_teams(self, observation: Any) -> bool:
        space: Any = self.team_observation_space
        if isinstance(observation, Mapping):
            key = next(iter(observation))
            observation, space = observation[key], space[key]
        elif isinstance(space, spaces.Dict):
            # An agent's own, without what only the critic sees
            space = space[OWN]
        return np.ndim(observation) == len(space.shape) + 1


class SharedPPO(SharedWeightsMixin, BeliefPPO):
    """
    PPO with one model for all agents of a team, the usual "IPPO" of the literature. It shares weights: not decentralised.

    All arguments are those of :class:`~sb3_belief.BeliefPPO`, whose belief is ``"none"`` here. Its environment is made by
    :func:`~sb3_belief.references.adapters.shared_weights`.
    """


class SharedMAPPO(SharedWeightsMixin, MAPPO):
    """
    MAPPO with one model for all agents of a team, as it is mostly published.

    It shares weights: not decentralised, and uses the global state in training. All arguments are those of
    :class:`~sb3_belief.references.mappo.MAPPO`. Its environment is made by
    :func:`~sb3_belief.references.adapters.shared_with_state`.
    """


class MaskableSharedWeightsMixin(SharedWeightsMixin):
    """The same with action masks, one row for each agent."""

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Predict as :class:`SharedPPO` does.

        :param observation: As there
        :param state: As there
        :param episode_start: As there
        :param deterministic: As there
        :param action_masks: Possible actions, bool ``[k]``, ``[n, k]`` or ``[n_envs, n * k]``
        :return: As there
        """
        if action_masks is not None and self._is_of_teams(observation):
            action_masks = np.reshape(action_masks, (len(action_masks) * self.n_agents, -1))
        return super().predict(observation, state, episode_start, deterministic, action_masks=action_masks)


class MaskableSharedPPO(MaskableSharedWeightsMixin, MaskableBeliefPPO):  # type: ignore[misc]
    """
    PPO with one model for all agents and invalid action masking. It shares weights: not decentralised. See :class:`SharedPPO`.

    All arguments are those of ``MaskableBeliefPPO``, whose belief is ``"none"`` here.
    """


class MaskableSharedMAPPO(MaskableSharedWeightsMixin, MaskableMAPPO):  # type: ignore[misc]
    """
    MAPPO with one model for all agents and invalid action masking. See :class:`SharedMAPPO`.

    It shares weights: not decentralised, and uses the global state in training. All arguments are those of ``MaskableMAPPO``.
    """
