"""Agents that learn in other processes: who does, and that whoever looks at them sees what they are."""

import os
import warnings
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)

from sb3_belief import BeliefPPO
from sb3_belief.team.own_code import find_own_callback
from sb3_belief.team.parallel import workers
from tests.team.helpers import Record, Team, make_team_env, parameters
from tests.team.parallel.test_jobs import (
    EASY,
    PPO_SMALL,
    Draws,
    OwnNetwork,
    Pushes,
    everything,
    flat,
    no_processes_stay,
    notes,
    toy_team,
)
from tests.team.toy_envs import ToyEnv, ToySolo


class Notes(PPO):
    """Notes in which processes it collects its rollouts and is updated."""

    def __init__(self, *args, **kwargs):
        self.acted_in: set[int] = set()
        self.trained_in: set[int] = set()
        super().__init__(*args, **kwargs)

    def collect_rollouts(self, *args, **kwargs):
        self.acted_in.add(os.getpid())
        return super().collect_rollouts(*args, **kwargs)

    def train(self):
        self.trained_in.add(os.getpid())
        super().train()


class Disturbs(BaseCallback):
    """A team's callback that changes an agent within rollouts."""

    model: Any

    def _on_step(self):
        with th.no_grad():
            if self.n_calls % 7 == 0:
                # Written to, and replaced
                next(self.model.agents["agent_0"].policy.parameters()).mul_(1.01)
                policy = self.model.agents["agent_0"].policy.action_net
                policy.bias = th.nn.Parameter(policy.bias + 0.1)
                self.model.agents["agent_0"].ent_coef += 0.01
        return True


def hook(module, inputs, outputs):
    return 1.1 * outputs


def with_hook(team):
    team.agents["agent_0"].policy.action_net.register_forward_hook(hook)


def with_own_method(team):
    team.agents["agent_0"].policy.predict_values = team.agents["agent_0"].policy.predict_values


# Arguments of the team, callbacks of learn() by a folder to write to, what else is done, and whether the first agent learns
# elsewhere
WHO: dict[str, tuple[dict[str, Any], dict[str, Any], Any, bool]] = {
    "nobody looks": ({}, {}, None, True),
    "SB3 looks": ({}, {"callback": lambda path: CheckpointCallback(4, path)}, None, True),
    "somebody looks": ({}, {"callback": lambda _: Record()}, None, False),
    "a function looks": ({}, {"callback": lambda _: lambda *_: True}, None, False),
    "its own callback looks": ({}, {"agent_callbacks": lambda _: {"agent_0": Record()}}, None, False),
    "another's callback looks": ({}, {"agent_callbacks": lambda _: {"agent_1": Record()}}, None, True),
    "somebody writes": ({}, {"callback": lambda _: Disturbs()}, None, False),
    "noise of a rollout": ({"policy_kwargs": {"log_std_init": -1.0}, "use_sde": True, "env_id": Pushes}, {}, None, True),
    "own networks": ({"policy_kwargs": {"features_extractor_class": OwnNetwork}}, {}, None, True),
    "hooks": ({}, {}, with_hook, False),
    "own methods": ({}, {}, with_own_method, False),
}


@pytest.mark.filterwarnings("ignore:All agents learn in one process")
@pytest.mark.parametrize("case", WHO)
def test_who_learns_elsewhere(case, tmp_path):
    kwargs, learn_kwargs, prepare, is_away = WHO[case]
    results = []
    for jobs in (1, 2):
        team = toy_team(**{"algo": Notes, "jobs": jobs, "n_steps": 8, "batch_size": 8, "n_epochs": 1, **kwargs})
        if prepare is not None:
            prepare(team)
        for n_rollouts in (3, 2):
            callbacks = {key: make(str(tmp_path)) for key, make in learn_kwargs.items()}
            team.learn(16 * n_rollouts, **callbacks, reset_num_timesteps=False)
        first, second = team.agents.values()
        assert (first.acted_in != {os.getpid()}) == (jobs == 2 and is_away)
        assert first.trained_in == first.acted_in
        assert second.acted_in == second.trained_in == {os.getpid()}
        del first.acted_in, first.trained_in, second.acted_in, second.trained_in
        results.append(everything(team, {} if is_away else {"agent_0": Draws()}))
        assert all("forward" not in vars(model.policy) for model in team.agents.values())
    assert results[0] == results[1]


