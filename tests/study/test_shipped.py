"""The studies that ship: each is checked as a dry run checks it, as far as its environments are installed."""

import re
from pathlib import Path

import pytest

from sb3_belief.cli.main import main
from sb3_belief.study.checks import check_study
from sb3_belief.study.specification import load_study
from sb3_belief.zoo.errors import ConfigError

FOLDER = Path(__file__).parents[2] / "zoo_configs" / "studies"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yml"))


def test_the_page_names_them_all():
    page = (FOLDER.parents[1] / "docs" / "studies.md").read_text()
    table = page.split("## Studies that ship")[1].split("\n\n")[2]
    assert sorted(re.findall(r"`(\w+)\.yml`", table)) == NAMES


def test_the_pages_examples_are_taken(tmp_path, capsys):
    blocks = re.findall(r"```yaml\n(.*?)```", (FOLDER.parents[1] / "docs" / "studies.md").read_text(), re.DOTALL)
    studies = [block for block in blocks if "environments:" in block]
    assert studies
    for number, block in enumerate(studies):
        path = tmp_path / f"example_{number}.yml"
        path.write_text(block)
        assert main(["study", str(path), "-f", str(tmp_path / "logs"), "--dry-run"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("name", NAMES)
def test_a_dry_run_of_each(name, tmp_path, capsys):
    words = ["study", str(FOLDER / f"{name}.yml"), "-f", str(tmp_path / "logs"), "--dry-run"]
    status = main(words)
    captured = capsys.readouterr()
    assert captured.out.startswith(f"Study {name}: ")
    if status:
        # Never for another reason than an environment that is not here, and then all others have been checked
        assert status == 2 and "which is not installed" in captured.err
        assert captured.err.endswith("All that does not need it has been checked.\n")
        assert name in ("comparison", "comparison_smax", "lbf", "smac_paper", "smax", "speaker_listener")
    assert not list(tmp_path.iterdir())


def test_the_comparison_set_is_compared_everywhere():
    """What is not everywhere has no overall score, and without its baseline nothing is compared."""
    for name in ("comparison", "comparison_smax"):
        study = load_study(FOLDER / f"{name}.yml")
        assert study.baseline == "ippo"
        assert set(study.pairs()) == {(arm, env_id) for arm in study.arms for env_id in study.places}
    games, smax = (set(load_study(FOLDER / f"{name}.yml").arms) for name in ("comparison", "comparison_smax"))
    assert games == smax


def test_the_paper_is_compared_as_it_says():
    study = load_study(FOLDER / "smac_paper.yml")
    assert set(study.places) == {f"smac/{name}" for name in ("2c_vs_64zg", "3s5z", "3s_vs_5z", "6h_vs_8z", "corridor")}
    assert [arm for arm, env_id in study.pairs() if env_id == "smac/corridor"] == list(study.arms)
    assert [arm for arm, env_id in study.pairs() if env_id == "smac/3s5z"] == ["ippo", "wide", "dynamic"]
    settings = {env_id: study.places[env_id].overrides for env_id in study.places}
    assert all(each["n_envs"] == 8 for each in settings.values())
    assert settings["smac/3s_vs_5z"]["n_epochs"] == 15 and settings["smac/6h_vs_8z"]["gamma"] == 0.95
    # The belief's own settings are the paper's, which are the defaults
    assert study.arms["dynamic"].params == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clip_range: 0.05\n    env_wrapper", "n_epoch: 3\n    env_wrapper"),
        ("params: {belief: wide}", "params: {belief: wider}"),
        ("algo: maskable_belief_ppo}", "algo: maskable_belief_ppo, params: {history_length: none}}"),
    ],
)
def test_settings_are_checked_without_the_environment(tmp_path, text, message):
    source = (FOLDER / "smac_paper.yml").read_text()
    assert text in source
    path = tmp_path / "changed.yml"
    path.write_text(source.replace(text, message, 1))
    with pytest.raises(ConfigError, match=r"changed.yml, line \d+: "):
        check_study(load_study(path), tmp_path / "logs", dry_run=True)


def test_without_a_dry_run_a_missing_environment_is_refused(tmp_path, capsys):
    path = tmp_path / "study.yml"
    path.write_text("environments: [smac/3s5z]\nalgorithms: {masked: {algo: maskable_ppo}}\nseeds: 1\n")
    try:
        import smac.env.starcraft2  # noqa: F401
    except ImportError:
        assert main(["study", str(path), "-f", str(tmp_path / "logs")]) == 2
        assert "study.yml, line 1: environments: " in capsys.readouterr().err
        assert not (tmp_path / "logs").exists()
    else:
        pytest.skip("SMAC is installed")
