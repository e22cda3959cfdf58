"""Agents that learn in several processes learn, draw and log the same as in one, bit for bit."""

import gc
import json
import multiprocessing
import os
import pickle
import signal
import warnings
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_belief import BeliefPPO, MaskableBeliefPPO
from sb3_belief.cli.main import train_main
from tests.team.helpers import PPO_KWARGS, Team, make_team_env, parameters
from tests.team.toy_envs import ToyEnv

EASY = "traffic-junction-easy"
PPO_SMALL = {**PPO_KWARGS, "batch_size": 16}


@pytest.fixture(autouse=True)
def ctrl_c_interrupts():
    """Also where the tests run in the background, where a shell lets Ctrl-C be ignored."""
    old = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, old)


class Draws(BaseCallback):
    """Draws at each rollout's start, and keeps what was logged and drawn by then."""

    def __init__(self):
        super().__init__()
        self.seen: list[Any] = []

    def _on_rollout_start(self):
        self.seen.append((dict(self.model.logger.name_to_value), np.random.normal(), float(th.rand(()))))

    def _on_step(self):
        return True


def falling(progress):
    return 1e-2 * progress


def toy_team(algo, jobs, env_id=ToyEnv, policy="MlpPolicy", n_envs=2, observe_last=False, **kwargs):
    env = make_team_env(env_id, n_envs=n_envs, observe_last=observe_last)
    return Team(algo, policy, env, seed=0, **{"device": "cpu", "jobs": jobs, **kwargs})