@pytest.mark.parametrize("jobs, warned", [(1, 0), (2, 2)])
def test_a_callback_that_keeps_all_agents_here_is_warned_of(jobs, warned):
    team = toy_team(PPO, jobs, **PPO_SMALL)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            team.learn(16, callback=Record())
        team.learn(16, callback=StopTrainingOnMaxEpisodes(100), agent_callbacks={"agent_0": Record()})
    messages = [str(w.message) for w in caught if "one process" in str(w.message)]
    assert len(messages) == warned
    assert all("although jobs=2" in m and "callback Record" in m and "use jobs=1" in m for m in messages)


class Own(EvalCallback):
    """One's own, although derived from SB3's."""


@pytest.mark.parametrize(
    ("callback", "expected"),
    [
        (None, True),
        (ConvertCallback(None), True),
        (ConvertCallback(lambda *_: True), False),
        (CallbackList([CheckpointCallback(1, "x"), StopTrainingOnMaxEpisodes(3)]), True),
        (CallbackList([CheckpointCallback(1, "x"), Record()]), False),
        (EveryNTimesteps(3, Record()), False),
        (EveryNTimesteps(3, CallbackList([StopTrainingOnMaxEpisodes(3)])), True),
        (EvalCallback(ToySolo(), callback_after_eval=StopTrainingOnNoModelImprovement(1)), True),
        (EvalCallback(ToySolo(), callback_after_eval=Record()), False),
        (EvalCallback(ToySolo(), callback_on_new_best=Record()), False),
        (Own(ToySolo()), False),
    ],
)
@pytest.mark.filterwarnings("ignore:Training and eval env")
def test_which_callbacks_leave_models_alone(callback, expected):
    assert (find_own_callback(callback) is None) == expected


LOOKED_AT: dict[str, tuple[Any, dict[str, Any]]] = {
    "ppo": (PPO, {**PPO_SMALL, "normalize": True}),
    "recurrent": (RecurrentPPO, {**PPO_SMALL, "policy": "MlpLstmPolicy"}),
    "masks": (MaskablePPO, {**PPO_SMALL, "env_id": EASY}),
    "belief": (
        BeliefPPO,
        {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "policy": "BeliefPolicy", "env_id": EASY, "history_length": 30},
    ),
}


@pytest.mark.parametrize("case", LOOKED_AT)
def test_who_looks_sees_what_they_are(case, tmp_path):
    algo, kwargs = LOOKED_AT[case]
    found = []
    for jobs in (1, 2):
        folder = tmp_path / str(jobs)
        team = toy_team(algo, jobs, **kwargs)
        # Within rollouts, at their ends, and in all parts of a model's life
        callbacks: list[BaseCallback] = [CheckpointCallback(3, str(folder), name_prefix="team")]
        if case != "masks":
            eval_env = make_team_env(kwargs.get("env_id", ToyEnv), n_envs=2, seed=0)
            callbacks.append(EvalCallback(eval_env, None, None, 2, 5, str(folder), deterministic=False, verbose=0))
        team.learn(60, callback=callbacks)
        saved = {}
        for path in sorted(folder.glob("*.zip")):
            loaded = Team.load(path)
            for agent, model in loaded.agents.items():
                names = ("num_timesteps", "_n_updates", "_last_obs", "_last_episode_starts", "_current_progress_remaining")
                counts = {name: vars(model)[name] for name in names}
                statistics = loaded._agents.statistics.get(agent)
                saved[path.name, agent] = flat(
                    {
                        **counts,
                        "weights": parameters(model),
                        "optimizer": model.policy.optimizer.state_dict(),
                        "statistics": None if statistics is None else [statistics.obs_rms.mean, statistics.ret_rms.var],
                    }
                )
        evaluated = [dict(np.load(path)) for path in folder.glob("evaluations.npz")]
        found.append([saved, flat(evaluated), everything(team, {})])
    assert len(found[0][0]) >= 10 * len(team.agents)
    assert len({value["num_timesteps"] for value in found[0][0].values()}) >= 10
    assert found[0] == found[1]


