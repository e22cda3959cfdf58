"""Time limits are bootstrapped with what SB3 would compute, in fewer passes."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.belief_ppo.buffers import attached
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
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
    with monkeypatch.context() as patch:
        patch.setattr(BeliefPolicyMixin, "attach_terminal_values", lambda *args: None)
        expected, one_by_one, passes_one_by_one = learned(observation_space, algorithm, belief)
    # Convolutions round a batch in another way, of which Adam makes up to whole steps
    of_images = len(observation_space.shape or ()) == 3
    np.testing.assert_allclose(rewards, one_by_one, atol=1e-5, rtol=5e-3 if of_images else 1e-4)
    atol = 2e-3 if of_images else 1e-5
    for name, value in expected.policy.named_parameters():
        th.testing.assert_close(dict(model.policy.named_parameters())[name], value, atol=atol, rtol=1e-4)
    # five ends of all copies in 28 steps, each in one pass instead of four
    assert passes_one_by_one - passes == 5 * (N_ENVS - 1)


def test_values_travel_with_their_own_observations():
    model, _, _ = learned(OBSERVATIONS[0])
    policy = model.policy
    rows = np.random.default_rng(0).uniform(-1, 1, (3, 5)).astype(np.float32)

    def carried(ended, **changes):
        infos = [{"terminal_observation": row, "TimeLimit.truncated": True} for row in rows]
        infos[2].update(changes)
        policy.attach_terminal_values(infos, np.array(ended))
        observations = [info["terminal_observation"] for info in infos]
        assert all(after is None or np.array_equal(after, row) for after, row in zip(observations, rows, strict=True))
        return [attached(observation) is not None for observation in observations]

    assert carried([True, False, True]) == [True, False, True]
    assert carried([True, False, False]) == [False, False, False]  # nothing is gained for a single one
    assert carried([True, True, True], **{"TimeLimit.truncated": False}) == [True, True, False]
    assert carried([True, True, True], terminal_observation=None) == [True, True, False]

    infos = [{"terminal_observation": row, "TimeLimit.truncated": True} for row in rows]
    policy.attach_terminal_values(infos, np.ones(3, dtype=bool))
    for i in (2, 0, 1):
        tensor = policy.obs_to_tensor(infos[i]["terminal_observation"])[0]
        th.testing.assert_close(policy.predict_values(tensor), policy.predict_values(th.as_tensor(rows[i : i + 1])))
        # Whatever is computed from the observation is computed anew
        assert attached(tensor + 0) is None and attached(infos[i]["terminal_observation"] + 0) is None
