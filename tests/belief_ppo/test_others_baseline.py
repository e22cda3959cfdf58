"""The baseline that sees what the others did: its policy gradient is the plain one in expectation, with less variance."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief.memory import followed_by, valid_rows
from sb3_belief.belief_ppo import BeliefPPO
from sb3_belief.belief_ppo.buffers import attach
from sb3_belief.belief_ppo.others_baseline import OthersBaseline, take_off
from sb3_belief.belief_ppo.value_loss import ValueTargets
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, Watch, make_model

# What the agent gets by its own action and the other's, who matters more
PAYOFF = np.array([[0.0, 10.0, -10.0], [1.0, 11.0, -7.0]], dtype=np.float32)
N_ENVS, N_STEPS = 6, 16


class Lottery(gym.Env):
    """One-step game in which the other plays at random: the agent sees what it did, but cannot foresee it."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self) -> None:
        self.others_action_spaces = {"b": spaces.Discrete(3)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action: Any) -> Any:
        other = int(self.np_random.integers(3))
        info = {"others_actions": np.eye(3, dtype=np.float32)[other], "others_visible": np.array([True])}
        return np.zeros(2, dtype=np.float32), float(PAYOFF[action, other]), True, False, info


def lottery(n_rollouts: int, **kwargs: Any) -> BeliefPPO:
    env = make_vec_env(Lottery, n_envs=N_ENVS, seed=0)
    # With so much entropy the policy stays random, and its gradient large
    given: dict[str, Any] = dict(n_steps=N_STEPS, batch_size=32, n_epochs=10, learning_rate=1e-2, ent_coef=1.0, seed=0)
    given.update(history_length=20, action_loss="cross_entropy", **kwargs)
    model = BeliefPPO("BeliefPolicy", env, belief="adaptive", **given)
    return model.learn(n_rollouts * N_ENVS * N_STEPS)


def test_the_gradient_stays_what_it_is_with_less_variance():
    """Exactly, over both actions of the agent at each step of a rollout, whose others have played as they have."""
    model: Any = lottery(12, critic_sees_others=True)
    compared = []

    def look(model):
        policy, buffer = model.policy, model.rollout_buffer
        policy.features_extractor.table = followed_by(valid_rows(policy.history), model.remembered(0, N_STEPS))
        rows = buffer.rows_of(np.arange(N_ENVS * N_STEPS))
        played = buffer.others_actions[rows].argmax(axis=1)
        advantages = [PAYOFF[own, played] - buffer.values[rows] for own in (0, 1)]
        corrected = []
        for given in advantages:
            buffer.advantages[rows] = given
            take_off(policy.others_baseline, policy, buffer)
            corrected.append(buffer.advantages[rows].copy())
        # What is taken off is the same whatever the agent did itself, and differs with what the other did
        taken = advantages[0] - corrected[0]
        np.testing.assert_allclose(taken, advantages[1] - corrected[1], atol=1e-5)
        assert taken[played == 1].mean() - taken[played == 2].mean() > 10
        moments = []
        for given in (advantages, corrected):
            mean, square = [th.zeros_like(p) for p in policy.action_net.parameters()], 0.0
            for row in range(0, len(played), 3):
                one = rows[0][row : row + 1], rows[1][row : row + 1]
                observed = attach(th.as_tensor(buffer.observations[one]), buffer.belief_minibatch(one))
                for own in (0, 1):
                    _, log_prob, _ = policy.evaluate_actions(observed, th.tensor([own]))
                    gradient = th.autograd.grad(log_prob.sum(), list(policy.action_net.parameters()))
                    weight = float(log_prob.detach().exp())
                    for total, part in zip(mean, gradient, strict=True):
                        total += weight * float(given[own][row]) * part
                    square += weight * float(given[own][row]) ** 2 * sum(float(part.square().sum()) for part in gradient)
            moments.append((mean, square))
        compared.append(moments)
        policy.features_extractor.table = None

    model.learn(N_ENVS * N_STEPS, callback=Watch(look), reset_num_timesteps=False)
    [(plain, seeing)] = compared
    for a, b in zip(plain[0], seeing[0], strict=True):
        th.testing.assert_close(a, b, atol=1e-4 * float(a.abs().max()), rtol=1e-4)
    assert seeing[1] < 0.2 * plain[1]


def test_what_is_logged():
    """It begins at zero, and has learned what the other is worth after a few rollouts."""
    ratios: list[float] = []
    model: Any = lottery(0, critic_sees_others=True)
    model.learn(
        12 * N_ENVS * N_STEPS, callback=Watch(lambda m: ratios.append(m.logger.name_to_value["belief/advantage_variance"]))
    )
    # At the end of a rollout the log holds what the update before has written
    assert ratios[1] == 1.0 and ratios[-1] < 0.2


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_nothing_else_is_trained_by_it(algorithm):
    """In the first update, whose advantages are the plain ones, all other weights learn what they learn without it."""
    whole: dict[str, Any] = dict(belief="adaptive", n_epochs=1, batch_size=ROLLOUT, max_grad_norm=1e9)
    env_kwargs = dict(inactive=3)
    with_it, without = (
        make_model(algorithm=algorithm, env_kwargs=env_kwargs, critic_sees_others=sees, **whole).learn(ROLLOUT)
        for sees in (True, False)
    )
    plain = without.policy.state_dict()
    seeing = with_it.policy.state_dict()
    own = {name for name in seeing if name.startswith("others_baseline")}
    assert seeing.keys() - plain.keys() == own and len(own) == 4
    for name, weights in plain.items():
        assert th.equal(weights, seeing[name]), name
    assert seeing["others_baseline.layers.2.weight"].abs().max() > 0


@pytest.mark.parametrize("huber_delta, expected", [(None, (4.0 + 1.0) / 2), (1.0, (1.5 + 0.5) / 2)])
def test_its_errors_count_as_those_of_the_values(huber_delta, expected):
    """In units of 10, in which the layers predict as well."""
    baseline = OthersBaseline(2, 1, "cpu")
    th.nn.init.constant_(baseline.layers[2].bias, 3.0)  # type: ignore[arg-type]
    minibatch: Any = SimpleNamespace(seen_at_once=th.zeros(2, 1))
    targets = ValueTargets(th.tensor([60.0, 30.0]), th.tensor([10.0, -10.0]))
    assert baseline(th.zeros(2, 2), minibatch.seen_at_once, 10.0).tolist() == [30.0, 30.0]
    # Advantages of 50 and 40
    assert baseline.loss(th.zeros(2, 2), minibatch, targets, 10.0, huber_delta).item() == pytest.approx(expected)


def test_with_the_options_of_the_value():
    model = make_model(belief="adaptive", critic_sees_others=True, value_norm=True, huber_delta=10.0)
    units: list[Any] = []
    loss = model.policy.others_baseline.loss

    def spied(*args: Any) -> Any:
        units.append((float(args[3]), args[4]))
        return loss(*args)

    model.policy.others_baseline.loss = spied
    model.learn(3 * ROLLOUT)
    assert model.policy.others_baseline.layers[2].weight.abs().max() > 0
    assert (float(model.policy.value_unit), 10.0) in units and (1.0, 10.0) not in units
    assert not model.rollout_buffer.shows_targets
