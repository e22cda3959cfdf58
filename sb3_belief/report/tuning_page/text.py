"""The sentences of a tuning's page."""

from sb3_belief.report.page.content import number_text
from sb3_belief.report.study_page.text import counted, listed
from sb3_belief.report.tuning_page.facts import COMPLETE, PRUNED, SearchedSetting, TuningFacts

#: What stands beside a score that was chosen as the highest of many
TOO_HIGH = (
    "It is the highest of many scores that all vary by chance, and therefore too high: train these settings with the seeds of"
    " a study for a number to quote."
)
_SAMPLERS = {"tpe": "the tree-structured Parzen estimator (TPE)", "random": "random draws"}


def outcome_sentences(facts: TuningFacts) -> str:
    """
    Return what was found, in a few sentences.

    :param facts: What is known of the tuning
    :return: The sentences
    """
    numbers = {state: facts.count(state) for state in (COMPLETE, PRUNED, "failed", "killed", "running", "waiting")}
    rest = [f"{number:,} {state}" for state, number in numbers.items() if number]
    states = f"All trials: {listed(rest)}."
    best = facts.best
    if best is None or best.value is None:
        return f"No trial is complete yet, so there is no best one. {states}"
    drawn = listed((f"{name} {setting_text(value)}" for name, value in best.settings.items()), most=20)
    return (
        f"The best of {counted(numbers[COMPLETE], 'complete trial')} is trial {best.number}, with a {facts.unit} of "
        f"{number_text(best.value)}: {drawn}. {states}"
    )


def search_paragraph(facts: TuningFacts) -> str:
    """
    Return the paragraph that says what was searched and how, which a reader can quote.

    :param facts: What is known of the tuning
    :return: The paragraph
    """
    searched = [f"{each.name} ({range_text(each)})" for each in facts.settings]
    length = "as many joint steps as its configuration file says" if facts.n_timesteps is None else _steps(facts.n_timesteps)
    seeds = f"{'seed' if len(facts.seeds) == 1 else 'seeds'} {listed(map(str, facts.seeds))}"
    last = "the last evaluation" if facts.last_evaluations == 1 else f"the last {facts.last_evaluations} evaluations"
    over_runs = "" if len(facts.seeds) == 1 else ", averaged over the runs"
    return (
        f"We searched {listed(searched, most=20)} of {facts.algorithm} on {facts.environment}, with "
        f"{counted(facts.n_trials, 'trial')} drawn by {_sampler(facts)} (Optuna). A trial trains "
        f"{counted(len(facts.seeds), 'run')} of {length} ({seeds}), and plays {counted(facts.episodes, 'episode')} greedily "
        f"every {_steps(facts.every)}. The objective, which is maximised, is the {facts.unit} in {last}{over_runs}. "
        f"{_pruner(facts)}"
    )


def range_text(setting: SearchedSetting) -> str:
    """
    Return what a setting is drawn from.

    :param setting: The setting
    :return: The range with its kind, or the choices
    """
    if setting.ends is None:
        return listed(setting.choices, most=20).replace(" and ", " or ")
    words = [f"{setting_text(setting.ends[0])} to {setting_text(setting.ends[1])}"]
    words += ["on a logarithmic scale"] * setting.is_log
    words += ["integers"] * (setting.kind == "integer" and setting.step in (None, 1))
    words += [f"in steps of {setting.step:g}"] if setting.step not in (None, 1) else []
    words += ["falling linearly to 0"] * setting.falls
    return ", ".join(words)


def setting_text(value: float | int | str) -> str:
    """
    Return a drawn setting as text.

    :param value: The number, or the text of a choice
    :return: The text, a number with four digits
    """
    return value if isinstance(value, str) else str(value) if isinstance(value, int) else f"{value:.4g}"


def trial_notices(facts: TuningFacts) -> list[str]:
    """
    Return what the reader must know first: that trials are missing, or have failed.

    :param facts: What is known of the tuning
    :return: Sentences
    """
    found = []
    drawn = sum(each.repeats is None for each in facts.trials)
    unfinished = facts.count("running") + facts.count("waiting")
    if drawn < facts.n_trials:
        found.append(f"The tuning is not done: {drawn} of its {counted(facts.n_trials, 'trial')} were drawn.")
    if unfinished:
        found.append(f"{counted(unfinished, 'trial')} had not ended when this page was made.")
    if facts.count("failed"):
        found.append(f"{counted(facts.count('failed'), 'trial')} failed; the table of trials says why.")
    if facts.count("killed"):
        found.append(
            f"The process of {counted(facts.count('killed'), 'trial')} ended before the trial did; the table says why."
        )
    if facts.best is not None and not facts.best_settings:
        found.append("The file of the best settings is missing: sb3-belief tune writes it anew.")
    return found


def _steps(number: int) -> str:
    return f"{number:,} joint steps"


def _sampler(facts: TuningFacts) -> str:
    name, startup = facts.sampler["name"], facts.sampler["startup_trials"]
    first = f", the first {startup} at random" if name == "tpe" and startup else ""
    return f"{_SAMPLERS[name]}{first}"


def _pruner(facts: TuningFacts) -> str:
    if facts.pruner["name"] == "none":
        return "No trial was pruned."
    warmup = facts.pruner["warmup_evaluations"]
    return (
        "A trial was pruned when its best evaluation so far was below the median of the complete trials' at the same "
        f"evaluation, from evaluation {warmup + 1} on and once {counted(facts.pruner['startup_trials'], 'trial')} had been"
        " completed."
    )
