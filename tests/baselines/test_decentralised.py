"""Decentralised means decentralised: agents of every such algorithm share nothing, and the global state is not in them."""

import gc
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_belief.team.sb3_protocol import algorithm_arguments
from sb3_belief.zoo.names import ALGOS
from tests.references.test_mappo import Stateful
from tests.team.helpers import Team, make_team_env, parameters

#: Those that learn from what an agent itself sees
DECENTRALISED = [name for name, algo in ALGOS.items() if not algo.adapter]
SMALL: dict[str, Any] = dict(
    n_steps=8, batch_size=8, n_epochs=1, learning_starts=8, buffer_size=64, train_freq=1, history_length=20, device="cpu"
)
_SEEDED = (np.random.Generator, np.random.RandomState, th.Generator)


class Numbers(Stateful):
    """Its actions are numbers."""

    def action_space(self, agent):
        return spaces.Box(-1, 1, (1,), np.float32)

    def step(self, actions):
        return super().step({agent: 1 + np.clip(action, -1, 1).item() for agent, action in actions.items()})


class Masked(Stateful):
    """Each agent may do two of its three actions."""

    def infos(self):
        return {agent: {"action_mask": np.array([True, True, False])} for agent in self.agents}


def make_team(name: str, normalize: Any = False, **env_kwargs: Any) -> Any:
    algo = ALGOS[name]
    algo_class = algo.load()
    env_class = Numbers if name in ("ddpg", "td3", "sac", "tqc", "crossq") else Masked if "maskable" in name else Stateful
    kwargs = {key: value for key, value in {**SMALL, **algo.fixed}.items() if key in algorithm_arguments(algo_class)}
    if name == "rode":
        kwargs["policy_kwargs"] = {"n_roles": 2}
    # SB3's classes have several policies, a joint learner the one of its own
    aliases = algo_class.policy_aliases
    policy = next((alias for alias in ("MlpPolicy", "MlpLstmPolicy") if alias in aliases), next(iter(aliases)))
    # The one that reads windows of observations
    windows = {"observe_window": 3} if name == "drpiqn" else {}
    env = make_team_env(lambda: env_class(**env_kwargs), n_envs=2, seed=0, **windows)
    adapter = algo.load_adapter()
    return Team(algo_class, policy, adapter(env) if adapter else env, seed=0, normalize=normalize, **kwargs)


def parts_of(*roots: Any) -> dict[tuple[str, int], str]:
    """
    All that an agent is made of and that could be shared: tensors (by the memory they lie in), optimisers, buffers,
    normalisers and random generators, with where each was found. The environment is the team's, and the logger its own files.
    """
    found: dict[tuple[str, int], str] = {}
    seen: set[int] = set()
    # Objects that are made while walking must not take the place of one that has been seen
    kept = []

    def visit(value: Any, path: str) -> None:
        if id(value) in seen or isinstance(value, (str, bytes, int, float, bool, type(None), type, VecEnv, Logger)):
            if not isinstance(value, VecNormalize) or id(value) in seen:
                return
        seen.add(id(value))
        kept.append(value)
        if isinstance(value, th.Tensor):
            if value.numel():
                found["memory", value.untyped_storage().data_ptr()] = path
            return
        if isinstance(value, (th.optim.Optimizer, BaseBuffer, RunningMeanStd, VecNormalize, *_SEEDED)):
            found["object", id(value)] = path
        if isinstance(value, dict):
            children = list(value.items())
        elif isinstance(value, (list, tuple, set, frozenset)) or type(value).__name__ == "deque":
            children = list(enumerate(value))
        elif isinstance(value, np.ndarray):
            # Large ones are rows of a rollout or a replay
            children = []
            if value.size and (value.base is None or isinstance(value.base, np.ndarray)):
                found["memory", value.__array_interface__["data"][0]] = path
        elif type(value).__module__.partition(".")[0] in ("sb3_belief", "stable_baselines3", "sb3_contrib", "torch", "tests"):
            children = list(getattr(value, "__dict__", {}).items())
        else:
            children = list(getattr(value, "__dict__", {}).items()) if isinstance(value, spaces.Space) else []
        for key, child in children:
            if key not in ("venv", "env", "_vec_normalize_env", "_custom_logger"):
                visit(child, f"{path}.{key}")

    for number, root in enumerate(roots):
        visit(root, str(number))
    return found


@pytest.mark.parametrize("name", DECENTRALISED)
def test_agents_share_no_tensor_optimiser_buffer_normaliser_or_generator(name):
    team = make_team(name, normalize=True)
    team.learn(32)
    gc.collect()
    agents = team._agents
    found = {agent: parts_of(model, agents.statistics[agent], agents.rngs[agent]) for agent, model in team.agents.items()}
    one, other = found.values()
    shared = {one[key]: other[key] for key in one.keys() & other.keys()}
    assert shared == {}
    kinds = [path for path in one.values() if "policy" in path]
    assert len(kinds) > 4, "the walk has found no weights"
    assert any("buffer" in path for path in one.values())
    assert any("obs_rms" in path for path in one.values())


@pytest.mark.parametrize("name", DECENTRALISED)
def test_nothing_in_them_depends_on_the_global_state(name):
    learned = []
    for scale in (0.0, 5.0):
        team = make_team(name, scale=scale)
        # Somebody else asks for the states, so that the environment tells them at its ends
        team.get_env().reset()
        assert np.isin(team.get_env().states(), (0.0,)).all()
        learned.append(team.learn(32))
    for agent, model in learned[0].agents.items():
        assert th.equal(parameters(model), parameters(learned[1].agents[agent]))
        buffers: list[Any] = [getattr(team.agents[agent], "replay_buffer", None) for team in learned]
        if buffers[0] is not None:
            assert np.array_equal(buffers[0].observations, buffers[1].observations)


def test_the_walk_finds_what_is_shared():
    team = make_team("ippo")
    one, other = team.agents.values()
    other.policy.value_net.weight = one.policy.value_net.weight
    other.rollout_buffer = one.rollout_buffer
    shared = parts_of(one).keys() & parts_of(other).keys()
    assert len(shared) > 2
