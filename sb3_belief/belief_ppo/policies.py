"""Actor-critic policies whose features hold a belief about the other agents."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch.distributions import Distribution

from sb3_belief.belief import ACTION_LOSSES, BeliefOutput, expected_actions, kl_divergence
from sb3_belief.belief_ppo.adaptive import AdaptiveExtractor, OnlineMemory
from sb3_belief.belief_ppo.added_loss import add_loss as add_loss
from sb3_belief.belief_ppo.buffers import BeliefMinibatch, SampledLatents, attach, attached
from sb3_belief.belief_ppo.extractor import BeliefExtractor, BeliefPass
from sb3_belief.belief_ppo.on_policy_details import DetailsPolicyMixin
from sb3_belief.belief_ppo.others import OthersPrediction
from sb3_belief.belief_ppo.remembering import RememberingMixin


def _fused_adam_kwargs(optimizer_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """
    Add PyTorch's fused implementation to Adam's arguments, unless the user has chosen another.

    It makes one call for all weights instead of ten for each of these many small ones, and the same step to the last bits.

    :param optimizer_kwargs: The user's arguments, or SB3's
    """
    chosen = optimizer_kwargs.keys() & {"fused", "foreach", "capturable", "differentiable"}
    return dict(optimizer_kwargs) if chosen else {**optimizer_kwargs, "fused": True}


def _n_rows(obs: PyTorchObs) -> int:
    return len(next(iter(obs.values()))) if isinstance(obs, dict) else len(obs)


class _Unchecked:
    """
    Lets torch's distributions leave out their checks, a fifth of a pass through a small network. Drawing from a discrete
    distribution notices NaN by itself.
    """

    def __enter__(self) -> None:
        self._before = Distribution._validate_args
        Distribution.set_default_validate_args(False)

    def __exit__(self, *_: object) -> None:
        Distribution.set_default_validate_args(self._before)


class BeliefPolicyMixin(RememberingMixin):
    """
    Makes an SB3 actor-critic policy one with a belief.

    All of SB3's own passes (`forward`, `evaluate_actions`, `get_distribution`, `predict_values`) go through the features
    extractor, so the belief is inferred there, once a pass, for policy and value alike. What is left here is to say how it is
    drawn, and to add its loss.
    """

    #: Weights of the two terms of the belief's loss (eq. 8), set by the algorithm before each update
    action_coef: float = 0.5
    kl_coef: float = 0.005
    #: Weight of the loss of the baseline that sees the others, likewise
    baseline_coef: float = 0.5

    def _build(self, lr_schedule: Schedule) -> None:
        if self.optimizer_class is th.optim.Adam:
            self.optimizer_kwargs = _fused_adam_kwargs(self.optimizer_kwargs)
        super()._build(lr_schedule)

    @property
    def _extractor(self) -> BeliefExtractor:  # type: ignore[override]
        assert isinstance(self.features_extractor, BeliefExtractor)
        return self.features_extractor

    @property
    def online(self) -> OnlineMemory | None:
        """The memory of the rollout under way, if there is one and the belief is online."""
        return self._extractor.online if self.has_belief and isinstance(self._extractor, AdaptiveExtractor) else None

    # -- SB3's passes --------------------------------------------------------------------------------------------------

    def _distributions(self, trusted: bool = True) -> AbstractContextManager[None]:
        """Return the context in which the distributions of a pass are made."""
        return _Unchecked() if trusted and not isinstance(self.action_space, spaces.Box) else nullcontext()

    def extract_features(self, obs: Any, features_extractor: Any = None) -> Any:
        """
        Extract features as SB3 does, with the belief drawn as the :class:`BeliefPass` says that is attached to the
        observations.

        :param obs: Observations; without a pass attached the belief is its mean
        :param features_extractor: As in SB3
        :return: Features and belief
        """
        belief_pass = attached(obs)
        if isinstance(belief_pass, BeliefPass):
            features_extractor = partial(self._extractor, belief_pass=belief_pass)
        return super().extract_features(obs, features_extractor)

    def forward(self, obs: Any, deterministic: bool = False, *args: Any, **kwargs: Any) -> Any:
        """
        Choose actions as SB3 does.

        :param obs: Observations
        :param deterministic: Whether belief and action are their distributions' means or modes instead of samples
        :param args: As in SB3 or sb3-contrib
        :param kwargs: As in SB3 or sb3-contrib
        :return: Actions, values and log probabilities. A :class:`~sb3_belief.belief_ppo.buffers.SampledLatents` is attached to
            the values, for the rollout buffer
        """
        if not self.has_belief:
            with self._distributions(trusted=not deterministic):
                return super().forward(obs, deterministic, *args, **kwargs)
        belief_pass = BeliefPass(sample=not deterministic, acts=True)
        with self._distributions(trusted=not deterministic):
            actions, values, log_prob = super().forward(attach(obs, belief_pass), deterministic, *args, **kwargs)
        output, noise = belief_pass.output, belief_pass.noise
        assert output is not None
        if noise is None:
            noise = th.zeros_like(output.mean if self._extractor.belief.variant.samples else output.mean[:, :0])
        return actions, attach(values, SampledLatents(noise, output.selected)), log_prob

    def _predict(self, observation: Any, deterministic: bool = False, *args: Any, **kwargs: Any) -> th.Tensor:
        if not self.has_belief or deterministic:
            return super()._predict(observation, deterministic, *args, **kwargs)
        # SB3 uses get_distribution() here, which reaches the extractor without a pass: the belief would be its mean
        return super().forward(attach(observation, BeliefPass(sample=True)), deterministic, *args, **kwargs)[0]

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """
        Convert observations as SB3 does, keeping a value that is attached to them (see :meth:`attach_terminal_values`).

        :param observation: As in SB3
        :return: As in SB3
        """
        tensor, vectorized = super().obs_to_tensor(observation)
        value = attached(observation)
        return (tensor if value is None else attach(tensor, value)), vectorized

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Predict values as SB3 does, unless they are known already.

        :param obs: Observations
        :return: Values, ``[B, 1]``
        """
        value = attached(obs)
        if isinstance(value, th.Tensor):
            return value
        # SB3 asks for the values of the observations after a rollout, in all copies
        if self.online is not None and value is None and _n_rows(obs) == len(self.online.stamps()):
            obs = attach(obs, BeliefPass(acts=True))
        if not isinstance(attached(obs), BeliefPass):
            return super().predict_values(obs)
        # As SB3, which passes over the extract_features() of its subclasses here
        features = self.extract_features(obs, self.vf_features_extractor)
        return self.value_net(self.mlp_extractor.forward_critic(features))

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        """
        Evaluate actions as SB3 does. With a :class:`~sb3_belief.belief_ppo.buffers.BeliefMinibatch` attached to the
        observations the belief is that with which the agent acted, and the terms of eq. 8 that train it join the loss:

            ``L = L_PPO + action_coef * action error + kl_coef * KL divergence``

        :param obs: Observations
        :param actions: As in SB3
        :param args: As in SB3 or sb3-contrib
        :param kwargs: As in SB3 or sb3-contrib
        :return: Values, log likelihood and entropy of the actions
        """
        minibatch = attached(obs)
        if not (self.has_belief and isinstance(minibatch, BeliefMinibatch)):
            with self._distributions():
                return super().evaluate_actions(obs, actions, *args, **kwargs)
        belief_pass = BeliefPass(minibatch.noise, minibatch.selected, stamps=minibatch.stamps)
        with self._distributions():
            # What L_PPO is computed from
            values, log_prob, entropy = super().evaluate_actions(attach(obs, belief_pass), actions, *args, **kwargs)
        assert belief_pass.output is not None
        loss = self.belief_loss(belief_pass.output, minibatch)
        # Not where nothing is trained, as in a measurement, which must draw no random number
        if isinstance(self._extractor, AdaptiveExtractor) and self._extractor.replay and th.is_grad_enabled():
            assert loss is not None
            loss = loss + self._replayed_loss(self._extractor)
        targets = getattr(obs, "value_targets", None)
        if self.others_baseline is not None and targets is not None:
            assert loss is not None
            # Its errors count as those of the values do
            details: Any = self
            huber_delta = details.value_options and details.value_options.huber_delta
            error = self.others_baseline.loss(belief_pass.features, minibatch, targets, details.value_unit, huber_delta)
            loss = loss + self.baseline_coef * error
        return values if loss is None else add_loss(values, loss), log_prob, entropy

    def belief_loss(self, belief: BeliefOutput, minibatch: BeliefMinibatch) -> th.Tensor | None:
        """
        Return the terms of eq. 8 that train the belief.

        :param belief: The belief about the minibatch
        :param minibatch: What the others did
        :return: A scalar; None for a belief that predicts nothing
        """
        if belief.prediction is None:
            return None
        loss = self.action_coef * self.predictions_error(belief, minibatch)
        if self._extractor.belief.variant.samples:
            loss = loss + self.kl_coef * kl_divergence(belief.mean, belief.log_std)
        return loss

    def _replayed_loss(self, extractor: AdaptiveExtractor) -> th.Tensor:
        """Return the belief's loss on steps of a past rollout, with the history as it was then."""
        past = extractor.replay[np.random.randint(len(extractor.replay))]
        output = extractor.judged(past.flat, past.minibatch, past.table)
        return self.action_coef * self.predictions_error(output, past.minibatch)

    def predictions_error(self, belief: BeliefOutput, minibatch: BeliefMinibatch) -> th.Tensor:
        """
        Return the mean error of what was predicted of the present step and of those after it.

        :param belief: A belief that predicts
        :param minibatch: What the others did then
        :return: A scalar; :meth:`action_error` for a belief that predicts the present step alone
        """
        assert belief.prediction is not None
        error = self.action_error(belief.prediction, minibatch)
        if belief.later is None or minibatch.later_actions is None or minibatch.later_visible is None:
            return error
        errors = [error]
        for later in range(belief.later.shape[1]):
            then = minibatch._replace(
                others_actions=minibatch.later_actions[:, later], others_visible=minibatch.later_visible[:, later]
            )
            errors.append(self.action_error(belief.later[:, later], then))
        return th.stack(errors).mean()

    def action_error(self, prediction: th.Tensor, minibatch: BeliefMinibatch) -> th.Tensor:
        """
        Return the error of the predicted actions.

        :param prediction: Predicted actions of the others in the minibatch, ``[B, W]``
        :param minibatch: Their actions and visibility
        :return: Eq. 7, or the cross-entropy in its place, a scalar
        """
        loss = ACTION_LOSSES[self.action_loss]
        return loss(prediction, minibatch.others_actions, minibatch.others_visible, self.layout)

    def attach_terminal_values(self, infos: list[dict[str, Any]], dones: np.ndarray) -> None:
        """
        Compute the values from which SB3 bootstraps at time limits, for all copies in one pass.

        SB3 asks for them one copy after the other: in environments whose copies end together that is a tenth of a rollout. The
        values travel with the terminal observations, through :meth:`obs_to_tensor` to :meth:`predict_values`.

        :param infos: One step's `info` of each copy; their terminal observations are replaced by equal ones that carry a value
        :param dones: Which copies ended with this step, bool ``[n_envs]``
        """
        copies = [
            copy
            for copy, (info, done) in enumerate(zip(infos, dones, strict=False))
            if done and info.get("TimeLimit.truncated", False) and info.get("terminal_observation") is not None
        ]
        # For a single one nothing is gained, except that a belief that is online is told of which copy it is
        if len(copies) < (2 if self.online is None else 1):
            return
        ended = [infos[copy] for copy in copies]
        rows = [info["terminal_observation"] for info in ended]
        batch = {key: np.stack([row[key] for row in rows]) for key in rows[0]} if isinstance(rows[0], dict) else np.stack(rows)
        with th.no_grad():
            tensor = self.obs_to_tensor(batch)[0]
            if self.online is not None:
                tensor = attach(tensor, BeliefPass(acts=True, stamps=self.online.stamps()[copies]))
            values = self.predict_values(tensor)
        if self.online is not None:
            self.online.note_bootstraps(copies, values)
        for i, info in enumerate(ended):
            info["terminal_observation"] = attach(rows[i], values[i : i + 1])

    # -- a belief one can look at --------------------------------------------------------------------------------------

    def predict_others(self, observation: np.ndarray | dict[str, np.ndarray]) -> OthersPrediction:
        """
        Return what the agent believes that the others do at an observation now, predicted from the belief's mean.

        :param observation: One observation or a batch of them, as :meth:`predict` takes them
        :return: The others' expected actions, the belief behind them, and the history rows that it comes from
        :raises ValueError: For a policy that predicts nothing
        """
        if not (self.has_belief and self.options.variant.predicts):  # type: ignore[union-attr]
            raise ValueError(
                f"this policy has belief={self.options.belief!r} and {self.layout.n_others} others: it predicts nobody's "
                "actions. A belief that does needs others and one of 'dynamic', 'context', 'variational', 'static' and "
                "'adaptive'."
            )
        self.set_training_mode(False)
        tensor, vectorized = self.obs_to_tensor(observation)
        with th.no_grad():
            output = self._extractor.infer(self.flat_observations(tensor))
            assert output.prediction is not None
            expected = expected_actions(output.prediction, self.layout, self.action_loss)

        def shown(tensor: th.Tensor) -> np.ndarray:
            array = tensor.cpu().numpy()
            return array if vectorized else array[0]

        return OthersPrediction(
            {name: shown(expected[:, self.layout.columns_of(i)]) for i, name in enumerate(self.others_action_spaces)},
            shown(output.mean),
            shown(output.log_std.exp()),
            shown(output.selected),
            shown(output.weights),
        )


class BeliefActorCriticPolicy(DetailsPolicyMixin, BeliefPolicyMixin, ActorCriticPolicy):
    """
    SB3's ``ActorCriticPolicy`` with a belief; takes all of its arguments and those of :class:`BeliefPolicyMixin`. Its features
    extractor is the one that SB3's own policies have for the observation space: for vectors, images (at least 36x36), Dicts.
    """


class BeliefMlpPolicy(BeliefActorCriticPolicy):
    """A policy with a belief for vectors; images are flattened."""

    default_extractor = FlattenExtractor


class BeliefCnnPolicy(BeliefActorCriticPolicy):
    """A policy with a belief for images."""

    default_extractor = NatureCNN


class BeliefMultiInputPolicy(BeliefActorCriticPolicy):
    """A policy with a belief for Dict observations."""

    default_extractor = CombinedExtractor
