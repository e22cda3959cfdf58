"""Drawn command lines, and what must be true of each: it runs, or it is refused and leaves nothing behind."""

import contextlib
import io
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from sb3_belief.cli.main import main
from sb3_belief.zoo.names import ALGOS
from sb3_belief.zoo.settings import RUN_KEYS

ENV = "convention-swap"
#: A run of eight steps
TINY = ["--env", ENV, "-n", "8", "--eval-freq", "-1", "--verbose", "0", "--seed", "0"]
_SMALL = ["n_envs:1", "policy_kwargs.net_arch:[4]"]
_OFF_POLICY = [*_SMALL, "learning_starts:2", "batch_size:2", "buffer_size:20", "train_freq:1"]
_PPO = [*_SMALL, "n_steps:4", "batch_size:4", "n_epochs:1"]
#: Settings of each algorithm with which a run is over at once
SMALL = {
    **{algo: _OFF_POLICY for algo in ALGOS},
    **{algo: _PPO for algo in ("ppo", "maskable_ppo", "recurrent_ppo")},
    **{algo: [*_PPO, "history_length:8"] for algo in ("belief_ppo", "ippo", "maskable_belief_ppo")},
    "a2c": [*_SMALL, "n_steps:4"],
    "trpo": [*_SMALL, "n_steps:4", "batch_size:4"],
    "x": [],
}
#: A name that exists as a folder as soon as one of the values below is run as code
MADE = "made_by_code"

CODE = (
    f"!!python/object/apply:os.mkdir [{MADE}]",
    f"!!python/object/new:os.mkdir [{MADE}]",
    f"!!python/name:os.mkdir {MADE}",
    "!!python/module:os",
    f"__import__('os').mkdir('{MADE}')",
    f"lambda: __import__('os').mkdir('{MADE}')",
    "os.mkdir",
    f"{{os.mkdir: {{path: {MADE}}}}}",
    f"{{builtins.exec: {{source: \"open('{MADE}', 'w')\"}}}}",
    "subprocess.Popen",
    "torch.load",
    "stable_baselines3.common.utils.os.mkdir",
    f"{{stable_baselines3.common.save_util.pathlib.Path.mkdir: {{self: {MADE}}}}}",
    f"${{mkdir {MADE}}}",
)
NUMBERS = (
    *"0 -1 1 2 3 0.5 1.5 -0.5 1e1 nan inf .nan .inf -.inf 1e400 -3 010 1:30 0x10 0b11 1_0 '3'".split(),
    *"lin_1 lin_nan lin_-1 lin_ auto auto_nan auto_x".split(),
    "9" * 5000,
)
OTHERS = (
    *"true null [] {} [1] [1,step] [1,episode] [0,step] [1,2,3] x ' { ] *a 2026-11-28 é %".split(),
    *("", " ", "{a: 1}", "{a: {b: c}}", "&a [*a]", "- 1", "a: b: c", "? x", "!!set {a}", "!!bool x", "\x00", "\n"),
)
#: Values of settings, of every kind
VALUES = st.one_of(st.sampled_from(NUMBERS), st.sampled_from(OTHERS), st.sampled_from(CODE), st.text(max_size=6))

_ARGUMENTS = (
    "learning_rate n_steps batch_size n_epochs gamma gae_lambda clip_range clip_range_vf normalize_advantage ent_coef vf_coef"
    " max_grad_norm use_sde sde_sample_freq rollout_buffer_class rollout_buffer_kwargs target_kl stats_window_size belief"
    " history_length keep_ratio action_coef kl_coef action_loss policy_latent similarity detach_belief buffer_size tau"
    " learning_starts train_freq gradient_steps replay_buffer_class replay_buffer_kwargs optimize_memory_usage"
    " target_update_interval exploration_fraction exploration_initial_eps exploration_final_eps seed device verbose env"
).split()
_NESTED = (
    "policy_kwargs.net_arch policy_kwargs.activation_fn policy_kwargs.optimizer_class policy_kwargs.optimizer_kwargs.eps"
    " policy_kwargs.embedding_dim policy_kwargs.latent_dim policy_kwargs.log_std_init policy_kwargs.features_extractor_class"
    " normalize.gamma normalize.clip_obs normalize.norm_obs normalize.norm_obs_keys normalize.epsilon env_kwargs.m"
    " env_kwargs.K env_kwargs.rewarded env_kwargs.rollout_steps agent_kwargs.follower.algo agent_kwargs.follower.policy"
    " agent_kwargs.follower.gamma agent_kwargs.nobody.gamma agent_kwargs.follower eval_env_kwargs.m a.b.c callback..x ."
).split()
KEYS = st.one_of(st.sampled_from([*RUN_KEYS, *_ARGUMENTS, *_NESTED]), st.text(max_size=5))


