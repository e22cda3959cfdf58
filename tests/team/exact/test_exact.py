"""A training that is saved, loaded and goes on equals one that nobody disturbed, bit for bit."""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import QRDQN, TQC, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.baselines import DPIQN, IQL
from tests.team.helpers import PPO_KWARGS, Team, make_team_env
from tests.team.toy_envs import MixedEnv, ScriptedEnv, ToyEnv

EASY, SWAP = "traffic-junction-easy", "convention-swap"
BELIEF = {**PPO_KWARGS, "history_length": 50}
OFF: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 60,
    "batch_size": 8,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


class SaveOnce(BaseCallback):
    """
    Callback that saves the exact state at the first rollout that begins at a step or later, and draws at each step.

    :param at: The step
    """

    model: Any

    def __init__(self, at: int | None = None):
        super().__init__()
        self.at, self.saved, self.drawn = at, b"", 0.0

    def state_dict(self):
        return {"drawn": self.drawn}

    def load_state_dict(self, state):
        self.drawn = state["drawn"]

    def _on_rollout_start(self):
        if self.at is not None and not self.saved and self.model.num_timesteps >= self.at:
            file = io.BytesIO()
            self.model.save(file, exact=True)
            self.saved = file.getvalue()

    def _on_step(self):
        self.drawn += float(np.random.normal())
        return True


def pushes():
    from mpe2 import simple_spread_v3

    return simple_spread_v3.parallel_env(continuous_actions=True, max_cycles=7)


def noise():
    return OrnsteinUhlenbeckActionNoise(np.zeros(5, np.float32), 0.1 * np.ones(5, np.float32))