def flat(value):
    """
    :return: what can be compared with ==, to the last bit
    """
    if isinstance(value, (th.Tensor, np.ndarray)):
        array = value.detach().numpy() if isinstance(value, th.Tensor) else value
        return array.dtype, array.shape, array.tobytes()
    if isinstance(value, dict):
        return {key: flat(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [flat(part) for part in value]
    return repr(value)


def rollout_of(model):
    attributes = vars(model.rollout_buffer) if hasattr(model, "rollout_buffer") else {}
    return {name: value for name, value in attributes.items() if isinstance(value, (np.ndarray, int))}


def statistics_of(team, agent):
    found = team._agents.statistics.get(agent)
    return None if found is None else [found.obs_rms.mean, found.obs_rms.var, found.ret_rms.var, found.returns]


def everything(team, callbacks):
    obs = team.get_env().reset()
    kept: dict[str, Any] = {"prediction": team.predict(obs, deterministic=True)[0]}
    for agent, model in team.agents.items():
        rng = team._agents.rngs[agent]
        logged = {key: value for key, value in model.logger.name_to_value.items() if not key.startswith("time/")}
        kept[agent] = {
            "policy": dict(model.policy.state_dict()),
            "optimizer": model.policy.optimizer.state_dict(),
            "gradients": [parameter.grad for parameter in model.policy.parameters()],
            "training": [module.training for module in model.policy.modules()],
            "rng": (rng._torch, rng._numpy.state),
            "logged": logged,
            "counts": (model._n_updates, model.num_timesteps, model._current_progress_remaining),
            "where it is": (model._last_obs, model._last_episode_starts),
            "episodes": [(episode["r"], episode["l"]) for episode in model.ep_info_buffer],
            "rollout": rollout_of(model),
            "statistics": statistics_of(team, agent),
            "callback": callbacks[agent].seen if agent in callbacks else None,
            "names": sorted(vars(model)),
        }
    return flat(kept)


CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "ppo": (PPO, {**PPO_SMALL, "learning_rate": falling, "target_kl": 1e-3, "clip_range_vf": 0.2}),
    "a2c": (A2C, {"n_steps": 8}),
    "maskable_ppo": (MaskablePPO, {**PPO_SMALL, "env_id": EASY}),
    # Its observations hold the last step too, which is made of what all agents did
    "recurrent_ppo": (RecurrentPPO, {**PPO_SMALL, "policy": "MlpLstmPolicy", "observe_last": True}),
    "trpo": (TRPO, {"n_steps": 8, "batch_size": 16}),
    "belief_ppo": (
        BeliefPPO,
        {
            "n_steps": 20,
            "batch_size": 40,
            "n_epochs": 2,
            "history_length": 50,
            "policy": "BeliefPolicy",
            "env_id": EASY,
            "normalize": True,
            "action_coef": lambda progress: abs(progress),
        },
    ),
    "maskable_belief_ppo": (
        MaskableBeliefPPO,
        {"n_steps": 20, "batch_size": 40, "n_epochs": 1, "policy": "BeliefPolicy", "env_id": EASY},
    ),
    "mixed": (
        {"agent_0": PPO, "agent_1": DQN, "agent_2": A2C, "agent_3": PPO},
        {
            "env_id": lambda: ToyEnv(4),
            "learning_rate": 1e-3,
            "agent_kwargs": {
                "agent_0": PPO_SMALL,
                "agent_1": {"learning_starts": 4, "buffer_size": 100, "batch_size": 8, "target_update_interval": 8},
                "agent_2": {"n_steps": 4},
                "agent_3": {**PPO_SMALL, "n_steps": 16},
            },
        },
    ),
}


@pytest.mark.parametrize("watched", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_the_same_is_learned(case, watched):
    """Agents with callbacks of their own stay in the main process."""
    algo, kwargs = CASES[case]
    # Two rollouts and a half: the second learn() goes on where it may
    n = 2 * 5 * kwargs.get("n_steps", 16) // 2
    results = []
    for jobs in (1, 3 if case == "ppo" else 2):
        team = toy_team(algo, jobs, **kwargs)
        callbacks = {agent: Draws() for agent in team.possible_agents[:2]} if watched else {}
        team.learn(n, agent_callbacks=callbacks, log_interval=2)
        team.learn(n, agent_callbacks=callbacks, reset_num_timesteps=False)
        results.append(everything(team, callbacks))
    for key, one in results[0].items():
        assert one == results[1][key], key


class Pushes(ToyEnv):
    """With actions for which there is gSDE."""

    def action_space(self, agent):
        return spaces.Box(-1, 1, (1,), np.float32)

    def step(self, actions):
        return super().step({agent: 1 + np.sign(action[0]) for agent, action in actions.items()})


class OwnNetwork(FlattenExtractor):
    """Leaves something behind at each pass, which one that is made elsewhere would not."""

    passes = 0

    def forward(self, observations):
        self.passes += 1
        return super().forward(observations) * (1 + self.passes % 3)


@pytest.mark.filterwarnings("ignore:All agents learn in one process")
def test_a_copy_of_a_policy_acts_by_itself():
    copies: list[Any] = []

    class Copies(BaseCallback):
        model: Any

        def _on_step(self):
            policy = self.model.agents["agent_0"].policy
            copies[:] = [deepcopy(policy), pickle.loads(pickle.dumps(policy))]
            return True

    team = toy_team(PPO, 2, **PPO_SMALL)
    team.learn(40, callback=Copies())
    obs = th.as_tensor(team.get_env().reset()["agent_0"])
    with th.no_grad():
        before = [copy(obs, deterministic=True)[1] for copy in copies]
        for parameter in team.agents["agent_0"].policy.parameters():
            parameter.zero_()
        after = [copy(obs, deterministic=True)[1] for copy in copies]
    assert th.equal(before[0], before[1]) and th.equal(before[0], after[0]) and th.equal(before[1], after[1])
    assert float(before[0].abs().max()) > 0


class Odd(PPO):
    """Does in ``train()`` what algorithms of one's own may do."""

    def __init__(self, *args, at=None, error=None, kill=False, interrupt=False, **kwargs):
        self.at, self.error, self.kill, self.interrupt = at, error, kill, interrupt
        self.trained_in: list[int] = []
        self.kept: Any = None
        self.only_at_first = 1
        super().__init__(*args, **kwargs)
        if kwargs.get("_init_setup_model", True):
            self.policy.only_at_first = 1  # type: ignore[assignment]

    def train(self):
        super().train()
        self.trained_in.append(os.getpid())
        if self.kept is None:
            # The optimizer of a network that SB3 does not know of
            self.aux = th.nn.Linear(2, 2)
            self.aux_optimizer = th.optim.Adam(self.aux.parameters())
            self.kept = [self.aux.weight, self.policy]
            for owner in (self, self.policy):
                vars(owner).pop("only_at_first", None)
        self.aux_optimizer.zero_grad()
        self.aux(th.ones(2)).sum().backward()
        self.aux_optimizer.step()
        # numpy keeps back the second of two
        self.logger.record_mean("odd/drawn", np.random.normal())
        self.logger.record("odd/hidden", 1.0, exclude="stdout")
        warnings.warn(f"odd {len(self.trained_in)}", UserWarning)
        if len(self.trained_in) == self.at:
            if self.kill:
                os.kill(os.getpid(), signal.SIGKILL)
            if self.interrupt:
                os.kill(os.getpid(), signal.SIGINT)
            if self.error is not None:
                raise self.error


@pytest.mark.filterwarnings("ignore:odd")
@pytest.mark.parametrize("watched", [False, True])
def test_an_algorithm_of_ones_own_may_change_anything_of_its_model(watched):
    results = []
    for jobs in (1, 2):
        team = toy_team(Odd, jobs, **PPO_SMALL)
        before = {agent: [model.policy, *model.policy.parameters()] for agent, model in team.agents.items()}
        callbacks = {agent: Draws() for agent in team.possible_agents} if watched else {}
        with pytest.warns(UserWarning, match="odd 3"):
            team.learn(3 * 16, agent_callbacks=callbacks)
        for agent, model in team.agents.items():
            # Whoever holds a part of the model still does
            assert all(new is old for new, old in zip([model.policy, *model.policy.parameters()], before[agent], strict=True))
            assert model.kept[1] is model.policy
            assert not hasattr(model, "only_at_first") and not hasattr(model.policy, "only_at_first")
            assert model.aux_optimizer.param_groups[0]["params"][0] is model.aux.weight
            assert model.logger.name_to_excluded["odd/hidden"] == ("stdout",) and len(model.trained_in) == 3
        aux = {agent: (model.aux.weight, model.aux_optimizer.state_dict()["state"]) for agent, model in team.agents.items()}
        results.append([everything(team, callbacks), flat(aux)])
        elsewhere = {agent for agent, model in team.agents.items() if set(model.trained_in) != {os.getpid()}}
        assert elsewhere == ({"agent_0"} if jobs == 2 and not watched else set())
    assert results[0] == results[1]


def no_processes_stay():
    gc.collect()
    return not [process for process in multiprocessing.active_children() if process.name.startswith("team-worker")]


def goes_on(team, tmp_path):
    """Saving and learning go on as if nothing had been."""
    team.save(tmp_path / "after")
    before = {agent: parameters(model) for agent, model in team.agents.items()}
    assert all("train" not in vars(model) for model in team.agents.values())
    for model in team.agents.values():
        model.at = None
    team.learn(16)
    assert all(not th.equal(before[agent], parameters(model)) for agent, model in team.agents.items())
    # The model keeps a network, which can only be pickled
    loaded = Team.load(tmp_path / "after", trust_pickle=True)
    assert all(th.equal(before[agent], parameters(model)) for agent, model in loaded.agents.items())


def notes(error):
    return " ".join(getattr(error, "__notes__", []))


@pytest.mark.filterwarnings("ignore:odd", "ignore::RuntimeWarning")
def test_an_error_in_a_worker(tmp_path):
    states = []
    for jobs in (1, 2):
        own = {"agent_0": {"at": 2, "error": ZeroDivisionError("by hand")}}
        team = toy_team(Odd, jobs, **PPO_SMALL, agent_kwargs=own)
        with pytest.raises(ZeroDivisionError, match="by hand") as caught:
            team.learn(64)
        assert "agent 'agent_0'" in notes(caught.value) and "joint step 16" in notes(caught.value)
        states.append(parameters(team.agents["agent_0"]))
        if jobs == 2:
            assert "in train" in str(caught.value.__cause__)  # where it happened
            assert no_processes_stay()
        goes_on(team, tmp_path)
    # It is what it was when the error was raised
    assert th.equal(*states)


@pytest.mark.filterwarnings("ignore:odd", "ignore::RuntimeWarning")
def test_ctrl_c_while_workers_update(tmp_path):
    # The last of them learns in this process
    team = toy_team(Odd, 2, **PPO_SMALL, agent_kwargs={"agent_1": {"at": 2, "interrupt": True}})
    with pytest.raises(KeyboardInterrupt):
        team.learn(64)
    assert no_processes_stay()
    goes_on(team, tmp_path)


def test_workers_wait_for_the_next_learn_and_end_with_the_team():
    assert no_processes_stay()
    team = toy_team(PPO, 9, **PPO_SMALL).learn(16)

    def pids():
        return [process.pid for process in multiprocessing.active_children() if process.name.startswith("team-worker")]

    first = pids()
    # Two agents: this process and one more
    assert len(first) == 1
    team.learn(16)
    assert pids() == first
    del team
    assert no_processes_stay()


def test_a_model_saved_while_it_learns_is_saved_as_always(tmp_path):
    class Saves(BaseCallback):
        def _on_step(self):
            self.model.save(tmp_path / "model")
            return True

    saved = []
    for jobs in (1, 2):
        toy_team(PPO, jobs, **PPO_SMALL).learn(40, agent_callbacks={"agent_0": Saves()})
        saved.append(PPO.load(tmp_path / "model"))
    assert th.equal(parameters(saved[0]), parameters(saved[1]))
    assert sorted(vars(saved[0])) == sorted(vars(saved[1]))


def test_what_cannot_be_sent_is_refused_before_anything_is_learned():
    team = toy_team(PPO, 2, **PPO_SMALL)
    team.agents["agent_0"].file = open(os.devnull, "w")
    with pytest.raises(ValueError, match=r"'agent_0' cannot learn in another process.* because of file .*use jobs=1"):
        team.learn(16)
    team.agents["agent_0"].file.close()
    assert team.num_timesteps == 0
    assert no_processes_stay()


@pytest.mark.parametrize("jobs", [0, -1, 1.0, "2", None, True])
def test_what_is_no_number_of_processes_is_refused(jobs, tmp_path):
    with pytest.raises(ValueError, match=r"jobs is .* whole number of at least 1"):
        toy_team(PPO, jobs, **PPO_SMALL)
    toy_team(PPO, 1, **PPO_SMALL).save(tmp_path / "team")
    with pytest.raises(ValueError, match=r"jobs is .* whole number of at least 1"):
        Team.load(tmp_path / "team", jobs=jobs)


@pytest.mark.filterwarnings("ignore:You are trying to run PPO on the GPU")
def test_models_elsewhere_than_on_the_cpu_are_refused():
    with pytest.raises(ValueError, match="that of 'agent_0' is on meta: use jobs=1"):
        toy_team(PPO, 2, **{**PPO_SMALL, "device": "meta"})


def test_train_py_takes_the_number_of_processes(tmp_path):
    teams = []
    for k, jobs in enumerate(("1", "2"), start=1):
        flags = ["--env", EASY, "-n", "80", "--seed", "3", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "-1"]
        settings = ["n_envs:2", "n_steps:20", "batch_size:40", "n_epochs:1"]
        assert train_main(["--algo", "ppo", *flags, "--jobs", jobs, "-params", *settings]) == 0
        folder = tmp_path / "ppo" / f"{EASY}_{k}"
        assert json.loads((folder / "run.json").read_text())["jobs"] == int(jobs)
        teams.append(Team.load(folder / "team.zip"))
    for agent, model in teams[0].agents.items():
        assert th.equal(parameters(model), parameters(teams[1].agents[agent]))
