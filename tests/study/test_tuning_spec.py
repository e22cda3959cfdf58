"""What a file of a tuning may say."""

import pytest
import yaml

from sb3_belief.study.tuning_space import SearchChoices, SearchRange, parse_space
from sb3_belief.study.tuning_spec import load_tuning
from sb3_belief.zoo.errors import ConfigError

GOOD = {
    "algo": "ppo",
    "env": "traffic-junction-easy",
    "params": {"n_envs": 4, "n_steps": 20, "batch_size": 40, "policy_kwargs": {"ortho_init": False}},
    "n_timesteps": 240,
    "evaluation": {"every": 80, "episodes": 4, "copies": 2},
    "search": {
        "learning_rate": {"low": 1e-5, "high": 1e-2, "log": True, "schedule": "linear"},
        "policy_kwargs.net_arch": {"choices": [[8], [16, 16]]},
        "n_epochs": {"low": 1, "high": 3},
    },
}


def written(folder, **changes):
    data = {key: value for key, value in {**GOOD, **changes}.items() if value is not None}
    path = folder / "tiny.yml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_a_space_has_ranges_and_choices():
    space = parse_space(GOOD["search"], "here")
    assert space["learning_rate"] == SearchRange(1e-5, 1e-2, log=True, schedule="linear")
    assert space["n_epochs"] == SearchRange(1, 3)
    assert space["policy_kwargs.net_arch"] == SearchChoices(([8], [16, 16]))
    assert space["learning_rate"].setting(3e-4) == "lin_0.0003"
    assert space["n_epochs"].setting(2) == 2
    assert space["policy_kwargs.net_arch"].setting("[16, 16]") == [16, 16]
    # Scalars stay what they are, and are not read as JSON
    assert SearchChoices(("[8]", "x")).setting("[8]") == "[8]"


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (3e-4, "here: gamma: must be {low: 1e-4, high: 1e-2, log: true} or {choices: [...]}, not 0.0003"),
        ({"low": 1}, "here: gamma: has no 'high'"),
        ({"low": 2, "high": 1}, "here: gamma: low must be less than high, not 2 and 1"),
        ({"low": 0.0, "high": 1.0, "log": True}, "with log: true low must be greater than 0"),
        ({"low": True, "high": 1.0}, "low: must be a finite number, not True"),
        ({"low": 0, "high": float("inf")}, "high: must be a finite number"),
        ({"low": 0, "hihg": 1}, "unknown key 'hihg'. Did you mean 'high'?"),
        ({"low": 0, "high": 1, "log": 1}, "log: must be true or false"),
        ({"low": 1, "high": 8, "step": 0.5}, "step: must be an integer greater than 0"),
        ({"low": 1, "high": 8, "step": 1, "log": True}, "exclude each other"),
        ({"low": 1, "high": 8, "schedule": "cosine"}, "schedule: must be linear"),
        ({"choices": [1]}, "must be a list of at least two settings"),
        ({"choices": [1, 2, 1]}, "1 is there twice"),
        ({"choices": [1, 2], "log": True}, "unknown key beside choices 'log'"),
    ],
)
def test_what_is_no_range_is_refused(entry, message):
    with pytest.raises(ConfigError) as caught:
        parse_space({"gamma": entry}, "here")
    assert message in str(caught.value)


def test_a_setting_within_another_searched_one_is_refused():
    with pytest.raises(ConfigError, match="one contains the other"):
        parse_space({"policy_kwargs": {"choices": [{}, {"a": 1}]}, "policy_kwargs.net_arch": {"choices": [[8], [9]]}}, "here")


def test_the_length_of_runs_cannot_be_searched():
    with pytest.raises(ConfigError, match="same number of joint steps"):
        parse_space({"n_timesteps": {"low": 1, "high": 3}}, "here")


def test_a_specification_has_defaults_and_reads_as_it_was_written(tmp_path):
    spec = load_tuning(written(tmp_path, evaluation=None))
    assert (spec.name, spec.n_trials, spec.objective, spec.seeds) == ("tiny", 50, "return", (1000,))
    assert spec.evaluation == {"every": 25_000, "episodes": 32, "copies": 32}
    (tmp_path / "again").mkdir()
    copy = tmp_path / "again" / "copy.yml"
    copy.write_text(spec.to_yaml())
    assert load_tuning(copy) == spec


