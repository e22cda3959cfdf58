"""Commands that play with a trained team, whose networks are small, compute with one thread."""

import pytest
import torch as th

from sb3_belief.cli.main import main


@pytest.mark.parametrize("words", ["enjoy RUN", "watch RUN", "adapt RUN --partners seed:1,2", "crossplay RUN RUN"])
def test_small_networks_take_one_thread(words, tmp_path, capsys):
    th.set_num_threads(2)
    try:
        assert main(words.replace("RUN", str(tmp_path / "no_run")).split()) == 2
        assert th.get_num_threads() == 1
    finally:
        th.set_num_threads(1)
    assert capsys.readouterr().err.startswith("Refused: ")
