"""
How the time grows: with the number of agents, of copies, of remembered steps and of others.

Everything runs in toy environments that cost almost nothing, with a full history from the start, since a short one is cheaper.

With more agents each also has more others. So that the one is not taken for the other, three kinds of teams are measured:

- ``fixed others``: each agent holds a belief about 39 others however many agents learn; those missing are scripted. This
  counts as ``agents_20_vs_5``: the agents alone
- ``all learn``: each agent holds a belief about all the other agents, as in any environment; this grows with both
- ``no belief``: the same team without a belief: what lockstep and the exchange between the agents cost

Others are counted by one agent in a plain Gymnasium environment that tells of as many.
"""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from benchmarks.teams import ALGOS, TeamLoop
from benchmarks.toys import WIDTH, ToyAgentEnv, ToyTeamEnv
from sb3_belief import BeliefPPO, Team

AGENTS, MAX_OTHERS = (2, 5, 10, 20, 40), 39
COPIES = (1, 8, 32, 128)
HISTORY = (100, 800, 1600, 6400, 12800)
OTHERS = (1, 5, 10, 20, 40)
N_ENVS = 8


def _settings(quick: bool, n_envs: int = N_ENVS) -> dict[str, Any]:
    # As many rows in each rollout and as many updates from them, whatever the number of copies
    rows, n_epochs = (32, 1) if quick else (512, 4)
    return dict(n_steps=rows // n_envs, batch_size=rows // 2, n_epochs=n_epochs, seed=0, device="cpu")


def fill_history(model: BeliefPPO) -> None:
    """
    :param model: remembers as many random steps as it can
    """
    if model.policy.history is not None:
        generator, rows = np.random.default_rng(0), model.history_length
        observations = generator.standard_normal((rows, WIDTH), dtype=np.float32)
        model.policy.remember(observations, np.zeros((rows, model.policy.layout.width), dtype=np.float32))


def toy_team(algo: str, n_agents: int, n_scripted: int = 0, n_envs: int = N_ENVS, quick: bool = False) -> Team:
    """
    :param algo: ``"ippo"`` or ``"belief_ppo"``
    :param n_agents: number of learners
    :param n_scripted: number of others that do not learn
    :param n_envs: number of copies
    :param quick: short rollouts and one epoch
    :return: a team in the toy environment, its histories full
    """
    env = ToyTeamEnv(n_envs, n_agents, n_scripted)
    team = Team(BeliefPPO, "BeliefPolicy", env, **ALGOS[algo], **_settings(quick, n_envs))
    for model in team.agents.values():
        assert isinstance(model, BeliefPPO)
        fill_history(model)
    return team


class _AgentLoop:
    """One agent alone, with a belief about others that a plain environment tells of."""

    def __init__(self, n_others: int, history_length: int, quick: bool) -> None:
        env = DummyVecEnv([lambda: ToyAgentEnv(n_others)] * N_ENVS)
        self.model = BeliefPPO("BeliefPolicy", env, history_length=history_length, **_settings(quick))
        fill_history(self.model)

    def __call__(self) -> int:
        before = self.model.num_timesteps
        self.model.learn(self.model.n_steps * N_ENVS, reset_num_timesteps=False)
        return self.model.num_timesteps - before


class _AgentSteps:
    """Steps of each agent instead of joint ones: what grows with the number of agents by itself is taken out."""

    def __init__(self, team: Team) -> None:
        self._loop, self._n_agents = TeamLoop(team), len(team.agents)

    def __call__(self) -> int:
        return self._n_agents * self._loop()


def run(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    _agents(report)
    _copies(report)
    _history(report)
    _others(report)


def _agents(report: Report) -> None:
    report.title("agents", f"steps of each agent, {N_ENVS} copies")
    numbers = (5, 20) if report.quick else AGENTS
    loops: dict[str, Loop] = {}
    for n in numbers:
        loops[f"{n} agents, fixed others"] = _AgentSteps(toy_team("belief_ppo", n, MAX_OTHERS + 1 - n, quick=report.quick))
        loops[f"{n} agents, all learn"] = _AgentSteps(toy_team("belief_ppo", n, quick=report.quick))
        loops[f"{n} agents, no belief"] = _AgentSteps(toy_team("ippo", n, quick=report.quick))
    samples = report.measure("agents", loops, "agent steps")
    for key, kind in (("", "fixed others"), ("_all_learn", "all learn"), ("_no_belief", "no belief")):
        # Time is the inverse of speed
        found = ratio(samples[f"5 agents, {kind}"], samples[f"20 agents, {kind}"])
        report.add_ratio(f"agents_20_vs_5{key}", found, f"CPU time of an agent's step, 20 agents / 5 ({kind})")


def _copies(report: Report) -> None:
    report.title("copies", "five agents with a belief, equally many rows in each rollout")
    numbers = (1, 8) if report.quick else COPIES
    loops = {f"{n} copies": TeamLoop(toy_team("belief_ppo", 5, n_envs=n, quick=report.quick)) for n in numbers}
    report.measure("copies", loops)


def _history(report: Report) -> None:
    report.title("history", f"one agent with a belief about five others, {N_ENVS} copies, keep_ratio 0.05")
    numbers = (800, 6400) if report.quick else HISTORY
    samples = report.measure("history", {f"{n} rows": _AgentLoop(5, n, report.quick) for n in numbers})
    text = "CPU time of a step with 6,400 remembered steps / 800"
    report.add_ratio("history_6400_vs_800", ratio(samples["800 rows"], samples["6400 rows"]), text)


def _others(report: Report) -> None:
    report.title("others", f"one agent with a belief about them, {N_ENVS} copies, 800 remembered steps")
    numbers = (5, 40) if report.quick else OTHERS
    samples = report.measure("others", {f"{n} others": _AgentLoop(n, 800, report.quick) for n in numbers})
    found = ratio(samples["5 others"], samples["40 others"])
    report.add_ratio("others_40_vs_5", found, "CPU time of a step with 40 others / 5")