_FITTING = st.sampled_from(
    "learning_rate:lin_1e-3 learning_rate:0 gamma:1 gamma:0 n_envs:2 n_steps:3 batch_size:2 batch_size:1 ent_coef:-1 vf_coef:0"
    " max_grad_norm:1e-9 gae_lambda:0 normalize:true normalize.clip_obs:0.1 stats_window_size:1 use_sde:true target_kl:1e-9"
    " env_kwargs.m:2 env_kwargs.K:null env_kwargs.rollout_steps:1 eval_env_kwargs.m:4 belief:none belief:wide belief:context"
    " policy_kwargs.net_arch:[] policy_kwargs.net_arch:{pi:[2],vf:[]} policy_kwargs.activation_fn:torch.nn.ReLU keep_ratio:1"
    " policy_kwargs.optimizer_class:torch.optim.SGD policy:MlpPolicy agent_kwargs.follower.gamma:0.5 callback:null"
    " agent_kwargs.follower:{algo:ppo,policy:MlpPolicy,n_steps:2,batch_size:2} env_wrapper:supersuit.agent_indicator_v0"
    " callback:stable_baselines3.common.callbacks.ProgressBarCallback target_update_interval:1 exploration_fraction:0"
    " callback:{stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes:{max_episodes:1}} history_length:1 train_freq:3"
    " gradient_steps:-1 optimize_memory_usage:true n_timesteps:5 n_epochs:2 clip_range_vf:0.1 clip_range:lin_0.1".split()
).map(lambda pair: pair.replace(":", ": ").replace(": ", ":", 1))


def pairs(most: int = 3) -> st.SearchStrategy[list[str]]:
    """``key:value`` words, most of which nobody could mean and some of which fit."""
    drawn = st.one_of(_FITTING, _FITTING, st.tuples(KEYS, VALUES).map(":".join))
    return st.lists(drawn, max_size=most, unique_by=lambda pair: pair.partition(":")[0])


def params(algo: str, given: list[str]) -> list[str]:
    """Return the words after ``-params``: those given, and the small sizes that they leave out."""
    keys = {pair.partition(":")[0] for pair in given}
    return [*given, *(pair for pair in SMALL[algo] if pair.partition(":")[0] not in keys)]


ALGO = st.sampled_from(["belief_ppo"] * 8 + ["ippo", "ppo", "a2c", "dqn"] * 3 + [*ALGOS, "x"])


def draws(most: int) -> settings:
    """Settings of a property: the same examples in every run, and no time limit, since an example may be a training."""
    return settings(
        max_examples=most,
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=list(HealthCheck),
    )


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    # contextlib.chdir needs Python 3.11
    old = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(old)


def check(argv: list[str], before: Path | None = None) -> int:
    """
    Run a command in an empty folder (or a copy of ``before``) and check what it leaves.

    :return: The exit status
    """
    home = Path(tempfile.mkdtemp())
    try:
        if before is not None:
            shutil.copytree(before, home, dirs_exist_ok=True)
        there = sorted(home.rglob("*"))
        out, err = io.StringIO(), io.StringIO()
        with _inside(home), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                status = main(argv)
            except SystemExit as stop:
                status = int(stop.code or 0)
        said = out.getvalue() + err.getvalue()
        assert status in (0, 1, 2), (argv, status, said)
        assert "Traceback" not in said, (argv, said)
        assert not list(home.rglob(f"*{MADE}*")) or any(MADE in path.name for path in there), argv
        if status == 2:
            assert err.getvalue().startswith("Refused: "), (argv, said)
            assert sorted(home.rglob("*")) == there, argv
        else:
            for record in set(home.rglob("run.json")) - set(there):
                assert json.loads(record.read_text())["status"] == "finished", argv
        return status
    finally:
        shutil.rmtree(home)


def refused(words, tmp_path, monkeypatch, capsys):
    """What is said about a refused command; nothing may be written."""
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    try:
        status = main(words)
    except SystemExit as stop:
        status = int(stop.code or 0)
    said = capsys.readouterr()
    assert status == 2 and said.err.startswith("Refused: "), said
    assert sorted(tmp_path.rglob("*")) == before
    return said.err
