"""What is not decentralised says so wherever it is named."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sb3_belief.study.reporting import _notes
from sb3_belief.study.run_reading import RunData
from sb3_belief.zoo.config import load_config
from sb3_belief.zoo.model_card import CardContent, _text
from sb3_belief.zoo.names import ALGOS, CENTRAL, SHARED

ROOT = Path(__file__).parents[2]
CENTRALISED = [name for name, algo in ALGOS.items() if algo.note]


@pytest.mark.parametrize("name", ALGOS)
def test_references_have_a_note_and_nobody_else(name):
    algo = ALGOS[name]
    is_reference = algo.path.startswith("sb3_belief.references")
    assert bool(algo.note) == bool(algo.adapter) == is_reference
    assert (SHARED in algo.note) == name.endswith("_shared")
    assert load_config(name, "permutation").note == algo.note


@pytest.mark.parametrize("name", CENTRALISED)
def test_its_file_of_settings_says_so(name):
    text = " ".join(line.lstrip("# ") for line in (ROOT / "zoo_configs" / f"{name}.yml").read_text().splitlines())
    for note in (CENTRAL, SHARED):
        assert (note.lower() in text.lower()) == (note in ALGOS[name].note)


def test_a_report_says_so_first():
    runs = [
        SimpleNamespace(arm=arm, data=RunData(Path(), "finished", "ppo", "env", 0, record))
        for arm, record in (("ours", {"note": ""}), ("old", {}), ("theirs", {"note": SHARED}), ("theirs", {"note": SHARED}))
    ]
    reported: Any = SimpleNamespace(arms=["theirs", "ours", "old"], runs=runs)
    assert _notes(reported) == ["theirs shares weights: not decentralised."]


@pytest.mark.parametrize("note", ["", SHARED])
def test_a_model_card_says_so(note):
    record = {"env": "permutation", "algo": "ippo_shared", "seed": 0, "note": note}
    text = _text(CardContent("me/team", record, {}, {"team": "SharedPPO"}, 10, [], False, False))
    assert ("It shares weights: not decentralised." in text) == bool(note)
    assert ("learned by itself from what it observed itself" in text) == ("each with a model of its own" in text) == (not note)
