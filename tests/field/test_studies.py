"""Long comparisons: what is kept of runs that are over, and what is checked before the first of them."""

import json
from typing import Any

import pytest

from sb3_belief.zoo.errors import ConfigError
from studies import learning

ARGUMENTS: dict[str, Any] = dict(
    belief="none", seed=0, algo="belief_ppo", env_id="convention-swap", n_timesteps=64, episodes=2
)


@pytest.fixture
def trained(monkeypatch):
    """How many runs were trained so far."""
    count = []
    train = learning.train

    def counting(*args):
        count.append(args)
        return train(*args)

    monkeypatch.setattr(learning, "train", counting)
    return count


def test_a_kept_result_is_of_the_same_episodes_and_versions(tmp_path, trained, monkeypatch):
    first = learning.learn(**ARGUMENTS, log_folder=str(tmp_path))
    assert learning.learn(**ARGUMENTS, log_folder=str(tmp_path)) == first and len(trained) == 1
    assert learning.learn(**{**ARGUMENTS, "episodes": 4}, log_folder=str(tmp_path)) is not None and len(trained) == 2
    monkeypatch.setattr(learning, "versions", lambda: {"torch": "another"})
    learning.learn(**{**ARGUMENTS, "episodes": 4}, log_folder=str(tmp_path))
    assert len(trained) == 3
    # A result of before versions were kept is not trusted
    path = next((tmp_path / "learning").iterdir())
    record = json.loads(path.read_text())
    del record["versions"]
    path.write_text(json.dumps(record))
    learning.learn(**{**ARGUMENTS, "episodes": 4}, log_folder=str(tmp_path))
    assert len(trained) == 4


def test_a_plot_is_checked_before_training(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    config = learning.load_config("belief_ppo", "convention-swap")
    junction = learning.load_config("belief_ppo", "traffic-junction-easy")
    monkeypatch.chdir(tmp_path)
    learning.check_plot("a.png", "return", config)
    learning.check_plot("a.svg", "success", junction)
    for path, quantity, message in (
        ("a.png", "success", "--quantity: convention-swap reports no successes; draw --quantity return"),
        ("a.xyz", "return", "--plot: 'a.xyz' must end in one of .*png"),
        ("/proc/a.png", "return", "--plot: cannot write the file '/proc/a.png'"),
    ):
        with pytest.raises(ConfigError, match=message):
            learning.check_plot(path, quantity, config)
    assert list(tmp_path.iterdir()) == []
