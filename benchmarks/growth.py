"""
How does the time grow with the number of agents, of copies, of remembered steps and of others?

Everything runs in an environment that costs almost nothing, with a full history from the start, since a short one is cheaper.

With more agents each agent also has more others. To tell the two apart, three kinds of teams are measured:

- ``fixed others``: each agent has a belief about 39 others, however many agents learn; those missing are scripted. It shows
  what more agents cost, and nothing else, and counts as ``agents_20_vs_5``
- ``all learn``: each agent has a belief about all other agents, as in any environment; this grows with both
- ``no belief``: the same team without a belief shows what lockstep and the exchange between the agents cost

Remembered steps and others are varied for a single agent among scripted others.
"""

from typing import Any

import numpy as np

from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from benchmarks.teams import ALGOS, TeamLoop
from benchmarks.toy_env import WIDTH, ToyTeamEnv
from sb3_belief import BeliefPPO, Team

AGENTS, MAX_OTHERS = (2, 5, 10, 20, 40), 39
COPIES = (1, 8, 32, 128)
HISTORY = (100, 800, 1600, 6400, 12800)
OTHERS = (1, 5, 10, 20, 40)
N_ENVS = 8


def fill_history(model: BeliefPPO) -> None:
    """Let a model remember as many random steps as it can."""
    if model.policy.history is not None:
        rng, rows = np.random.default_rng(0), model.history_length
        observations = rng.standard_normal((rows, WIDTH), dtype=np.float32)
        model.policy.remember(observations, np.zeros((rows, model.policy.layout.width), dtype=np.float32))


def toy_team(algo: str, n_agents: int, n_scripted: int = 0, n_envs: int = N_ENVS, quick: bool = False, **kwargs: Any) -> Team:
    """
    Return a team in the toy environment whose histories are full.

    :param algo: ``"ippo"`` or ``"belief_ppo"``
    :param n_agents: Number of learners
    :param n_scripted: Number of others that do not learn
    :param n_envs: Number of copies. The rollout has the same number of rows, and of updates from them, whatever this is
    :param quick: Short rollouts and one epoch
    :param kwargs: Arguments of the algorithm that override these
    """
    rows, n_epochs = (32, 1) if quick else (512, 4)
    settings = dict(n_steps=rows // n_envs, batch_size=rows // 2, n_epochs=n_epochs, seed=0, device="cpu")
    env = ToyTeamEnv(n_envs, n_agents, n_scripted)
    team = Team(BeliefPPO, "BeliefPolicy", env, **{**settings, **ALGOS[algo], **kwargs})
    for model in team.agents.values():
        assert isinstance(model, BeliefPPO)
        fill_history(model)
    return team


def agent_steps(team: Team) -> Loop:
    """Return a loop that counts the steps of each agent instead of joint ones, so that their number cancels out."""
    loop, n_agents = TeamLoop(team), len(team.agents)
    return lambda: n_agents * loop()


def run(report: Report) -> None:
    """Measure part ``d``."""
    _agents(report)
    _copies(report)
    _history(report)
    _others(report)


def _agents(report: Report) -> None:
    report.title("agents", f"steps of each agent, {N_ENVS} copies")
    loops: dict[str, Loop] = {}
    for n in (5, 20) if report.quick else AGENTS:
        scripted = MAX_OTHERS + 1 - n
        loops[f"{n} agents, fixed others"] = agent_steps(toy_team("belief_ppo", n, scripted, quick=report.quick))
        loops[f"{n} agents, all learn"] = agent_steps(toy_team("belief_ppo", n, quick=report.quick))
        loops[f"{n} agents, no belief"] = agent_steps(toy_team("ippo", n, quick=report.quick))
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
    teams = {f"{n} rows": toy_team("belief_ppo", 1, 5, quick=report.quick, history_length=n) for n in numbers}
    samples = report.measure("history", {name: TeamLoop(team) for name, team in teams.items()})
    text = "CPU time of a step with 6,400 remembered steps / 800"
    report.add_ratio("history_6400_vs_800", ratio(samples["800 rows"], samples["6400 rows"]), text)


def _others(report: Report) -> None:
    report.title("others", f"one agent with a belief about them, {N_ENVS} copies, 800 remembered steps")
    numbers = (5, 40) if report.quick else OTHERS
    teams = {f"{n} others": toy_team("belief_ppo", 1, n, quick=report.quick, history_length=800) for n in numbers}
    samples = report.measure("others", {name: TeamLoop(team) for name, team in teams.items()})
    found = ratio(samples["5 others"], samples["40 others"])
    report.add_ratio("others_40_vs_5", found, "CPU time of a step with 40 others / 5")