CASES: dict[str, tuple[Any, str, Any, dict[str, Any]]] = {
    "belief": (BeliefPPO, "BeliefPolicy", EASY, BELIEF),
    "belief, normalised": (BeliefPPO, "BeliefPolicy", "mpe/simple_spread_v3", {**BELIEF, "normalize": True}),
    "belief and masks": (MaskableBeliefPPO, "BeliefPolicy", EASY, BELIEF),
    "scripted others": (BeliefPPO, "BeliefPolicy", ScriptedEnv, BELIEF),
    "who leaves early": (BeliefPPO, "BeliefPolicy", MixedEnv, BELIEF),
    "lbf": (BeliefPPO, "BeliefPolicy", "lbf/Foraging-2s-5x5-2p-1f-coop-v3", BELIEF),
    "convention": (BeliefPPO, "BeliefPolicy", SWAP, BELIEF),
    "a2c": (A2C, "MlpPolicy", ToyEnv, {"n_steps": 8, "device": "cpu"}),
    "noise of a rollout": (PPO, "MlpPolicy", pushes, {**PPO_KWARGS, "use_sde": True, "sde_sample_freq": 5}),
    "schedules": (PPO, "MlpPolicy", ToyEnv, {**PPO_KWARGS, "learning_rate": lambda left: 1e-3 * left}),
    "maskable": (MaskablePPO, "MlpPolicy", EASY, PPO_KWARGS),
    "recurrent": (RecurrentPPO, "MlpLstmPolicy", ToyEnv, {**PPO_KWARGS, "normalize": True}),
    "dqn": (DQN, "MlpPolicy", ToyEnv, {**OFF, "target_update_interval": 30, "normalize": True, "exploration_fraction": 0.9}),
    "iql": (IQL, "MlpPolicy", EASY, {**OFF, "exploration_steps": 60}),
    "dpiqn": (DPIQN, "MlpPolicy", EASY, OFF),
    "qrdqn": (QRDQN, "MlpPolicy", ToyEnv, OFF),
    "sac": (SAC, "MlpPolicy", pushes, {**OFF, "use_sde": True}),
    "td3": (TD3, "MlpPolicy", pushes, {**OFF, "action_noise": noise()}),
    "ddpg": (
        DDPG,
        "MlpPolicy",
        pushes,
        {**OFF, "optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
    ),
    "tqc": (TQC, "MlpPolicy", pushes, {**OFF, "train_freq": 4, "gradient_steps": 2}),
}


def make(case, jobs=1, vec_env="dummy"):
    algo, policy, env_id, kwargs = CASES[case]
    env = make_team_env(env_id, n_envs=2, seed=0, vec_env=vec_env)
    return Team(algo, policy, env, seed=0, jobs=jobs, **kwargs)


def everything(team) -> dict[Any, Any]:
    """Return what a training has ended with."""
    found: dict[Any, Any] = {"steps": team.num_timesteps, "successes": list(team.ep_success_buffer)}
    found["episodes"] = [(episode["r"], episode["l"]) for episode in team.ep_info_buffer]
    for agent, model in team.agents.items():
        found[agent, "weights"] = {name: value.numpy().tobytes() for name, value in model.policy.state_dict().items()}
        found[agent, "counts"] = model.num_timesteps, model._n_updates, model._current_progress_remaining
        rng = team._agents.rngs[agent]
        found[agent, "rng"] = str(rng._numpy.state), rng._torch.numpy().tobytes()
        found[agent, "episodes"] = [(episode["r"], episode["l"]) for episode in model.ep_info_buffer]
        for key in ("optimizer", "actor.optimizer", "critic.optimizer"):
            owner = model.policy
            for part in key.split("."):
                owner = getattr(owner, part, None)
            if owner is not None:
                states = owner.state_dict()["state"].values()
                found[agent, key] = [{k: v.numpy().tobytes() for k, v in state.items()} for state in states]
    return found


def resumed(case, saved, n, jobs=1, vec_env="dummy"):
    """Go on from what was saved, in a new environment that has another seed."""
    env = make_team_env(CASES[case][2], n_envs=2, seed=99, vec_env=vec_env)
    trusted = {"trust_pickle": True} if case == "schedules" else {}
    team = Team.load(io.BytesIO(saved), env=env, exact=True, jobs=jobs, device="cpu", **trusted)
    callback = SaveOnce()
    return team.learn(n - team.num_timesteps, callback, reset_num_timesteps=False), callback


@pytest.mark.parametrize("case", CASES)
def test_resumed_is_undisturbed(case):
    n, at = 96, 40
    undisturbed, watching, saving = make(case), SaveOnce(), SaveOnce(at)
    expected = everything(undisturbed.learn(n, watching))
    assert everything(make(case).learn(n, saving)) == expected, "saving changes the training"
    team, callback = resumed(case, saving.saved, n)
    assert everything(team) == expected
    assert callback.drawn == watching.drawn == saving.drawn


@pytest.mark.parametrize(("jobs", "vec_env"), [(2, "dummy"), (1, "subproc"), (2, "subproc")])
def test_in_processes(jobs, vec_env):
    # A callback of one's own would keep all agents in this process; sb3_belief's own ones do not
    case, n = "belief, normalised", 96
    expected = everything(make(case).learn(n))
    team = make(case, jobs, vec_env)
    team.learn(48)
    file = io.BytesIO()
    team.save(file, exact=True)
    team.get_env().close()
    again, _ = resumed_without_callback(case, file.getvalue(), n, jobs, vec_env)
    straight = make(case)
    straight.learn(48)
    straight.learn(48, reset_num_timesteps=False)
    assert everything(again) == everything(straight)
    assert again.num_timesteps == expected["steps"]
    again.get_env().close()


def resumed_without_callback(case, saved, n, jobs, vec_env):
    env = make_team_env(CASES[case][2], n_envs=2, seed=99, vec_env=vec_env)
    team = Team.load(io.BytesIO(saved), env=env, exact=True, jobs=jobs, device="cpu")
    return team.learn(n - team.num_timesteps, reset_num_timesteps=False), None


def evaluated(folder: Path):
    """Return a callback that evaluates, and saves once."""
    env = make_team_env(EASY, n_envs=1, seed=5)
    return CallbackList([EvalCallback(env, eval_freq=11, n_eval_episodes=1, log_path=str(folder), verbose=0), SaveOnce(40)])


def is_repeated(key):
    return not key.startswith("eval/") and key not in ("time/fps", "time/time_elapsed")


def test_evaluations_and_logs_go_on(tmp_path):
    """The evaluation environment is not the team's: what its random numbers are is up to the caller, who seeds it here."""
    results = {}
    for name in ("undisturbed", "resumed"):
        folder = tmp_path / name
        env = make_team_env(EASY, n_envs=2, seed=0)
        team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, log_dir=str(folder), **BELIEF)
        env.start_monitor(str(folder))
        callback = evaluated(folder)
        team.learn(96, callback)
        if name == "resumed":
            saved = callback.callbacks[1].saved
            env = make_team_env(EASY, n_envs=2, seed=1)
            team = Team.load(io.BytesIO(saved), env=env, exact=True, log_dir=str(folder), device="cpu")
            env.start_monitor(str(folder), continue_from=team.monitor_state)
            callback = evaluated(folder)
            team.learn(96 - team.num_timesteps, callback, reset_num_timesteps=False)
        env.close()
        # SB3 orders the columns as a set of texts happens to be ordered
        with open(folder / "progress.csv") as file:
            rows = list(csv.DictReader(file))
        table = [{key: cell for key, cell in row.items() if is_repeated(key)} for row in rows]
        monitor = [row.split(",")[:2] for row in (folder / "monitor.csv").read_text().splitlines()[1:]]
        results[name] = table, monitor, dict(np.load(folder / "evaluations.npz"))["timesteps"].tolist()
    assert results["resumed"] == results["undisturbed"]
    assert len(results["resumed"][1]) > 2 and len(results["resumed"][2]) == 4


class Unreadable(ToyEnv):
    """Environment that holds what is not data."""

    def reset(self, seed=None, options=None):
        self.generator = (i for i in range(3))
        return super().reset(seed, options)


