"""Drawn command lines of ``train``: never a traceback, never code from data, never a run that is left running."""

import shutil

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from tests.field.command_lines import (
    ALGO,
    CODE,
    ENV,
    KEYS,
    NUMBERS,
    OTHERS,
    SMALL,
    TINY,
    VALUES,
    check,
    draws,
    pairs,
    params,
)

pytestmark = pytest.mark.slow


@draws(350)
@given(algo=ALGO, given_pairs=pairs())
@example("dqn", ["n_envs:2", "train_freq:[1, episode]"])
@example("maskable_ppo", [])
@example("ppo", ["callback:stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes"])
def test_settings_on_the_command_line(algo, given_pairs):
    check(["train", *TINY, "--algo", algo, "-params", *params(algo, given_pairs)])


_WORDS = st.one_of(st.sampled_from([*NUMBERS, *OTHERS, *CODE]), st.text(max_size=4))
_PATHS = st.sampled_from(["logs", "a/b/c", "/proc/x", "/etc/hostname", "/etc/hostname/x", "a" * 300, "", ".", "\x00", "x.yml"])
# No number of steps, processes or threads that would only take long
_FLAGS = {
    "-n": st.sampled_from(["8", "0", "-1", "inf", "nan", "1.5", "8e0", "x", "9" * 400, "1e-9"]),
    "--seed": st.sampled_from(["0", "-1", "1e3", "x", str(2**31), "3.5", "0 1 2"]),
    "-f": _PATHS,
    "-tb": _PATHS,
    "--eval-freq": st.sampled_from(["4", "-1", "0", "-2", "x", "inf", "1e15"]),
    "--eval-episodes": st.sampled_from(["1", "0", "x", "nan"]),
    "--n-eval-envs": st.sampled_from(["1", "2", "0", "1e14", "x"]),
    "--save-freq": st.sampled_from(["4", "0", "-1", "-9", "x"]),
    "--vec-env": st.sampled_from(["dummy", "x", ""]),
    "--device": st.sampled_from(["cpu", "auto", "cuda", "cuda:99", "gpu", "meta", "", "x:y", "cpu:-3"]),
    "--num-threads": st.sampled_from(["1", "-1", "0", "1e9", "x"]),
    "--jobs": st.sampled_from(["1", "0", "1e9", "x", "-1"]),
    "--verbose": st.sampled_from(["0", "1", "2", "3", "x"]),
    "--algo": st.one_of(ALGO, _WORDS),
    "--env": st.one_of(
        st.sampled_from(
            f"os:system x/y lbf mpe/x ../x {ENV} sb3_belief.envs:SwitchingConvention torch:load a:b smax/3m".split()
        ),
        _WORDS,
    ),
    "--conf-file": st.sampled_from(["nowhere.yml", "/etc/hostname", "/", "", "\x00", "a" * 300]),
    "--env-kwargs": st.one_of(st.sampled_from(["m:3", "m:1", "K:null", "seed:-1", "x:1", "render_mode:human"]), _WORDS),
    "--eval-env-kwargs": st.one_of(st.sampled_from(["m:4", "m:1", "m:3", "x:1"]), _WORDS),
    "--allow-package": st.sampled_from(["numpy", "nowhere", "", ".", "os"]),
    "-i": st.sampled_from(["nowhere", "/", "/etc/hostname", "", "\x00", "a" * 300]),
    "--trained": st.just("x"),
    "-P": st.none(),
    "--trust": st.none(),
    "--version": st.none(),
    "--help": st.none(),
}


@draws(300)
@given(
    drawn=st.lists(st.sampled_from(sorted(_FLAGS)).flatmap(lambda flag: st.tuples(st.just(flag), _FLAGS[flag])), max_size=3)
)
@example([("-f", "/etc/hostname")])
@example([("-tb", "/proc/tb")])
@example([("-n", "inf")])
def test_flags(drawn):
    words = [word for flag, value in drawn for word in [flag, *([] if value is None else value.split(" "))]]
    check(["train", *TINY, *words, "-params", *SMALL["belief_ppo"]])


def _section(algo):
    small = {}
    for pair in SMALL[algo]:
        key, _, value = pair.partition(":")
        if "." not in key:
            small[key] = int(value)
    return {"n_timesteps": 8, "policy": "MlpPolicy", **small}


_DATA = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-2, 2), st.floats(), st.sampled_from([*CODE, "lin_1", "x", "1:30"])),
    lambda inner: st.one_of(
        st.lists(inner, max_size=2), st.dictionaries(st.one_of(KEYS, st.sampled_from(CODE)), inner, max_size=2)
    ),
    max_leaves=4,
)


@draws(200)
@given(
    algo=st.sampled_from(["ppo", "belief_ppo", "dqn"]),
    section=st.sampled_from([ENV, "default", "nowhere", "os:system"]),
    settings=st.dictionaries(KEYS, _DATA, max_size=2),
    raw=st.one_of(st.none(), st.none(), VALUES),
)
def test_files(algo, section, settings, raw, tmp_path_factory):
    folder = tmp_path_factory.mktemp("file")
    try:
        text = yaml.safe_dump({"default": _section(algo), section: {**_section(algo), **settings}}, allow_unicode=True)
        # A line of raw text after data, as an author might leave it
        text += "" if raw is None else f"  raw: {raw}\n"
        (folder / "mine.yml").write_text(text, encoding="utf-8")
        check(["train", *TINY, "--algo", algo, "--conf-file", "mine.yml"], folder)
    finally:
        shutil.rmtree(folder)
