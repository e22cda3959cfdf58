"""The file and the columns that docs/tuning_and_sharing.md shows are those that there are."""

import re
from pathlib import Path

from sb3_belief.study.trials_table import COLUMNS
from sb3_belief.study.tuning_spec import FIRST_SEED, load_tuning

TEXT = (Path(__file__).parents[2] / "docs" / "tuning_and_sharing.md").read_text(encoding="utf-8")


def test_the_file_is_one(tmp_path):
    (example,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "junction.yml").write_text(example)
    spec = load_tuning(tmp_path / "junction.yml")
    spec.check()
    assert spec.seeds == (FIRST_SEED, FIRST_SEED + 1) and spec.config({"belief": "static"}).algo_kwargs["belief"] == "static"


def test_the_defaults_and_the_columns_are_those_that_there_are(tmp_path):
    (tmp_path / "x.yml").write_text("{algo: ppo, env: traffic-junction-easy, search: {gamma: {low: 0.5, high: 0.9}}}")
    spec = load_tuning(tmp_path / "x.yml")
    for name, group in (("sampler", spec.sampler), ("pruner", spec.pruner)):
        assert f"`{name}: {{{', '.join(f'{key}: {value}' for key, value in group.items())}}}`" in TEXT
    assert f"`{', '.join(COLUMNS)}`" in TEXT
