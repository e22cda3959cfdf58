"""What the file of a study says, and what is refused with file and line."""

import re
from contextlib import nullcontext

import pytest
import yaml

from sb3_belief.cli.main import main
from sb3_belief.study.checks import check_study
from sb3_belief.study.specification import load_study
from sb3_belief.study.study_folder import planned_cells
from sb3_belief.zoo.errors import ConfigError
from tests.study.tiny import EASY, TINY, write

FILE = """\
environments:
  traffic-junction-easy: {env_kwargs: {reward_scale: 0.5}}
  convention-swap:
algorithms:
  ippo:
  dynamic: {algo: belief_ppo}
  ce: {algo: belief_ppo, params: {action_loss: cross_entropy, gamma: 0.5}}
seeds: [3, 5]
n_timesteps: 1e5
evaluation: {every: 1000}
baseline: ippo
ablations: {"Fig. 5a": [ippo, dynamic]}
exclude: [{arm: ce, environment: convention-swap}]
train: {save_every: 10m, num_threads: 2}
"""


def read(tmp_path, text):
    path = tmp_path / "my_study.yml"
    path.write_text(text)
    return load_study(path)


def test_the_whole_matrix(tmp_path):
    study = read(tmp_path, FILE)
    assert study.name == "my_study" and study.seeds == (3, 5) and study.n_timesteps == 100_000
    assert study.pairs() == [
        *((arm, EASY) for arm in ("ippo", "dynamic", "ce")),
        *((arm, "convention-swap") for arm in ("ippo", "dynamic")),
    ]
    assert study.evaluation.every == 1000 and study.evaluation.final_episodes == 320
    assert study.train == {"save_every": 600.0, "num_threads": 2} and study.ablations == {"Fig. 5a": ("ippo", "dynamic")}
    # What is written into the folder reads as the same study
    again = read(tmp_path, yaml.safe_dump(study.to_data(), sort_keys=False))
    assert again.to_data() == study.to_data() and again.pairs() == study.pairs()


def test_lists_leave_out_all_their_pairs(tmp_path):
    lists = (
        "exclude: [{arm: [ce, ippo], environment: [convention-swap]}, {arm: dynamic, environment: [traffic-junction-easy]}]"
    )
    study = read(tmp_path, FILE.replace("exclude: [{arm: ce, environment: convention-swap}]", lists))
    assert study.pairs() == [("ippo", EASY), ("ce", EASY), ("dynamic", "convention-swap")]
    with pytest.raises(ConfigError, match=r"line 13: exclude: arm: unknown"):
        read(tmp_path, FILE.replace("arm: ce,", "arm: [ippo, c],"))