def test_an_environment_without_a_state_begins_new_episodes():
    CASES["unreadable"] = (PPO, "MlpPolicy", Unreadable, {**PPO_KWARGS, "normalize": True})
    try:
        first, second = SaveOnce(40), SaveOnce(40)
        with pytest.warns(UserWarning, match="begin new episodes with each exact checkpoint"):
            expected = everything(make("unreadable").learn(96, first))
        assert make("unreadable").learn(8).exact_needs_reset and not make("belief").learn(8).exact_needs_reset
        with pytest.warns(UserWarning):
            assert everything(make("unreadable").learn(96, second)) == expected
        team, _ = resumed("unreadable", first.saved, 96)
        assert everything(team) == expected
        # It differs from a training without checkpoints, which the warning says
        assert everything(make("unreadable").learn(96, SaveOnce())) != expected
    finally:
        del CASES["unreadable"]


def test_where_it_cannot_be_saved(tmp_path):
    class InARollout(BaseCallback):
        model: Any

        def _on_step(self):
            with pytest.raises(ValueError, match="where all its agents begin a rollout"):
                self.model.save(tmp_path / "team.zip", exact=True)
            self.model.save(tmp_path / "plain.zip")
            return True

    team = make("belief")
    with pytest.raises(ValueError, match="where all its agents begin a rollout"):
        team.save(tmp_path / "team.zip", exact=True)
    team.learn(8, InARollout())
    assert not (tmp_path / "team.zip").exists()
    env = make_team_env(EASY, n_envs=2, seed=0)
    with pytest.raises(ValueError, match="saved without exact=True"):
        Team.load(tmp_path / "plain.zip", env=env, exact=True)


def test_what_an_exact_load_refuses(tmp_path):
    team = make("belief")
    team.learn(16)
    team.save(tmp_path / "team.zip", exact=True)
    with pytest.raises(ValueError, match="exact=True"):
        Team.load(tmp_path / "team.zip", exact=True)
    with pytest.raises(ValueError, match=r"keeps its settings.*learning_rate"):
        Team.load(tmp_path / "team.zip", env=make_team_env(EASY, n_envs=2), exact=True, learning_rate=1e-5)
    with pytest.raises(ValueError, match="2 copies of the environment, which now has 3"):
        Team.load(tmp_path / "team.zip", env=make_team_env(EASY, n_envs=3), exact=True)
    loaded = Team.load(tmp_path / "team.zip", env=make_team_env(EASY, n_envs=2), exact=True)
    with pytest.raises(ValueError, match="reset_num_timesteps=False"):
        loaded.learn(16)
    # It remains a team's file like any other
    plain = Team.load(tmp_path / "team.zip", env=make_team_env(EASY, n_envs=2, seed=0))
    assert plain.learn(16).num_timesteps == 16


def test_other_callbacks_take_nothing_over():
    saving = SaveOnce(40)
    make("a2c").learn(96, saving)
    env = make_team_env(ToyEnv, n_envs=2)
    team = Team.load(io.BytesIO(saving.saved), env=env, exact=True, device="cpu")
    with pytest.warns(UserWarning, match=r"had the callbacks \['SaveOnce'\], now there are \['CallbackList', 'SaveOnce'\]"):
        team.learn(8, CallbackList([SaveOnce()]), reset_num_timesteps=False)


def test_it_takes_the_first_boundary_of_mixed_rollouts():
    """Agents of unequal rollouts begin one together every 40 steps: 5 and 8 steps of 2 copies have 80 in common."""
    agent_kwargs = {"agent_0": {"n_steps": 8, "batch_size": 8}, "agent_1": {"n_steps": 20, "batch_size": 20}}
    env = make_team_env(ToyEnv, n_envs=2, seed=0)
    team = Team(PPO, "MlpPolicy", env, seed=0, device="cpu", n_epochs=1, agent_kwargs=agent_kwargs)

    class WhereItCan(BaseCallback):
        model: Any

        def __init__(self):
            super().__init__()
            self.at: list[int] = []

        def _on_rollout_start(self):
            try:
                self.model.save(io.BytesIO(), exact=True)
                self.at.append(self.model.num_timesteps)
            except ValueError:
                pass

        def _on_step(self):
            return True

    callback = WhereItCan()
    team.learn(200, callback)
    assert callback.at == [0, 80, 160]


def test_tensors_keep_their_places():
    """Optimisers refer to them."""
    saving = SaveOnce(40)
    make("sac").learn(48, saving)
    team = Team.load(io.BytesIO(saving.saved), env=make_team_env(pushes, n_envs=2), exact=True, device="cpu")
    model = next(iter(team.agents.values()))
    before = model.log_ent_coef
    team.learn(8, SaveOnce(), reset_num_timesteps=False)
    assert model.log_ent_coef is before is model.ent_coef_optimizer.param_groups[0]["params"][0]
    assert isinstance(before, th.Tensor) and before.requires_grad
