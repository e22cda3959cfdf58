import inspect

import pytest
import yaml
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.utils import LinearSchedule
from torch import nn, optim

from sb3_belief.cli.main import main, train_main
from sb3_belief.envs.registry import registered_ids
from sb3_belief.envs.suites import SUITES
from sb3_belief.zoo import config as config_module
from sb3_belief.zoo.config import REPO_CONFIGS, load_config
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.names import ALGOS
from sb3_belief.zoo.yaml_data import read_file

EASY = "traffic-junction-easy"
MEDIUM = "traffic-junction-medium"


@pytest.fixture
def conf(tmp_path):
    """Write a configuration file of the given sections."""

    def write(text: str) -> str:
        path = tmp_path / "mine.yml"
        path.write_text(text)
        return str(path)

    return write


def committed(algo):
    """What its file has a section for, and what finds the default there."""
    return sorted({*registered_ids(), *read_file(REPO_CONFIGS / f"{algo}.yml")} - {"default"})


@pytest.mark.parametrize("algo, env_id", [(algo, env_id) for algo in ALGOS for env_id in committed(algo)])
def test_every_committed_entry_is_valid(algo, env_id):
    suite = SUITES.get(env_id.partition("/")[0])
    if suite is not None and suite.missing():
        pytest.skip(f"needs {' and '.join(suite.missing())}")
    config = load_config(algo, env_id)
    assert config.n_timesteps > 0
    # what the algorithm is given is what its constructor takes
    inspect.signature(config.algo_class.__init__).bind(None, config.policy, None, **config.algo_kwargs)


def test_every_committed_file_belongs_to_an_algorithm():
    assert {path.stem for path in REPO_CONFIGS.glob("*.yml")} == set(ALGOS)


@pytest.mark.parametrize("env_id", [name for name in read_file(REPO_CONFIGS / "ippo.yml") if name != "default"])
def test_ippo_is_belief_ppo_without_the_belief(env_id):
    belief, none = (load_config(algo, env_id) for algo in ("belief_ppo", "ippo"))
    assert none.algo_class is belief.algo_class
    # widths of the belief do nothing where there is none
    network = belief.algo_kwargs["policy_kwargs"]
    belief.algo_kwargs["policy_kwargs"] = {k: v for k, v in network.items() if k not in ("embedding_dim", "latent_dim")}
    # Schedules are compared by their values, since no two of them are equal
    for config in (belief, none):
        if callable(rate := config.algo_kwargs["learning_rate"]):
            config.algo_kwargs["learning_rate"] = [rate(left) for left in (1.0, 0.5, 0.0)]
    assert none.algo_kwargs == {**belief.algo_kwargs, "belief": "none"}
    assert (none.n_envs, none.n_timesteps, none.env_kwargs) == (belief.n_envs, belief.n_timesteps, belief.env_kwargs)


def test_ippo_has_the_sections_of_belief_ppo():
    assert read_file(REPO_CONFIGS / "ippo.yml").keys() == read_file(REPO_CONFIGS / "belief_ppo.yml").keys()


def test_sources_are_merged_in_order(conf):
    path = conf(f"""
default:
  n_timesteps: 1000
  policy: MlpPolicy
  n_steps: 8
  gamma: 0.9
  policy_kwargs: {{ortho_init: false, net_arch: [8]}}
  env_wrapper: {{supersuit.dtype_v0: {{dtype: float32}}}}
{EASY}:
  gamma: 0.8
  policy_kwargs: {{net_arch: [16]}}
  env_kwargs: {{reward_scale: 0.5, vision: 2}}
  env_wrapper: supersuit.frame_stack_v1
""")
    config = load_config("ppo", EASY, path, params=["gamma:0.7"], env_kwargs=["vision:0"], n_timesteps=5)
    assert config.settings == {
        "n_timesteps": 5,
        "policy": "MlpPolicy",
        "n_steps": 8,
        "gamma": 0.7,
        "policy_kwargs": {"ortho_init": False, "net_arch": [16]},
        "env_kwargs": {"reward_scale": 0.5, "vision": 0},
        "env_wrapper": "supersuit.frame_stack_v1",
    }
    assert config.algo_kwargs == {"n_steps": 8, "gamma": 0.7, "policy_kwargs": {"ortho_init": False, "net_arch": [16]}}
    assert load_config("ppo", MEDIUM, path).algo_kwargs["gamma"] == 0.9  # no section of its own


