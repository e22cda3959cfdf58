import re

import numpy as np
import pytest

from sb3_belief.cli.main import main
from sb3_belief.team import make_team_env
from sb3_belief.zoo.demo import ENV_ID
from sb3_belief.zoo.evaluate import Outcome, evaluate


class Still:
    """Everybody brakes for ever."""

    def __init__(self, action):
        self.action = action

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return {agent: np.full(len(obs), self.action) for agent, obs in observation.items()}, state


@pytest.mark.parametrize(("arrival_rate", "action", "rate"), [(0.0, 0, 1.0), (1.0, 0, 0.0), (1.0, 1, 0.0)])
def test_evaluate_counts_returns_and_successes_of_every_episode(arrival_rate, action, rate):
    env = make_team_env(ENV_ID, n_envs=3, seed=0, env_kwargs={"arrival_rate": arrival_rate})
    outcome = evaluate(Still(action), env, n_episodes=7)
    assert outcome.returns.shape == outcome.successes.shape == (7,)
    assert outcome.success_rate == rate
    assert (outcome.returns == 0).all() if arrival_rate == 0 else (outcome.returns < 0).all()


def test_the_standard_error_is_that_of_a_share():
    outcome = Outcome(np.zeros(100), np.arange(100) < 20)
    assert (outcome.success_rate, outcome.standard_error) == (0.2, pytest.approx(0.04))
    assert Outcome(np.zeros(3), np.array([], dtype=bool)).success_rate is None


def test_the_demo_measures_trains_and_shows(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pygame")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    assert main(["demo", "-n", "1280", "--episodes", "64", "--seed", "1"]) == 0
    said = capsys.readouterr().out
    rates = {name: float(rate) for name, rate in re.findall(r"│ (\w[^│]*?) +│ (\d\.\d+) ±", said)}
    assert {"random", "all gas", "3x3 rule", "belief_ppo before training"} < rates.keys() and len(rates) == 5
    # standard error of 64 episodes: at most 0.06
    assert rates["random"] < 0.2 < rates["all gas"] < 0.6 < 0.85 < rates["3x3 rule"]
    folder = tmp_path / "logs" / "belief_ppo" / f"{ENV_ID}_1"
    for name in ("learning_curve.png", "episode.gif", "team.zip", "evaluations.npz"):
        assert (folder / name).stat().st_size > 0
        assert name == "evaluations.npz" or f"{folder.relative_to(tmp_path) / name}" in said
    assert f"sb3-belief enjoy {folder.relative_to(tmp_path)}" in said
