"""What a tuning's page says in words."""

import dataclasses

import pytest

from sb3_belief.report.tuning_page.facts import SearchedSetting, TrialFacts, TuningFacts
from sb3_belief.report.tuning_page.text import outcome_sentences, range_text, search_paragraph, trial_notices

RATE = SearchedSetting("learning_rate", "number", (1e-5, 0.01), is_log=True, falls=True)
BELIEF = SearchedSetting("belief", "choice", choices=["dynamic", "static"])
FACTS = TuningFacts(
    "tiny",
    "belief_ppo",
    "junction",
    [RATE, BELIEF],
    [
        TrialFacts(0, "complete", {"learning_rate": 0.00123456, "belief": "static"}, -1.5),
        TrialFacts(1, "complete", {"learning_rate": 0.002, "belief": "dynamic"}, 2.0),
        TrialFacts(2, "complete", {"learning_rate": 0.003, "belief": "static"}, 2.0),
        TrialFacts(3, "pruned", {"learning_rate": 0.004, "belief": "static"}, 9.0),
    ],
    n_trials=4,
    seeds=[1000],
    every=500,
    episodes=32,
    n_timesteps=20_000,
    sampler={"name": "tpe", "seed": 0, "startup_trials": 10},
    pruner={"name": "median", "startup_trials": 5, "warmup_evaluations": 1},
    best_settings="junction: {}",
)


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        (RATE, "1e-05 to 0.01, on a logarithmic scale, falling linearly to 0"),
        (BELIEF, "dynamic or static"),
        (SearchedSetting("n_epochs", "integer", (2, 10)), "2 to 10, integers"),
        (SearchedSetting("n_steps", "integer", (64, 256), step=64), "64 to 256, in steps of 64"),
        (SearchedSetting("gamma", "number", (0.5, 1.0), step=0.1), "0.5 to 1, in steps of 0.1"),
    ],
)
def test_a_range_is_said(setting, text):
    assert range_text(setting) == text


def test_the_best_is_the_first_of_the_highest_complete_trials():
    said = outcome_sentences(FACTS)
    assert (
        "The best of 3 complete trials is trial 1, with a mean return of 2.000: learning_rate 0.002 and belief dynamic."
        in said
    )
    assert said.endswith("All trials: 3 complete and 1 pruned.")
    assert "success rate of" in outcome_sentences(dataclasses.replace(FACTS, objective="success"))
    none = dataclasses.replace(FACTS, trials=FACTS.trials[3:])
    assert outcome_sentences(none) == "No trial is complete yet, so there is no best one. All trials: 1 pruned."


def test_the_paragraph_says_how_it_was_searched():
    said = search_paragraph(FACTS)
    for words in (
        "We searched learning_rate (1e-05 to 0.01, on a logarithmic scale, falling linearly to 0) and belief (dynamic or",
        "of belief_ppo on junction, with 4 trials drawn by the tree-structured Parzen estimator (TPE), the first 10 at random",
        "A trial trains 1 run of 20,000 joint steps (seed 1000), and plays 32 episodes greedily every 500 joint steps.",
        "is the mean return in the last evaluation. A trial was pruned",
        "from evaluation 2 on and once 5 trials had been completed.",
    ):
        assert words in said
    other = search_paragraph(
        dataclasses.replace(
            FACTS,
            seeds=[1000, 1001],
            last_evaluations=3,
            n_timesteps=None,
            sampler={"name": "random", "seed": 0, "startup_trials": 10},
            pruner={"name": "none"},
        )
    )
    for words in (
        "4 trials drawn by random draws (Optuna)",
        "2 runs of as many joint steps as its configuration file says (seeds 1000 and 1001)",
        "in the last 3 evaluations, averaged over the runs. No trial was pruned.",
    ):
        assert words in other


def test_what_is_missing_is_said_first():
    assert trial_notices(FACTS) == []
    again = [TrialFacts(4, "killed", {}), TrialFacts(5, "running", {}, repeats=4), TrialFacts(6, "failed", {}, error="x")]
    facts = dataclasses.replace(FACTS, trials=[*FACTS.trials, *again], n_trials=9, best_settings="")
    assert trial_notices(facts) == [
        "The tuning is not done: 6 of its 9 trials were drawn.",
        "1 trial had not ended when this page was made.",
        "1 trial failed; the table of trials says why.",
        "The process of 1 trial ended before the trial did; the table says why.",
        "The file of the best settings is missing: sb3-belief tune writes it anew.",
    ]