def test_a_number_of_seeds_counts_from_1000(tmp_path):
    assert load_tuning(written(tmp_path, seeds=3)).seeds == (1000, 1001, 1002)
    assert load_tuning(written(tmp_path, seeds=[5, 7])).seeds == (5, 7)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algo": None}, "has no 'algo': add it"),
        ({"search": None}, "has no 'search'"),
        ({"search": {}}, "search: must map settings to what is searched"),
        ({"alg": "ppo"}, "unknown key 'alg'. Did you mean 'algo'?"),
        ({"name": "../x"}, "name: '../x' is to be the name of a folder"),
        ({"n_trials": 0}, "n_trials: must be an integer of at least 1, not 0"),
        ({"seeds": [1, 1]}, "seeds: must be a list of different seeds"),
        ({"seeds": []}, "seeds: must be a list of different seeds"),
        ({"objective": "succes"}, "unknown objective 'succes'. Did you mean 'success'?"),
        ({"sampler": {"name": "gp"}}, "sampler: name: unknown sampler 'gp'"),
        ({"pruner": {"name": 1}}, "pruner: name: must be a text"),
        ({"evaluation": {"every": 0}}, "evaluation: every: must be an integer of at least 1"),
        ({"evaluation": {"evry": 10}}, "evaluation: unknown key 'evry'. Did you mean 'every'?"),
        ({"train": {"num_threads": "2"}}, "train: num_threads: must be an integer"),
        ({"train": {"seed": 2}}, "train: unknown key 'seed'"),
        ({"params": {"n_epochs": 2}}, "'n_epochs' is searched, and set in params as well"),
        ({"params": [1]}, "params: must be a mapping of settings"),
    ],
)
def test_a_wrong_specification_is_refused(tmp_path, changes, message):
    path = written(tmp_path, **changes)
    with pytest.raises(ConfigError) as caught:
        load_tuning(path)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algo": "pppo"}, "algo: unknown algorithm 'pppo'"),
        ({"env": "trafic"}, "env: unknown environment 'trafic'"),
        ({"params": {"n_envs": 0}}, "params: n_envs: must be at least 1, not 0"),
        ({"search": {"n_epochs": {"low": 0, "high": 3}}}, "search: n_epochs: must be at least 1, not 0"),
        ({"search": {"gamma": {"low": 0.5, "high": 1.5}}}, "search: gamma: must be in [0, 1], not 1.5"),
        ({"search": {"gamma": {"choices": [0.9, "x"]}}}, "search: gamma: must be a number, not 'x'"),
        (
            {"search": {"policy_kwargs.net_arch": {"choices": [[8], [0]]}}},
            "search: policy_kwargs: net_arch: must be at least 1",
        ),
        ({"search": {"gama": {"low": 0.5, "high": 1.0}}}, "search: unknown key 'gama'. Did you mean 'gamma'?"),
        ({"search": {"learning_rate": {"low": -1, "high": 1.0}}}, "search: learning_rate: must be at least 0, not -1"),
        ({"evaluation": {"every": 241}}, "is more than a run has (240)"),
        ({"last_evaluations": 4}, "a run of 240 joint steps has 3 evaluations, not 4"),
        ({"conf_file": "there_is_none.yml"}, "conf_file: no file 'there_is_none.yml'"),
    ],
)
def test_a_space_that_cannot_be_is_refused_at_the_start(tmp_path, changes, message):
    spec = load_tuning(written(tmp_path, **changes))
    with pytest.raises(ConfigError) as caught:
        spec.check()
    assert str(caught.value).startswith(spec.source) and message in str(caught.value)


def test_what_was_drawn_reaches_the_configuration(tmp_path):
    spec = load_tuning(written(tmp_path))
    spec.check()
    config = spec.config({"learning_rate": 0.001, "policy_kwargs.net_arch": "[16, 16]", "n_epochs": 2})
    assert config.settings["learning_rate"] == "lin_0.001"
    assert config.settings["policy_kwargs"] == {"ortho_init": False, "net_arch": [16, 16]}
    assert (config.settings["n_epochs"], config.n_envs, config.n_timesteps) == (2, 4, 240)
