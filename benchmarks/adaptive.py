"""An adaptive belief against the paper's and none: part ``adaptive`` of the benchmark (``benchmarks/bench.py``)."""

from benchmarks.measure import ratio
from benchmarks.report import Report
from benchmarks.teams import TeamLoop
from sb3_belief import Team, make_team_env
from sb3_belief.zoo.config import load_config

ENV = "junction-cultures-medium"
BELIEFS = {
    "none": ["belief:none"],
    "dynamic": ["belief:dynamic"],
    "adaptive": ["belief:adaptive", "action_loss:cross_entropy"],
}


def team_of(belief: str, quick: bool) -> Team:
    """
    Return one learner among nine scripted cars, with the settings of zoo_configs/belief_ppo.yml.

    :param belief: A key of ``BELIEFS``
    :param quick: Four copies for eight steps, and one epoch
    """
    sizes = ["n_envs:4", "n_steps:8", "n_epochs:1", "batch_size:16"] if quick else []
    config = load_config("belief_ppo", ENV, params=[*BELIEFS[belief], *sizes])
    env = make_team_env(ENV, n_envs=config.n_envs, env_kwargs=config.env_kwargs)
    return Team(config.algo_class, config.policy, env, seed=0, device="cpu", **config.algo_kwargs)


def run(report: Report) -> None:
    """
    Measure part ``adaptive``.

    :param report: Where it is told
    """
    report.title("adaptive", f"one learner among nine scripted cars, {ENV}")
    loops = {belief: TeamLoop(team_of(belief, report.quick)) for belief in BELIEFS}
    # It takes a rollout to fill the histories
    none, dynamic, adaptive = report.measure("adaptive", loops, warmup=2).values()
    report.add_ratio("adaptive_vs_dynamic", ratio(adaptive, dynamic), "adaptive / dynamic")
    report.add_ratio("adaptive_vs_ippo", ratio(adaptive, none), "adaptive / no belief")
