"""The measure of adapting: steps are counted, weights stay, and who has no history gains nothing by observing."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

from sb3_belief import BeliefPPO
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from sb3_belief.cli.main import main
from sb3_belief.envs.switching_convention.game import convention
from sb3_belief.report.adaptation import NUMBERS, TEAM, TEXTS, adaptation_points, read_rows
from sb3_belief.study import meetings
from sb3_belief.study.adaptation import AdaptOptions, adapt
from sb3_belief.study.meetings import Play
from sb3_belief.study.partner_pool import read_pool
from sb3_belief.team import Team, make_team_env
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.replay import make_shown_env
from tests.study.saved_teams import EASY, TINY, run_folder, save_team

PLAY = Play(episodes=3, n_envs=2, repetitions=2)


@pytest.fixture(scope="module")
def teams(tmp_path_factory):
    """Saved teams that have learned nothing worth mentioning."""
    folder = tmp_path_factory.mktemp("teams")
    return {
        name: save_team(folder, name, seed, belief) for seed, (name, belief) in enumerate([("a", "dynamic"), ("b", "static")])
    }


def options_of(teams, folder, **changed):
    options = AdaptOptions(
        str(teams["a"]), env=EASY, pool=str(teams["b"]), agent="car_1", output=str(folder / "out"), play=PLAY, device="cpu"
    )
    return replace(options, **{"checkpoints": (0, 5, 9), **changed})


def rows_of(folder):
    return read_rows(folder / "out" / "adaptation.csv", TEXTS, NUMBERS)


def test_steps_are_counted_and_nothing_else_changes(teams, tmp_path, monkeypatch):
    remembered, states = [], []
    remember, measure = BeliefPolicyMixin.remember, meetings.Meeting.measure

    def counted(policy, observations, actions, *args, **kwargs):
        remembered.append(len(actions))
        remember(policy, observations, actions, *args, **kwargs)

    def spied(meeting, play, repetition, memory=None):
        weights = {name: value.detach().clone() for name, value in meeting.team.agents["car_1"].policy.named_parameters()}
        before = meeting.team.agents["car_1"].policy.history
        n_before = sum(remembered)
        measured = measure(meeting, play, repetition, memory)
        # An evaluation remembers nothing
        assert sum(remembered) == n_before and meeting.team.agents["car_1"].policy.history[0] is before[0]
        states.append((n_before, before, weights))
        return measured

    monkeypatch.setattr(BeliefPolicyMixin, "remember", counted)
    monkeypatch.setattr(meetings.Meeting, "measure", spied)
    saved = teams["a"].read_bytes()
    adapt(options_of(teams, tmp_path))
    # Two repetitions, of which the second begins with the saved history again
    assert [n for n, *_ in states] == [0, 5, 9, 9, 14, 18]
    histories = [np.concatenate([part.numpy().ravel() for part in history]) for _, history, _ in states]
    assert np.array_equal(histories[0], histories[3]) and not np.array_equal(histories[0], histories[1])
    weights = [{name: value.numpy().tobytes() for name, value in of.items()} for *_, of in states]
    assert all(of == weights[0] for of in weights)
    assert teams["a"].read_bytes() == saved
    assert {row["steps"] for row in rows_of(tmp_path)} == {0, 5, 9}


def test_the_same_seeds_give_the_same_numbers(teams, tmp_path):
    stochastic = replace(PLAY, deterministic=False)
    for name, play in (("one", stochastic), ("two", stochastic), ("three", replace(stochastic, seed=1))):
        np.random.seed(len(name))
        adapt(options_of(teams, tmp_path / name, play=play))
    tables = [(tmp_path / name / "out" / "adaptation.csv").read_text() for name in ("one", "two", "three")]
    assert tables[0] == tables[1] != tables[2]


def test_who_has_no_history_gains_nothing_by_observing(teams, tmp_path):
    """The curve is flat where nothing is remembered, and moves where something is: both play the same steps."""
    curves = {}
    for name, others in (("a", "b"), ("b", "a")):
        env, observed_env = (make_team_env(EASY, n_envs=n, seed=0) for n in (2, 1))
        team, met = (Team.load(teams[each], env=env, device="cpu") for each in (name, others))
        meeting = meetings.Meeting(team, ["car_1"], meetings.Among(team, "car_1", met), env, observed_env)
        found = meeting.adapt((0, 12, 24), PLAY, 0)
        curves[name] = [(each.outcome.returns.tolist(), each.accuracy) for each in found.values()]
    assert curves["b"][0] == curves["b"][1] == curves["b"][2]
    assert curves["a"][0] != curves["a"][2]
    with pytest.raises(ConfigError, match=r"nobody in .* has a belief that a history feeds"):
        adapt(options_of({"a": teams["b"], "b": teams["a"]}, tmp_path))
    assert not (tmp_path / "out").exists()


def test_blind_and_oracle_bound_the_gap(teams, tmp_path):
    _, said = adapt(options_of(teams, tmp_path, blind=str(teams["b"]), oracle="7"))
    rows = rows_of(tmp_path)
    roles = {role: [row for row in rows if row["role"] == role] for role in ("team", "blind", "oracle")}
    assert len(roles["team"]) == 6 and len(roles["blind"]) == len(roles["oracle"]) == 2
    assert {row["return"] for row in roles["oracle"]} == {7.0} and {row["steps"] for row in roles["blind"]} == {0}
    last: Any = next(point for point in adaptation_points(rows) if point.partner == "all" and point.steps == 9)
    own = np.mean([row["return"] for row in roles[TEAM] if row["steps"] == 9])
    blind = np.mean([row["return"] for row in roles["blind"]])
    assert last.share.value == pytest.approx((own - blind) / (7 - blind))
    assert last.regret.value == pytest.approx(7 - own) and "oracle (7" in said
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("adaptation.csv", "adaptation_curve.csv"),
        *(f"{name}{suffix}" for name in ("adaptation", "skill") for suffix in (".svg", ".png")),
    }


def test_each_agent_in_turn_unless_one_is_named(teams, tmp_path):
    adapt(options_of(teams, tmp_path, agent=None, checkpoints=(0,), play=replace(PLAY, repetitions=1)))
    agents = make_team_env(EASY, n_envs=1).possible_agents
    assert [row["agent"] for row in rows_of(tmp_path)] == agents


def test_partners_act_for_those_whom_a_team_has_no_models_for(teams, tmp_path):
    env = make_team_env(EASY, n_envs=2, seed=0)
    rest = [agent for agent in env.possible_agents if agent != "car_0"]
    met = dict.fromkeys(rest, str(teams["b"]))
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, device="cpu", partners=met, **TINY).learn(16)
    team.save(tmp_path / "one.zip")
    pool = tmp_path / "pool.yml"
    still = "sb3_belief.envs.traffic_junction.nobody:brake"
    pool.write_text(yaml.safe_dump({"members": {"a": str(teams["a"]), "b": dict.fromkeys(rest, str(teams["b"]))}}))
    options = options_of(teams, tmp_path, run=str(tmp_path / "one.zip"), pool=str(pool), agent=None)
    adapt(options)
    rows = rows_of(tmp_path)
    assert {(row["partner"], row["type"], row["agent"]) for row in rows} == {("a", "a", ""), ("b", "b", "")}
    by_name = {name: [row["return"] for row in rows if row["partner"] == name] for name in "ab"}
    assert by_name["a"] != by_name["b"]
    with pytest.raises(ConfigError, match="--agent: all agents of the team learn beside these partners"):
        adapt(replace(options, agent="car_0"))
    pool.write_text(yaml.safe_dump({"members": {"still": still}}))
    with pytest.raises(ConfigError, match="still: no module"):
        adapt(options)
    with pytest.raises(ConfigError, match="nobody acts for"):
        adapt(replace(options, pool="level:easy"))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"pool": "nowhere"}, "no file or folder 'nowhere'"),
        ({"pool": "seed:9..3"}, "must go up"),
        ({"pool": "lvl:1..2"}, "unknown key 'lvl'"),
        ({"agent": "car_99"}, "unknown agent 'car_99'"),
        ({"pool": "seed:1,2,1"}, r"\[1\] is given twice"),
        ({"blind": "nowhere"}, "--blind: no file or folder"),
        ({"blind": "nan"}, "--blind: nan is no return"),
        ({"oracle": "inf"}, "--oracle: inf is no return"),
        ({"env": "convention-swap"}, "a.zip' cannot be loaded: The saved team has the agents"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(teams, tmp_path, changed, message):
    with pytest.raises(ConfigError, match=message):
        adapt(options_of(teams, tmp_path, **changed))
    assert not (tmp_path / "out").exists()


def test_a_gap_lies_in_one_environment(teams, tmp_path):
    one = run_folder(teams["a"], tmp_path / "one")
    other = run_folder(teams["b"], tmp_path / "other", "traffic-junction-medium")
    with pytest.raises(ConfigError, match="is of traffic-junction-medium, the team of traffic-junction-easy"):
        adapt(options_of(teams, tmp_path, run=one, env=None, blind=other))


def test_bounds_are_measured_in_the_environments_of_their_own_runs(tmp_path):
    """--env names that of a zip that is in no run; who is told observes more than it."""
    paths = {}
    for name, told in (("plain", False), ("told", True)):
        env = make_team_env("convention-episode", n_envs=2, seed=0, env_kwargs={"reveal_partner": told})
        paths[name] = tmp_path / f"{name}.zip"
        Team(BeliefPPO, "BeliefPolicy", env, seed=0, device="cpu", **TINY).save(paths[name])
    run = run_folder(paths["told"], tmp_path / "run", "convention-episode", reveal_partner=True)
    options = AdaptOptions(str(paths["plain"]), env="convention-episode", pool="partner_seed:3", output=str(tmp_path / "out"))
    adapt(replace(options, play=PLAY, checkpoints=(0, 5), oracle=run))
    assert {row["role"] for row in rows_of(tmp_path)} == {"team", "oracle"}
    with pytest.raises(ConfigError, match="cannot be loaded"):
        adapt(replace(options, play=PLAY, checkpoints=(0, 5), oracle=str(paths["told"])))


@pytest.mark.parametrize("env_id", ["convention-swap", "convention-episode"])
def test_a_partner_of_the_environment_stays_or_is_refused(env_id, tmp_path, monkeypatch):
    env = make_team_env(env_id, n_envs=2, seed=0)
    path = tmp_path / "team.zip"
    Team(BeliefPPO, "BeliefPolicy", env, seed=0, device="cpu", **TINY).save(path)
    made = []

    def shown(environment, *args):
        made.append(environment.env_kwargs)
        return make_shown_env(environment, *args)

    monkeypatch.setattr("sb3_belief.study.adaptation.make_shown_env", shown)
    pool = "seed:3" if env_id == "convention-swap" else "partner_seed:3"
    options = AdaptOptions(str(path), env=env_id, pool=pool, output=str(tmp_path / "out"), play=PLAY, checkpoints=(0, 5))
    adapt(options)
    name = "K" if env_id == "convention-swap" else "redraw_every"
    assert all(kwargs[name] is None for kwargs in made)
    if env_id == "convention-episode":
        with pytest.raises(ConfigError, match="is not one partner but several"):
            adapt(replace(options, env_kwargs=("redraw_every:1", "redraw_unit:episodes", "per_copy:true")))


def test_pools(teams, tmp_path):
    assert [entry.env_kwargs for entry in read_pool("seed:3..5")] == [{"seed": 3}, {"seed": 4}, {"seed": 5}]
    assert [entry.env_kwargs for entry in read_pool("kind:left,2")] == [{"kind": "left"}, {"kind": 2}]
    (only,) = read_pool(str(teams["a"]))
    assert only.partners == str(teams["a"])
    pool = tmp_path / "pool.yml"
    members = {"a": str(teams["a"]), "b": str(teams["b"])}
    pool.write_text(yaml.safe_dump({"learners": ["car_0"], "members": members}))
    assert {entry.name: entry.partners for entry in read_pool(str(pool))} == members
    pool.write_text(yaml.safe_dump({"members": members, "held_out": ["b"]}))
    assert [entry.name for entry in read_pool(str(pool))] == ["b"]
    for content, message in (({"members": {}}, "no members"), ({"members": members, "held_out": ["c"]}, "held out but no")):
        pool.write_text(yaml.safe_dump(content))
        with pytest.raises(ConfigError, match=message):
            read_pool(str(pool))
    pool.write_text(yaml.safe_dump({"members": {"all": str(teams["a"])}}))
    with pytest.raises(ConfigError, match="a member is called 'all'"):
        read_pool(str(pool))
    with pytest.raises(ConfigError, match="no run in"):
        read_pool(str(tmp_path))


def latin_square(m=4):
    """Seeds of conventions of which no two agree at any cue: over these, who cannot tell them is right in 1/m."""
    found: dict[int, np.ndarray] = {}
    for seed in itertools.count(1_000_000):
        drawn = convention(m, seed, 0)
        if all((drawn != other).all() for other in found.values()):
            found[seed] = drawn
        if len(found) == m:
            return list(found)


@pytest.mark.slow
def test_a_dynamic_belief_adapts_to_conventions_that_it_has_not_met(tmp_path, capsys):
    # The YAML entry of the conventions, which is trained for 60 of its 100 rollouts
    env = make_team_env("convention-swap", n_envs=50, seed=0)
    settings: dict[str, Any] = dict(
        n_steps=16, batch_size=400, n_epochs=4, learning_rate=1e-3, gamma=0.0, gae_lambda=0.0, ent_coef=0.01
    )
    sizes = dict(net_arch=[32, 32], embedding_dim=32, latent_dim=16)
    team = Team(BeliefPPO, "BeliefPolicy", env, seed=0, device="cpu", policy_kwargs=sizes, **settings).learn(60 * 800)
    team.save(tmp_path / "follower.zip")
    words = [
        "adapt",
        str(tmp_path / "follower.zip"),
        "--env",
        "convention-swap",
        "--env-kwargs",
        "K:null",
        "-o",
        str(tmp_path / "out"),
    ]
    seeds = ",".join(map(str, latin_square()))
    assert (
        main([*words, "--partners", f"seed:{seeds}", "--steps", "0", "400", "800", "--repetitions", "2", "--blind", "4"]) == 0
    )
    curve: Any = [point for point in adaptation_points(rows_of(tmp_path)) if point.partner == "all"]
    assert curve[0].score.value / 16 == pytest.approx(0.25, abs=0.05) and curve[0].skill.value < 0.1
    assert curve[-1].score.value / 16 > 0.95 and curve[-1].skill.value > 0.6
    assert "after 0 observed steps" in capsys.readouterr().out
