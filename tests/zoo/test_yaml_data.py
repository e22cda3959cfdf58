import os

import pytest

from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.yaml_data import merge, parse, parse_pairs, read_file


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3e-4", 3e-4),
        ("1E5", 1e5),
        (".5e-2", 5e-3),
        ("-1e3", -1e3),
        ("2.5e-4", 2.5e-4),
        ("3", 3),
        ("0.1", 0.1),
        ("lin_3e-4", "lin_3e-4"),
    ],
)
def test_numbers_are_read_as_everyone_writes_them(text, value):
    parsed = parse(text, "here")
    assert parsed == value and type(parsed) is type(value)


def test_quoted_numbers_stay_text():
    assert parse("'3e-4'", "here") == "3e-4"


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.mkdir [made]",
        "!!python/object:subprocess.Popen {}",
        "!!python/name:os.system ''",
        "a: !!python/module:os",
        "!custom 3",
    ],
)
def test_tags_make_no_objects(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"here, line 1: .*tag"):
        parse(text, "here")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("text", ["__import__('os').mkdir('made')", "dict(net_arch=[64])", "lambda x: x", "${HOME}"])
def test_code_stays_text(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parsed = parse(f"value: >-\n  {text}", "here")
    assert parsed == {"value": text}
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("text", "line"), [("a: 1\nb: 2\na: 3", 3), ("a:\n  x: 1\n  x: 1", 3), ("{a: 1, a: 2}", 1)])
def test_duplicate_keys_are_refused(text, line):
    with pytest.raises(ConfigError, match=f"here, line {line}: duplicate key"):
        parse(text, "here")


def test_merge_keys_of_yaml_are_no_duplicates():
    assert parse("base: &base {a: 1, b: 2}\nother: {<<: *base, b: 3}", "here")["other"] == {"a": 1, "b": 3}


def test_a_file_must_be_a_mapping(tmp_path):
    path = tmp_path / "ppo.yml"
    path.write_text("- 1\n- 2\n")
    with pytest.raises(ConfigError, match=r"ppo\.yml: must map environment ids"):
        read_file(path)


def test_pairs_nest_by_dots():
    pairs = ["policy_kwargs.net_arch:[64,64]", "policy_kwargs.ortho_init:false", "learning_rate:lin_3e-4", "gamma:0.97"]
    assert parse_pairs(pairs, "-params") == {
        "policy_kwargs": {"net_arch": [64, 64], "ortho_init": False},
        "learning_rate": "lin_3e-4",
        "gamma": 0.97,
    }


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (["n_steps=3"], "not of the form key:value"),
        ([":3"], "not of the form key:value"),
        (["n_steps:3", "n_steps:4"], "'n_steps' is given twice"),
        (["a:1", "a.b:2"], "both as a value and as a mapping"),
        (["a:[1"], "-params a, line 1"),
    ],
)
def test_pairs_that_are_none(pairs, message):
    with pytest.raises(ConfigError, match=message):
        parse_pairs(pairs, "-params")


def test_merge_goes_down_into_mappings_and_changes_neither():
    base, over = {"a": {"x": 1, "y": 2}, "b": [1]}, {"a": {"y": 3}, "b": [2], "c": 4}
    assert merge(base, over) == {"a": {"x": 1, "y": 3}, "b": [2], "c": 4}
    assert base == {"a": {"x": 1, "y": 2}, "b": [1]} and over == {"a": {"y": 3}, "b": [2], "c": 4}