def test_what_a_run_writes_configures_the_same_run(conf):
    first = load_config("belief_ppo", MEDIUM, params=["learning_rate:lin_3e-4", "policy_kwargs.activation_fn:torch.nn.ReLU"])
    again = load_config("belief_ppo", MEDIUM, conf(first.to_yaml()))
    assert again.settings == first.settings
    assert repr(again.algo_kwargs) == repr(first.algo_kwargs)


@pytest.mark.parametrize("key", ["learning_rate", "clip_range", "clip_range_vf"])
def test_schedules_go_wherever_they_are_accepted(key):
    schedule = load_config("ppo", EASY, params=[f"{key}:lin_0.2"]).algo_kwargs[key]
    assert isinstance(schedule, LinearSchedule)
    assert [schedule(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([0.2, 0.1, 0.0])


@pytest.mark.parametrize("key", ["gamma", "ent_coef", "n_steps", "target_kl"])
def test_schedules_go_nowhere_else(key):
    with pytest.raises(ConfigError, match=f"-params: {key}: must be "):
        load_config("ppo", EASY, params=[f"{key}:lin_0.2"])


@pytest.mark.parametrize(
    ("algo", "pair", "value"),
    [
        ("ppo", "learning_rate:3e-4", 3e-4),
        ("ppo", "learning_rate:1", 1.0),
        ("ppo", "n_steps:1e2", 100),
        ("ppo", "target_kl:null", None),
        ("ppo", "normalize_advantage:no", False),
        ("sac", "ent_coef:auto_0.1", "auto_0.1"),
        ("sac", "ent_coef:0.1", 0.1),
        ("dqn", "train_freq:4", 4),
        ("dqn", "train_freq:[1, episode]", (1, "episode")),
        ("ppo", "policy_kwargs.net_arch:{pi: [8], vf: [16]}", {"net_arch": {"pi": [8], "vf": [16]}}),
        ("ppo", "policy_kwargs.activation_fn:torch.nn.ReLU", {"activation_fn": nn.ReLU}),
        ("ppo", "policy_kwargs.optimizer_class:torch.optim.RMSprop", {"optimizer_class": optim.RMSprop}),
    ],
)
def test_values_become_what_the_constructor_wants(algo, pair, value):
    name = pair.partition(":")[0].partition(".")[0]
    found = load_config(algo, MEDIUM, params=[pair, "n_envs:1"]).algo_kwargs[name]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("section", "messages"),
    [
        ("n_step: 3", ["unknown key 'n_step'", "Did you mean 'n_steps'", "batch_size"]),
        ("n_steps: '128'", ["n_steps: must be an integer, not '128' (str)"]),
        ("n_steps: 1.5", ["n_steps: must be an integer, not 1.5"]),
        ("n_steps: true", ["n_steps: must be an integer, not True"]),
        ("gamma: '0.9'", ["gamma: must be a number, not '0.9'"]),
        ("learning_rate: lin_fast", ["learning_rate: must be a number or a schedule such as lin_3e-4"]),
        ("learning_rate: func_3e-4", ["learning_rate: must be a number or a schedule such as lin_3e-4"]),
        ("normalize: 'yes please'", ["normalize: must be true or false or a mapping"]),
        ("n_envs: 0", ["n_envs: must be at least 1"]),
        ("n_timesteps: -5", ["n_timesteps: must be at least 1"]),
        ("policy: MlpPolcy", ["unknown policy 'MlpPolcy'", "Did you mean 'MlpPolicy'"]),
        ("policy_kwargs: {net_arc: [8]}", ["policy_kwargs: unknown key 'net_arc'", "'net_arch'"]),
        ("policy_kwargs: {net_arch: 8}", ["policy_kwargs: net_arch: must be a list"]),
        ("policy_kwargs: {use_sde: true}", ["'use_sde' cannot be set here: set it beside policy_kwargs"]),
        ("policy_kwargs: {activation_fn: torch.optim.Adam}", ["activation_fn: 'torch.optim.Adam' is not a subclass"]),
        ("env_kwargs: {arival_rate: 0.1}", ["env_kwargs: unknown key 'arival_rate'", "'arrival_rate'"]),
        ("env_kwargs: {arrival_rate: high}", ["arrival_rate: must be a number or null, not 'high'"]),
        ("seed: 3", ["'seed' cannot be set here: use the flag --seed"]),
        ("device: cpu", ["'device' cannot be set here: use the flag --device"]),
        ("callback: stable_baselines3.PPO", ["PPO is not a callback"]),
        (
            "callback: {stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes: {max_episode: 3}}",
            ["unknown key 'max_episode'", "'max_episodes'"],
        ),
        ("env_wrapper: {supersuit.frame_stack_v1: {stack_sise: 3}}", ["unknown key 'stack_sise'", "'stack_size'"]),
        ("n_steps: 1\n  n_steps: 2", ["duplicate key 'n_steps'"]),
        ("n_steps: !!python/object/apply:os.getcwd []", ["tag"]),
        ("3: 4", ["key 3 is not a name"]),
    ],
)
def test_settings_that_are_refused(section, messages, conf, tmp_path, monkeypatch, capsys):
    policy = "" if section.startswith("policy:") else "policy: MlpPolicy"
    path = conf(f"default:\n  n_timesteps: 8\n  {policy}\n{EASY}:\n  {section}\n")
    monkeypatch.chdir(tmp_path)
    assert train_main(["--algo", "ppo", "--env", EASY, "--conf-file", path]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"Refused: {path}")
    for message in messages:
        assert message in said
    assert [file.name for file in tmp_path.iterdir()] == ["mine.yml"]  # nothing was made


@pytest.mark.parametrize(
    ("words", "messages"),
    [
        (["--algo", "beleif_ppo"], ["--algo: unknown algorithm", "'belief_ppo'", "recurrent_ppo"]),
        (["--env", "traffic-junction-medum"], ["--env: unknown environment", "'traffic-junction-medium'"]),
        (["-params", "n_step:8"], ["-params: unknown key 'n_step'", "'n_steps'"]),
        (["-params", "history_length:long"], ["-params: history_length: must be an integer, not 'long'"]),
        (["--env-kwargs", "visoin:1"], ["--env-kwargs: env_kwargs: unknown key 'visoin'", "'vision'"]),
        (["--conf-file", "nowhere.yml"], ["--conf-file: no file 'nowhere.yml'"]),
        (
            ["--algo", "ippo", "-params", "belief:dynamic"],
            ["'belief' cannot be set here: the algorithm's name stands for belief='none'"],
        ),
        (["--env-kwargs", "arrival_rate:2"], ["refuses its settings", "arrival_rate"]),
        (["-params", "keep_ratio:7"], ["cannot be set up", "keep_ratio"]),
        (["--algo", "sac"], ["sac cannot be set up on traffic-junction-medium", "action space"]),
        (["-i", "nowhere.zip"], ["--trained-agent: no file or folder 'nowhere.zip'"]),
    ],
)
def test_words_that_are_refused(words, messages, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", *words]) == 2
    said = capsys.readouterr().err
    for message in messages:
        assert message in said
    assert list(tmp_path.iterdir()) == []


def test_a_section_of_an_unknown_environment_is_refused(conf):
    path = conf("traffic-junction-eazy: {n_timesteps: 3}\n")
    with pytest.raises(ConfigError, match=r"mine\.yml: unknown environment 'traffic-junction-eazy'.*'traffic-junction-easy'"):
        load_config("ppo", EASY, path)


def test_a_file_without_a_fitting_section_is_refused(conf):
    with pytest.raises(ConfigError, match=f"has no section '{EASY}' and no section 'default'; it has {MEDIUM}"):
        load_config("ppo", EASY, conf(f"{MEDIUM}: {{n_timesteps: 3, policy: MlpPolicy}}\n"))


@pytest.mark.parametrize("key", ["policy", "n_timesteps"])
def test_what_is_needed_is_asked_for(key, conf):
    settings = {"policy": "MlpPolicy", "n_timesteps": 10}
    del settings[key]
    with pytest.raises(ConfigError, match=f"no '{key}' for '{EASY}'"):
        load_config("ppo", EASY, conf(yaml.safe_dump({EASY: settings})))


@pytest.mark.parametrize(
    "path",
    [
        "os.system",
        "subprocess.Popen",
        "builtins.eval",
        "torch.load",
        "torchvision.ops.nms",
        "stable_baselines3.common.utils.os.system",
        "stable_baselines3.common.utils.os",
        "stable_baselines3.common.save_util.base64.b64decode",
        "stable_baselines3.common.save_util.zipfile",
        "supersuit_evil.frame_stack_v1",
        "supersuit.frame_stack_v9",
        "supersuit.__version__",
        "supersuit",
        "__import__('os').system",
        "supersuit..frame_stack_v1",
    ],
)
def test_wrappers_come_from_the_allow_list_only(path):
    with pytest.raises(ConfigError, match=r"^-params: env_wrapper: .*(not of an allowed package|no |not a )"):
        load_config("ppo", EASY, params=[f'env_wrapper:"{path}"'])


def test_the_allow_list_is_extended_by_who_types_the_command(tmp_path, monkeypatch):
    (tmp_path / "junction_extras.py").write_text("def same(env, times=1):\n    return env\n")
    monkeypatch.syspath_prepend(tmp_path)
    params = ["env_wrapper:{junction_extras.same: {times: 2}}"]
    with pytest.raises(ConfigError, match=r"'junction_extras\.same' is not of an allowed package.*--allow-package"):
        load_config("ppo", EASY, params=params)
    wrapper = load_config("ppo", EASY, params=params, extra_packages=("junction_extras",)).wrapper
    assert wrapper is not None and wrapper("an env") == "an env"


def test_visibility_is_a_function_with_its_arguments(tmp_path, monkeypatch):
    (tmp_path / "junction_sight.py").write_text("def nearby(env, radius=1):\n    return env, radius\n")
    monkeypatch.syspath_prepend(tmp_path)

    def load(value):
        return load_config("ppo", EASY, params=[f"visibility:{value}"], extra_packages=("junction_sight",))

    assert load_config("ppo", EASY).visibility is None and load("null").visibility is None
    sight = load("{junction_sight.nearby: {radius: 3}}").visibility
    assert sight is not None and sight("an env") == ("an env", 3)
    with pytest.raises(ConfigError, match=r"-params: visibility: junction_sight.nearby: unknown key 'radios'.*'radius'"):
        load("{junction_sight.nearby: {radios: 3}}")
    with pytest.raises(ConfigError, match=r"-params: visibility: must name one function, not 2"):
        load("{junction_sight.nearby: {}, supersuit.dtype_v0: {dtype: int8}}")
    with pytest.raises(ConfigError, match=r"'junction_sight.nearby' is not of an allowed package"):
        load_config("ppo", EASY, params=["visibility:junction_sight.nearby"])


def test_callbacks_are_named_with_their_arguments():
    name = "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"
    config = load_config("ppo", EASY, params=[f"callback:[{{{name}: {{max_episodes: 3}}}}]"])
    assert config.callbacks == ((StopTrainingOnMaxEpisodes, {"max_episodes": 3}),)


def test_code_in_a_text_stays_a_text():
    config = load_config("sac", EASY, params=["ent_coef:__import__('os')"])
    assert config.algo_class is SAC and config.algo_kwargs["ent_coef"] == "__import__('os')"


def test_configurations_are_found_beside_the_installed_package(tmp_path, monkeypatch):
    installed = tmp_path / "share" / "sb3-belief" / "zoo_configs" / "ppo.yml"
    installed.parent.mkdir(parents=True)
    installed.write_text((REPO_CONFIGS / "ppo.yml").read_text())

    class File:
        def match(self, pattern):
            return installed.match(pattern)

        def locate(self):
            return installed

    monkeypatch.setattr(config_module, "REPO_CONFIGS", tmp_path / "no checkout")
    monkeypatch.setattr(config_module.metadata, "files", lambda name: [File()])
    assert load_config("ppo", EASY).source == str(installed)
    assert load_config("ppo", EASY).algo_class is PPO
    with pytest.raises(ConfigError, match=r"No a2c\.yml .*--conf-file"):
        load_config("a2c", EASY)
