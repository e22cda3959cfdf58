"""Time limits are bootstrapped with what SB3 would compute, in fewer passes."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo.terminal_values import TerminalValues
from tests.belief_ppo.helpers import SMALL
from tests.belief_ppo.toy_envs import AmongOthers, MaskedAmongOthers

N_ENVS, LENGTH = 4, 5
OBSERVATIONS: list[spaces.Space] = [
    spaces.Box(-1, 1, (5,), np.float32),
    spaces.Discrete(6),
    spaces.MultiBinary(3),
    spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)}),
    spaces.Box(0, 255, (36, 36, 3), np.uint8),
]


def learned(observation_space, algorithm=BeliefPPO, belief="dynamic"):
    """A model after two rollouts in which all copies end together, its rewards, and how often its values were asked for."""
    masked = algorithm is MaskableBeliefPPO
    kwargs = dict(episode_length=LENGTH, observation_space=observation_space)
    env = make_vec_env(MaskedAmongOthers if masked else AmongOthers, n_envs=N_ENVS, seed=0, env_kwargs=kwargs)
    model = algorithm("BeliefPolicy", env, belief=belief, **SMALL)
    passes: list[int] = []
    model.policy.value_net.register_forward_hook(lambda *args: passes.append(1))
    model.learn(2 * N_ENVS * SMALL["n_steps"])
    return model, model.rollout_buffer.rewards.copy(), len(passes)


@pytest.mark.parametrize("observation_space", OBSERVATIONS, ids=str)
@pytest.mark.parametrize("algorithm, belief", [(BeliefPPO, "dynamic"), (BeliefPPO, "none"), (MaskableBeliefPPO, "static")])
def test_the_values_are_those_of_one_at_a_time(observation_space, algorithm, belief, monkeypatch):
    model, rewards, passes = learned(observation_space, algorithm, belief)
    assert not model.policy.terminal_values._waiting
    with monkeypatch.context() as patch:
        patch.setattr(TerminalValues, "compute", lambda *args: None)
        expected, one_by_one, passes_one_by_one = learned(observation_space, algorithm, belief)
    np.testing.assert_allclose(rewards, one_by_one, atol=1e-5)
    for name, value in expected.policy.named_parameters():
        th.testing.assert_close(dict(model.policy.named_parameters())[name], value, atol=1e-5, rtol=1e-4)
    # five ends of all copies in 28 steps, each in one pass instead of four
    assert passes_one_by_one - passes == 5 * (N_ENVS - 1)


def test_only_the_next_observation_is_answered():
    model, _, _ = learned(OBSERVATIONS[0])
    values = model.policy.terminal_values
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (3, 5)).astype(np.float32)
    infos = [{"terminal_observation": row, "TimeLimit.truncated": True} for row in rows]

    def compute(ended):
        values.compute(model.policy, infos, np.array(ended))

    def ask(row):
        return values.take(th.as_tensor(row[None]))

    compute([True, False, True])
    value = ask(rows[0])
    th.testing.assert_close(value, model.policy.predict_values(th.as_tensor(rows[:1])))
    assert ask(rows[1]) is None and ask(rows[2]) is None  # out of order: all are forgotten
    compute([True, False, False])
    assert ask(rows[0]) is None  # one alone is not worth it
    infos[2]["TimeLimit.truncated"] = False
    compute([True, True, True])
    assert ask(rows[0]) is not None and ask(rows[1]) is not None and ask(rows[2]) is None
    infos[1]["terminal_observation"] = None
    compute([True, True, True])
    assert ask(rows[0]) is None
