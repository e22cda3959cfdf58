"""Independent actor-critic: one A2C for each agent, with action masks and without the steps in which it was not in play."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_belief.belief_ppo.active_steps import ActiveStepsAlgorithmMixin, ActiveStepsBufferMixin
from sb3_belief.belief_ppo.algorithm import refuse_many_agents
from sb3_belief.belief_ppo.buffers import attach, attached
from sb3_belief.common.action_masks import env_masks, mask_width
from sb3_belief.common.safe_files.algorithm import SafeFilesMixin

# As sb3-contrib has it: a logit of no probability, whose entropy is finite
_IMPOSSIBLE = -1e8


class IACBufferMixin(ActiveStepsBufferMixin):
    """Makes a rollout buffer of SB3's one that also holds the action masks of each step."""

    extras = (*ActiveStepsBufferMixin.extras, "action_masks")

    action_masks: np.ndarray
    #: Whether the environment of this rollout has masks
    has_masks = False

    def reset(self) -> None:
        super().reset()
        self.action_masks = np.ones((self.buffer_size, self.n_envs, mask_width(self.action_space)), dtype=bool)

    def add(self, *args: Any, **kwargs: Any) -> None:
        """
        Add a step as SB3 does, with the masks that the policy has attached to its values.

        :param args: As in SB3
        :param kwargs: As in SB3
        """
        masks = attached(kwargs["value"] if "value" in kwargs else args[4])
        if masks is not None:
            self.action_masks[self.pos] = masks.cpu().numpy()
        super().add(*args, **kwargs)

    def _samples(self, rows: np.ndarray) -> Any:
        samples = super()._samples(rows)
        if not self.has_masks:
            return samples
        return samples._replace(observations=attach(samples.observations, self.to_torch(self.action_masks[rows])))


class IACRolloutBuffer(IACBufferMixin, RolloutBuffer):
    """SB3's rollout buffer without inactive steps and with action masks."""


class IACDictRolloutBuffer(IACBufferMixin, DictRolloutBuffer):
    """SB3's rollout buffer for Dict observations, without inactive steps and with action masks."""


