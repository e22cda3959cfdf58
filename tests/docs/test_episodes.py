"""docs/episodes.md draws what agents are given: here the picture is drawn anew."""

from pathlib import Path

from stable_baselines3 import PPO

from tests.team.helpers import PPO_KWARGS, Record, Team, make_team_env
from tests.team.toy_envs import ScriptedEnv

PAGE = Path(__file__).parents[2] / "docs" / "episodes.md"


def test_the_timeline_is_what_the_agents_are_given():
    team = Team(PPO, "MlpPolicy", make_team_env(ScriptedEnv), seed=0, **PPO_KWARGS)
    records = {agent: Record(keep=("dones", "infos")) for agent in team.agents}
    team.learn(16, agent_callbacks=records)
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    for agent, record in records.items():
        drawn = f"{agent:<12}"
        for number, kept in enumerate(record.kept[:10], start=1):
            info, done = kept["infos"][0], bool(kept["dones"][0])
            end = ("T" if info["TimeLimit.truncated"] else "E") if done else ""
            drawn += f"{'#' if info['active'] else '.'}{end}".ljust(2) + ("| " if number == 8 else "  ")
        assert drawn.rstrip() in lines
