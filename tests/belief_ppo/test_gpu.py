"""The belief on a GPU: trained and saved there, loaded on a CPU, it believes and does the same."""

from typing import Any

import numpy as np
import pytest
import torch as th

from tests.belief_ppo.helpers import EVERY, ROLLOUT, make_model, observations_of

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU that torch.cuda can use")


@pytest.mark.parametrize("algorithm, belief", EVERY)
def test_trained_on_a_gpu_and_loaded_on_a_cpu_it_is_the_same(tmp_path, belief, algorithm):
    model = make_model(algorithm=algorithm, belief=belief, env_kwargs=dict(inactive=5), device="cuda").learn(4 * ROLLOUT)
    assert {tensor.device.type for tensor in model.policy.state_dict().values()} == {"cuda"}
    if belief != "none":
        assert model.logger.name_to_value["belief/first_log_ratio"] < 1e-5
    model.save(tmp_path / "agent")
    loaded: Any = algorithm.load(tmp_path / "agent", device="cpu")
    assert {tensor.device.type for tensor in loaded.policy.state_dict().values()} == {"cpu"}
    obs = observations_of(model, 200)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    values = [m.policy.predict_values(th.as_tensor(obs, device=m.device)).detach().cpu() for m in (model, loaded)]
    th.testing.assert_close(*values, atol=1e-5, rtol=1e-5)
    if belief not in ("none", "wide"):
        on_gpu, on_cpu = model.policy.predict_others(obs), loaded.policy.predict_others(obs)
        for name in ("b", "c"):
            np.testing.assert_allclose(on_gpu.actions[name], on_cpu.actions[name], atol=1e-5)
        np.testing.assert_allclose(on_gpu.mean, on_cpu.mean, atol=1e-5)
        np.testing.assert_allclose(on_gpu.std, on_cpu.std, atol=1e-5)
        np.testing.assert_allclose(np.sort(on_gpu.weights), np.sort(on_cpu.weights), atol=1e-5)
    # And there and back again it goes on learning
    loaded.set_env(model.get_env())
    loaded.learn(ROLLOUT).save(tmp_path / "again")
    algorithm.load(tmp_path / "again", env=model.get_env(), device="cuda").learn(ROLLOUT)
