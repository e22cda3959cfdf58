"""What is exported of an agent: one pass from its observation to the probabilities of its actions, and to its belief."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_belief.belief import BeliefOutput, expected_actions
from sb3_belief.belief_ppo.extractor import BeliefExtractor, flatten_observation
from sb3_belief.export.normalization import Normalization

MASK = "action_mask"


class PolicyGraph(nn.Module):
    """
    An agent's policy as a function of its observation and nothing else.

    The history is encoded here, once, and the belief is its mean: nothing is drawn. So the probabilities are those of
    ``policy.get_distribution``, whose mode ``predict(deterministic=True)`` takes, and the belief is that of
    ``policy.predict_others``.

    The inputs are ``observation``, or ``observation.<key>`` for each key of a Dict, batch first, in the policy's own space
    (images with the channels first; of MAPPO the agent's own observation alone), and for a masked policy ``action_mask``, bool
    ``[B, k]``. The outputs are, by name:

    - ``action_probabilities`` ``[B, k]``: the probability of each action (Discrete), of each value dimension after dimension
      (MultiDiscrete), or of a one (MultiBinary);
    - for Box actions, instead, ``action_mean`` and ``action_std`` ``[B, ...]``, to be clipped to the space's bounds;
    - ``others.<name>`` ``[B, width of its action]`` for each of the others: its expected action, as in
      ``policy.predict_others(...).actions``;
    - ``belief_mean`` and, where the belief is a distribution, ``belief_std`` ``[B, z]``.

    Where several rows of the history are equally similar to an observation, up to rounding, and not all of them are selected,
    the file may select others of them than PyTorch does. So it is where observations repeat exactly.

    :param model: The agent's model, on the CPU
    :param statistics: Its normalisation, if it has one. The graph then takes observations before they are normalised
    :raises ValueError: If its policy cannot be exported; the message says which can
    """

    #: An actor-critic policy of SB3 or sb3-contrib, with or without a belief
    policy: Any

    def __init__(self, model: BaseAlgorithm, statistics: VecNormalize | None = None) -> None:
        super().__init__()
        reason = _why_not(model.policy)
        if reason:
            raise ValueError(
                f"{type(model).__name__} cannot be exported: its {type(model.policy).__name__} {reason}. What can be exported "
                "are actor-critic policies without a recurrent state, as of BeliefPPO, MaskableBeliefPPO, PPO and A2C."
            )
        policy = model.policy
        policy.set_training_mode(False)
        self.policy = policy
        # Those of sb3-contrib are given masks after they are made; IAC's, which may have none, before
        self._masks_before: Callable[[th.Tensor | None], AbstractContextManager[None]] | None = getattr(policy, "masked", None)
        self.masked = isinstance(policy, MaskableActorCriticPolicy) or getattr(model, "learned_with_masks", False)
        # That of MAPPO observes more in training than it acts by
        self._space = space = getattr(policy, "own_space", policy.observation_space)
        self.observation_names = [f"observation.{key}" for key in space] if isinstance(space, spaces.Dict) else ["observation"]
        self.normalization = None
        if statistics is not None and statistics.norm_obs:
            self.normalization = Normalization(statistics)
        extractor = getattr(policy, "features_extractor", None)
        self._extractor = extractor if isinstance(extractor, BeliefExtractor) else None
        self._context: Any = None
        if self._extractor is not None:
            with th.no_grad():
                self._context = self._extractor.context()
        self._check_policy(type(model).__name__)

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs, in their order."""
        return [*self.observation_names, *([MASK] if self.masked else [])]

    def examples(self, n: int) -> tuple[th.Tensor, ...]:
        """
        Return inputs of the right types and shapes, sampled from the observation space. The masks allow everything.

        :param n: Number of observations
        :return: The inputs in the order of ``input_names``, ``n`` rows each
        """
        space, action_space = self._space, self.policy.action_space
        parts = list(space.values()) if isinstance(space, spaces.Dict) else [space]
        inputs = [th.stack([th.as_tensor(part.sample()) for _ in range(n)]) for part in parts]
        if not self.masked:
            return tuple(inputs)
        # sb3-contrib masks a zero and a one of each component of MultiBinary
        width = spaces.flatdim(action_space) * (2 if isinstance(action_space, spaces.MultiBinary) else 1)
        return (*inputs, th.ones(n, width, dtype=th.bool))

    @th.no_grad()
    def outputs(self, *inputs: th.Tensor) -> dict[str, th.Tensor]:
        """
        Compute in PyTorch what the exported file computes.

        :param inputs: In the order of ``input_names``
        :return: The outputs by name, without gradients
        """
        return self(*inputs)

    def forward(self, *inputs: th.Tensor) -> dict[str, th.Tensor]:
        """
        Run the policy.

        :param inputs: In the order of ``input_names``
        :return: The outputs by name
        """
        policy, (observation, mask) = self.policy, self._arguments(inputs)
        observation = preprocess_obs(observation, policy.observation_space, policy.normalize_images)
        if self._extractor is None:
            features, believed = policy.pi_features_extractor(observation), {}
        else:
            own = self._extractor.features(observation)
            flat = own if self._extractor.from_features else flatten_observation(observation)
            output = self._extractor.infer_from(self._context, flat)
            features = self._extractor.with_belief(own, output)
            believed = self._believed(output)
        with self._masks_before(mask) if self._masks_before else nullcontext():
            distribution = policy._get_action_dist_from_latent(policy.mlp_extractor.forward_actor(features))
        if mask is not None and not self._masks_before:
            distribution.apply_masking(mask)
        return {**self._action_outputs(distribution), **believed}

    def _arguments(self, inputs: tuple[th.Tensor, ...]) -> tuple[Any, th.Tensor | None]:
        """Return the observation, normalised and a dict where its space is one, and the mask."""
        space, parts = self._space, inputs[: len(self.observation_names)]
        observation: Any = dict(zip(space, parts, strict=True)) if isinstance(space, spaces.Dict) else parts[0]
        if space is not self.policy.observation_space:
            observation = self.policy.complete(observation)
        if self.normalization is not None:
            observation = self.normalization(observation)
        return observation, inputs[-1] if self.masked else None

    def _believed(self, output: BeliefOutput) -> dict[str, th.Tensor]:
        outputs, policy = {}, self.policy
        if output.prediction is not None:
            expected = expected_actions(output.prediction, policy.layout, policy.action_loss)
            for owner, name in enumerate(policy.others_action_spaces):
                outputs[f"others.{name}"] = expected[:, policy.layout.columns_of(owner)]
        outputs["belief_mean"] = output.mean
        if policy.options.variant.samples:
            outputs["belief_std"] = output.log_std.exp()
        return outputs

    def _action_outputs(self, made: Any) -> dict[str, th.Tensor]:
        """Read the parameters off the distribution that the policy has made."""
        space = self.policy.action_space
        # sb3-contrib calls a list of distributions by another name than SB3
        found = getattr(made, "distributions", None) or made.distribution
        if isinstance(space, spaces.Box):
            shape = (-1, *space.shape)
            return {"action_mean": found.mean.reshape(shape), "action_std": found.stddev.reshape(shape)}
        if isinstance(found, list):
            # sb3-contrib has a categorical distribution for each component of MultiBinary
            parts = [each.probs[:, 1:] if isinstance(space, spaces.MultiBinary) else each.probs for each in found]
            return {"action_probabilities": th.cat(parts, dim=1)}
        return {"action_probabilities": found.probs}

    def _check_policy(self, algorithm: str) -> None:
        """Refuse a policy of the user's own that makes its distributions in another way than SB3's."""
        inputs = self.examples(8)
        with th.no_grad():
            outputs = self(*inputs)
            for i in range(8):
                # One at a time, since a policy that remembers several copies takes those of a batch for observations of these
                observation, mask = self._arguments(tuple(part[i : i + 1] for part in inputs))
                if self._masks_before:
                    with self._masks_before(mask):
                        made = self.policy.get_distribution(observation)
                else:
                    made = self.policy.get_distribution(observation, *([] if mask is None else [mask]))
                for name, expected in self._action_outputs(made).items():
                    if not th.allclose(outputs[name][i : i + 1], expected, rtol=1e-3, atol=1e-5):
                        raise ValueError(
                            f"{algorithm} cannot be exported: the get_distribution() of its {type(self.policy).__name__} does"
                            " something else than SB3's. Export it by torch.export, from a module of your own."
                        )


def _why_not(policy: BasePolicy) -> str | None:
    """Return why a policy cannot be exported, or None if it can."""
    if isinstance(policy, RecurrentActorCriticPolicy):
        return "has a recurrent state, which would have to be passed on between calls"
    if not isinstance(policy, (ActorCriticPolicy, MaskableActorCriticPolicy)):
        return "is not an actor-critic policy, so it gives no probabilities of actions"
    if getattr(policy, "squash_output", False):
        return "squashes its actions (squash_output=True), so mean and deviation do not describe them"
    return None if policy.device.type == "cpu" else f"is on {policy.device}; load the model with device='cpu'"