def test_overrides_come_in_order(tmp_path):
    study = read(tmp_path, FILE.replace("reward_scale: 0.5}}", "reward_scale: 0.5}, gamma: 0.7, n_timesteps: 7000}"))
    plain, own = (study.config(arm, EASY) for arm in ("dynamic", "ce"))
    # The entry of the configuration file, the study, the environment, the algorithm
    assert plain.n_envs == 32 and plain.n_timesteps == 7000 and plain.algo_kwargs["gamma"] == 0.7
    assert own.algo_kwargs["gamma"] == 0.5 and own.algo_kwargs["action_loss"] == "cross_entropy"
    assert own.env_kwargs == {"reward_scale": 0.5}
    assert study.config("ippo", "convention-swap").n_timesteps == 100_000


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "algo: belief_ppo, params",
            "algo: belief_pp, params",
            r"line 7: algorithms: ce: algo: unknown algorithm.*'belief_ppo'",
        ),
        ("  ippo:\n", "  mine:\n", r"line 5: algorithms: mine: has no key 'algo'"),
        ("action_loss:", "action_los:", r"line 7: algorithms: ce: params: unknown key 'action_los'.*'action_loss'"),
        ("cross_entropy", "cross", r"line 7: algorithms: ce: .*cross"),
        (
            "convention-swap",
            "convention-swop",
            r"line 3: environments: unknown environment 'convention-swop'.*convention-swap",
        ),
        ("reward_scale: 0.5", "reward_scal: 0.5", r"line 2: environments: .*reward_scal"),
        ("seeds: [3, 5]", "seeds: [3, 3]", r"line 8: seeds: has a seed twice"),
        ("seeds: [3, 5]", "seeds: 0", r"line 8: seeds: must be a whole number"),
        ("seeds: [3, 5]", "seed: 5", r"line 8: unknown key 'seed'.*'seeds'"),
        ("baseline: ippo", "baseline: ipo", r"line 11: baseline: unknown algorithm of this study 'ipo'.*'ippo'"),
        ("every: 1000", "evry: 1000", r"line 10: evaluation: unknown key 'evry'"),
        ("arm: ce,", "arm: c,", r"line 13: exclude: arm: unknown"),
        ("10m", "soon", r"line 14: train: save_every: must be a time"),
        ("num_threads: 2", "trust: true", r"line 14: train: unknown key 'trust'"),
        ("gamma: 0.5", "gamma: 0.5, gamma: 0.6", r"line 7: duplicate key 'gamma'"),
        ("baseline: ippo", "name: ../up", r"line 11: name: .*cannot be the name of a folder"),
    ],
)
def test_what_does_not_fit_is_said_with_its_line(tmp_path, capsys, old, new, message):
    assert old in FILE
    path, folder = tmp_path / "my_study.yml", tmp_path / "logs"
    path.write_text(FILE.replace(old, new))
    assert main(["study", str(path), "-f", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(message, error), error
    assert not folder.exists()


def test_an_environment_of_the_last_row_is_refused_before_the_first_run(tmp_path):
    algorithms = {"ippo": {}, "masked": {"algo": "maskable_ppo"}}
    path = write(tmp_path, environments=["convention-swap"], algorithms=algorithms)
    with pytest.raises(ConfigError, match=r"masked: maskable_ppo needs action masks"):
        check_study(load_study(path), tmp_path / "logs")


def test_a_run_that_would_never_be_evaluated_is_refused(tmp_path):
    path = write(tmp_path, evaluation={"every": 500})
    with pytest.raises(ConfigError, match=r"every: 500 joint steps are more than the 400"):
        check_study(load_study(path), tmp_path / "logs")


def test_a_dry_run_shows_the_matrix_and_writes_nothing(tmp_path, capsys):
    path = write(tmp_path, seeds=3)
    assert main(["study", str(path), "-f", str(tmp_path / "logs"), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert "3 runs of 1,200 joint steps together" in shown and "2 x 4 episodes while training, 4 x 6 at the end" in shown
    assert list(tmp_path.iterdir()) == [path]


def test_an_unwritable_folder_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["study", str(write(tmp_path)), "-f", str(tmp_path / "file")]) == 2
    assert "-f: cannot write in the folder" in capsys.readouterr().err


def test_missing_extras_are_said(tmp_path, capsys, monkeypatch):
    import sb3_belief.study.checks as checks

    real = checks.find_spec
    for name, words in (("pyarrow", "'sb3-belief[study]'"), ("ray", "'sb3-belief[ray]'")):
        monkeypatch.setattr(checks, "find_spec", lambda each, name=name: None if each == name else real(each))
        engine = ["--engine", "ray"] if name == "ray" else []
        assert main(["study", str(write(tmp_path)), "-f", str(tmp_path / "logs"), *engine]) == 2
        assert f"pip install {words}" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_aliases_and_merges_keep_their_lines(tmp_path):
    text = yaml.safe_dump(TINY, sort_keys=False)
    study = read(tmp_path, text.replace("algorithms:\n", "algorithms:\n  a: &a {algo: ppo}\n  b: *a\n"))
    assert study.arms["b"].algo == "ppo" and "line" in study.arms["b"].where


SEEDED = """\
environments: [aisle-sides]
algorithms:
  ippo:
  told: {algo: ippo, params: {env_kwargs: {reveal_partner: true}}}
seeds: [3, 5]
seed_env_kwarg: partner_seed
"""


def test_each_seed_meets_others(tmp_path):
    study = read(tmp_path, SEEDED)
    assert read(tmp_path, yaml.safe_dump(study.to_data())).seed_env_kwarg == "partner_seed"
    checked = check_study(study, tmp_path / "logs")
    planned = planned_cells(study, tmp_path / "logs", checked.configs)
    assert [(each.record["arm"], each.record["settings"]["env_kwargs"]) for each in planned] == [
        ("ippo", {"partner_seed": 3}),
        ("told", {"reveal_partner": True, "partner_seed": 3}),
        ("ippo", {"partner_seed": 5}),
        ("told", {"reveal_partner": True, "partner_seed": 5}),
    ]


@pytest.mark.parametrize(
    "name, message",
    [
        ("7", "seed_env_kwarg: must be the name of an argument of the environments, not 7"),
        ("reveal_partner", "seed_env_kwarg: 'reveal_partner' is set by env_kwargs of 'told' in 'aisle-sides' already"),
        ("partner_sed", "seed_env_kwarg: aisle-sides refuses its settings: .*unexpected keyword argument 'partner_sed'"),
    ],
)
def test_an_argument_for_the_seed_that_does_not_fit(tmp_path, name, message):
    with pytest.raises(ConfigError, match=message):
        check_study(read(tmp_path, SEEDED.replace("partner_seed", name)), tmp_path / "logs")
    assert not (tmp_path / "logs").exists()


BESIDE = {"learners": ["car_0"], "members": {"waits": "tests.study.tiny:waits"}}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        # Whoever stands beside an arm without partners, or one with others, has an environment of its own
        ({"algo": "ppo", "params": {"partners": {**BESIDE, "learners": ["car_99"]}}}, r"has no \['car_99'\]"),
        ({"algo": "ppo", "params": {"partners": BESIDE, "agent_kwargs": {"car_1": {"n_steps": 8}}}}, "'car_1'"),
        ({"algo": "ppo", "params": {"partners": BESIDE}}, None),
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_arms_may_have_partners_of_their_own(tmp_path, settings, message, first):
    others = {"plain": {"algo": "ppo", "params": {"agent_kwargs": {"car_1": {"n_steps": 8}}}}}
    arms = {"beside": settings, **others} if first else {**others, "beside": settings}
    path = write(tmp_path, environments={EASY: TINY["environments"][EASY]}, algorithms=arms)
    with pytest.raises(ConfigError, match=message) if message else nullcontext():
        check_study(load_study(path), tmp_path / "logs", ("tests",))
