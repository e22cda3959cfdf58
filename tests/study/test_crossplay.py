"""Cross-play: the diagonal is the plain evaluation, and what it says follows from its table."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_belief.cli.main import main
from sb3_belief.report.adaptation import read_rows
from sb3_belief.report.crossplay import CROSSPLAY_NUMBERS, CROSSPLAY_TEXTS, crossplay_estimates, crossplay_matrix
from sb3_belief.study.crossplay import CrossplayOptions, crossplay
from sb3_belief.study.meetings import Play
from sb3_belief.team import Team, make_team_env
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.evaluate import evaluate
from tests.study.saved_teams import EASY, run_folder, save_team

PLAY = Play(episodes=3, n_envs=2, repetitions=1)


@pytest.fixture(scope="module")
def teams(tmp_path_factory):
    folder = tmp_path_factory.mktemp("teams")
    return [str(save_team(folder, f"team{seed}", seed)) for seed in (0, 1)]


def options_of(runs, folder, **changed):
    given = {"agent": "car_1", "steps": 4, "play": PLAY, "env": EASY, "device": "cpu", **changed}
    return CrossplayOptions(runs[0], runs=tuple(runs), output=str(folder / "out"), **given)


def test_the_diagonal_is_the_plain_evaluation(teams, tmp_path):
    options = options_of(teams, tmp_path)
    Path(options.output).mkdir()
    for name in ("crossplay-800.svg", "notes.txt"):
        (Path(options.output) / name).write_text("of an earlier measurement")
    folder, said = crossplay(options)
    rows = read_rows(folder / "crossplay.csv", CROSSPLAY_TEXTS, CROSSPLAY_NUMBERS)
    matrix = crossplay_matrix(rows, 0)
    for k, path in enumerate(teams):
        env = make_team_env(EASY, n_envs=2, seed=0)
        team = Team.load(path, env=env, device="cpu")
        env.seed(PLAY.episodes_seed(0))
        assert matrix[k, k] == pytest.approx(evaluate(team, env, 3).returns.mean(), rel=1e-6)
    cells = read_rows(folder / "crossplay_matrix.csv", ("run", "others"), ("steps", "return", "return_low", "return_high"))
    assert [cell["return"] for cell in cells[:4]] == matrix.ravel().tolist() and len(cells) == 8
    assert len(rows) == 2 * 2 * 2 and {row["steps"] for row in rows} == {0, 4}
    assert f"{matrix.diagonal().mean():.3g}" in said
    assert {path.name for path in folder.iterdir()} == {
        *("crossplay.csv", "crossplay_matrix.csv", "notes.txt"),
        *(f"crossplay-{steps}{suffix}" for steps in (0, 4) for suffix in (".svg", ".png")),
    }


def test_runs_are_the_unit_of_the_interval():
    found: Any = crossplay_estimates(np.array([[5.0, 1, 3], [0, 7, 2], [4, 4, 9]]))
    assert [found[name].value for name in ("own", "others", "loss")] == pytest.approx([7, 7 / 3, 14 / 3])
    assert found["loss"].n_seeds == 3 and found["loss"].low < found["loss"].value < found["loss"].high


def test_what_cannot_meet_is_refused_before_anything_is_written(teams, tmp_path, capsys):
    one, other = (run_folder(team, tmp_path / name) for team, name in zip(teams, ("one", "other"), strict=True))
    runs = {
        "give at least two runs": [one],
        "a run is given twice": [one, other, one],
        "give runs of one environment": [one, run_folder(teams[1], tmp_path / "medium", "traffic-junction-medium")],
        r"other arguments of traffic-junction-easy: \['vision'\]": [one, run_folder(teams[1], tmp_path / "far", vision=2)],
    }
    # Otherwise the agents of one run would play in the environment of another
    beside = {"partners": {"learners": ["car_0"], "members": {"a": str(teams[0])}}}
    wrapped = {"env_wrapper": "supersuit.agent_indicator_v0"}
    for number, (message, *settings) in enumerate(
        (
            ("other partners", beside, {"partners": {**beside["partners"], "members": {"a": str(teams[1])}}}),
            ("other partners", beside, None),
            ("other env_wrapper", wrapped, None),
            ("other observations besides", {"observe_last": True}, None),
            # These have the same; it is the teams that were trained without
            ("does not fit the saved team", wrapped, wrapped),
        )
    ):
        folders = [tmp_path / f"{number}_{i}" for i in range(2)]
        given = [run_folder(*each) for each in zip(teams, folders, (EASY, EASY), settings, strict=True)]
        with pytest.raises(ConfigError, match=message):
            crossplay(options_of(given, tmp_path, env=None))
    for message, given in runs.items():
        with pytest.raises(ConfigError, match=message):
            crossplay(options_of(given, tmp_path, env=None))
    with pytest.raises(ConfigError, match="unknown agent 'car_9'"):
        crossplay(options_of(teams, tmp_path, agent="car_9"))
    assert main(["crossplay", one, "-o", str(tmp_path / "out")]) == 2
    assert "one team cannot meet another" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