class IACPolicy(ActorCriticPolicy):
    """SB3's ``ActorCriticPolicy``, whose distributions leave out what a mask forbids where there is one."""

    #: Reads the masks of the present observations, bool ``[n_envs, k]``, while a rollout is collected
    read_masks: Callable[[], np.ndarray] | None = None
    _masks: th.Tensor | None = None

    @contextmanager
    def masked(self, masks: th.Tensor | np.ndarray | None) -> Iterator[None]:
        """
        Leave out of distributions what masks forbid, within the block.

        :param masks: bool ``[B, k]``; None to leave out nothing
        """
        self._masks = None if masks is None else th.as_tensor(masks, device=self.device, dtype=th.bool)
        try:
            yield
        finally:
            self._masks = None

    def forward(self, obs: Any, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Choose actions as SB3 does, among those that are possible.

        :param obs: Observations
        :param deterministic: As in SB3
        :return: Actions, values, to which the masks are attached for the rollout buffer, and log probabilities
        """
        if self.read_masks is None:
            return super().forward(obs, deterministic)
        with self.masked(self.read_masks()):
            masks = self._masks
            actions, values, log_prob = super().forward(obs, deterministic)
        return actions, attach(values, masks), log_prob

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """
        Evaluate actions as SB3 does, with the masks that are attached to the observations.

        :param obs: Observations
        :param actions: Actions
        :return: Values, log likelihood and entropy of the actions
        """
        with self.masked(attached(obs)):
            return super().evaluate_actions(obs, actions)

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        if self._masks is None:
            return super()._get_action_dist_from_latent(latent_pi)
        logits = masked_logits(self.action_space, self.action_net(latent_pi), self._masks)
        return self.action_dist.proba_distribution(action_logits=logits)


class IACCnnPolicy(IACPolicy):
    """A policy for images."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("features_extractor_class", NatureCNN)
        super().__init__(*args, **kwargs)


class IACMultiInputPolicy(IACPolicy):
    """A policy for Dict observations."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("features_extractor_class", CombinedExtractor)
        super().__init__(*args, **kwargs)


def masked_logits(space: spaces.Space, logits: th.Tensor, masks: th.Tensor) -> th.Tensor:
    """
    Return logits that leave no probability to what masks forbid.

    :param space: Discrete, MultiDiscrete or MultiBinary action space
    :param logits: ``[B, k]``; for MultiBinary one for each component, ``[B, n]``
    :param masks: bool ``[B, k]``, the flags of all dimensions side by side; for MultiBinary ``[B, 2 n]``
    :return: Logits of the same shape
    """
    if isinstance(space, spaces.MultiBinary):
        possible = masks.reshape(len(logits), -1, 2)
        logits = logits.masked_fill(~possible[:, :, 0], -_IMPOSSIBLE)
        return logits.masked_fill(~possible[:, :, 1], _IMPOSSIBLE)
    return logits.masked_fill(~masks, _IMPOSSIBLE)


class IAC(SafeFilesMixin, ActiveStepsAlgorithmMixin, A2C):
    """
    Independent actor-critic with a critic of states, IAC-V (Foerster et al. 2018, arXiv:1705.08926, Sec. 3).

    SB3's A2C for one agent among others: one gradient step a rollout, on the agent's own observations and rewards. Steps with
    ``active=False`` in ``info`` are left out, and where the environment has action masks they hold in rollout and update. With
    neither it is A2C, bit for bit. All arguments are A2C's.

    The paper's other variant, IAC-Q with a critic of actions, is not here.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"``, or a class derived from :class:`IACPolicy`
    :param env: The environment of this one agent
    :param args: As in A2C
    :param kwargs: As in A2C
    :raises TypeError: For an environment of many agents, or a policy or rollout buffer that has no place for masks
    """

    policy: IACPolicy
    rollout_buffer: IACBufferMixin
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": IACPolicy,
        "CnnPolicy": IACCnnPolicy,
        "MultiInputPolicy": IACMultiInputPolicy,
    }
    #: Its environment need not have masks
    needs_action_masks: ClassVar[bool] = False

    def __init__(self, policy: str | type[IACPolicy], env: Any, *args: Any, **kwargs: Any) -> None:
        refuse_many_agents(env, type(self).__name__)
        #: Whether the environment has had masks, so that ``predict`` misses them if it is given none
        self.learned_with_masks = False
        super().__init__(policy, env, *args, **kwargs)

    def _setup_model(self) -> None:
        if not issubclass(self.policy_class, IACPolicy):
            raise TypeError(f"the policy of IAC must be derived from IACPolicy, and {self.policy_class.__name__} is not")
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = IACDictRolloutBuffer if is_dict else IACRolloutBuffer
        elif not issubclass(self.rollout_buffer_class, IACBufferMixin):
            raise TypeError(
                f"rollout_buffer_class is {self.rollout_buffer_class.__name__}; derive it from IACRolloutBuffer (or"
                " IACDictRolloutBuffer)"
            )
        super()._setup_model()
        self.learned_with_masks = self.learned_with_masks or (self.env is not None and self._has_masks(self.env))

    def _has_masks(self, env: VecEnv) -> bool:
        return mask_width(self.action_space) > 0 and env.has_attr("action_masks")

    def _maybe_recommend_cpu(self, mlp_class_name: str = "IACPolicy") -> None:
        super()._maybe_recommend_cpu(mlp_class_name)

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """
        Collect a rollout as SB3 does, with the environment's masks if it has any.

        :param env: As in SB3
        :param callback: As in SB3
        :param rollout_buffer: As in SB3
        :param n_rollout_steps: As in SB3
        :return: As in SB3
        """
        assert isinstance(rollout_buffer, IACBufferMixin)
        rollout_buffer.has_masks = self._has_masks(env)
        if rollout_buffer.has_masks:
            self.learned_with_masks = True
            self.policy.read_masks = partial(env_masks, env)
        try:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        finally:
            self.policy.read_masks = None

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Predict as SB3 does, among the possible actions.

        :param observation: As in SB3
        :param state: As in SB3
        :param episode_start: As in SB3
        :param deterministic: As in SB3
        :param action_masks: Possible actions, bool ``[n_envs, k]`` or ``[k]``; None if all are
        :return: As in SB3
        """
        masks = None if action_masks is None else np.reshape(action_masks, (-1, mask_width(self.action_space)))
        with self.policy.masked(masks):
            return super().predict(observation, state, episode_start, deterministic)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 100,
        tb_log_name: str = "IAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> "IAC":
        """Learn as A2C does. The arguments are those of A2C's ``learn``."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