def test_a_callback_of_sb3_stops_all_after_the_same_step():
    results = []
    for jobs in (1, 2):
        team = toy_team(PPO, jobs, **PPO_SMALL)
        team.learn(1000, callback=StopTrainingOnMaxEpisodes(5))
        assert team.num_timesteps == 2 * 7 * 5
        results.append(everything(team, {}))
        team.learn(16)
        results[-1] = [results[-1], everything(team, {})]
    assert results[0] == results[1]


class Flips(PPO):
    """Half of the time it is as it was at the beginning."""

    def __init__(self, *args, **kwargs):
        self.flips = 0
        super().__init__(*args, **kwargs)

    def train(self):
        super().train()
        self.flips = 1 - self.flips


def test_what_has_become_as_it_was_is_seen_to_be_so(tmp_path):
    # Looked at after one update and after two
    callback = CheckpointCallback(8, str(tmp_path), name_prefix="team")
    team = toy_team(Flips, 2, **PPO_SMALL).learn(4 * 16, callback=callback)
    saved = [Team.load(path, allow_packages=["tests"]) for path in sorted(tmp_path.iterdir())]
    assert [each.agents["agent_0"].flips for each in saved] == [0, 1, 0, 1]
    assert [model.flips for model in team.agents.values()] == [0, 0]
    team.learn(16)
    assert [model.flips for model in team.agents.values()] == [1, 1]


class Breaks(ToyEnv):
    """An environment that fails in the third rollout."""

    n_steps = 0

    def step(self, actions):
        self.n_steps += 1
        if self.n_steps == 20:
            raise ZeroDivisionError("by hand")
        return super().step(actions)


class FailsLater(PPO):
    """Its policy cannot act any more after the first update."""

    policy: Any

    def train(self):
        super().train()
        self.policy.action_dist = None


class FailsToCount(PPO):
    """It fails while it counts a step."""

    def _update_info_buffer(self, infos, dones=None):
        super()._update_info_buffer(infos, dones)
        if self.num_timesteps == 24:
            raise ZeroDivisionError("by hand")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("algo", "env", "error", "said", "agent"),
    [
        (PPO, Breaks, ZeroDivisionError, "joint step 20 ", ""),
        (FailsLater, ToyEnv, ValueError, "joint step 8 ", "agent 'agent_0'"),
        (FailsToCount, ToyEnv, ZeroDivisionError, "joint step 12 ", "agent 'agent_0'"),
    ],
)
@pytest.mark.parametrize("callback", [None, lambda: StopTrainingOnMaxEpisodes(100)])
def test_models_keep_what_they_have_learned_before_an_error(algo, env, error, said, agent, callback):
    results = []
    for jobs in (1, 2):
        team = toy_team({"agent_0": algo, "agent_1": PPO}, jobs, env, **PPO_SMALL)
        before = parameters(team.agents["agent_0"])
        with pytest.raises(error) as caught:
            team.learn(64, callback=None if callback is None else callback())
        assert said in notes(caught.value) and agent in notes(caught.value)
        assert jobs == 1 or no_processes_stay()
        model = team.agents["agent_0"]
        assert not th.equal(before, parameters(model))
        results.append(flat([parameters(model), model.num_timesteps, model._n_updates, model.policy.optimizer.state_dict()]))
    assert results[0] == results[1]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("way", ["receive", "send"])
def test_ctrl_c_within_a_message(way, monkeypatch):
    """What comes after half a message cannot be read."""
    calls, whole = [], getattr(workers, way)

    def half(connection, *args):
        calls.append(way)
        if len(calls) == 14:
            connection.send_bytes(b"half") if way == "send" else connection.recv_bytes()
            raise KeyboardInterrupt
        return whole(connection, *args)

    team = toy_team(PPO, 2, **PPO_SMALL)
    before = parameters(team.agents["agent_0"])
    monkeypatch.setattr(workers, way, half)
    with pytest.raises(KeyboardInterrupt):
        team.learn(64)
    assert len(calls) >= 14 and no_processes_stay()
    # What was in that process is lost, what was here is not, and the team can go on
    assert th.equal(before, parameters(team.agents["agent_0"])) and team.agents["agent_1"].num_timesteps > 16
    monkeypatch.undo()
    assert not th.equal(before, parameters(team.learn(16).agents["agent_0"]))
