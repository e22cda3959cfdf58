"""The sentences of a page."""

from collections.abc import Iterable, Sequence

from sb3_belief.report.page.content import number_text
from sb3_belief.report.statistics import IntervalEstimate
from sb3_belief.report.study_page.facts import StudyFacts
from sb3_belief.report.study_page.findings import ArmFinding, Findings

#: Packages whose versions the paragraph names
_NAMED = {"sb3-belief": "sb3-belief", "stable-baselines3": "Stable-Baselines3", "torch": "PyTorch", "python": "Python"}
OVERALL = "all environments"


def listed(words: Iterable[str], most: int = 8) -> str:
    """
    Return words as a list in a sentence.

    :param words: The words
    :param most: How many of them are written out
    :return: ``"a"``, ``"a and b"`` or ``"a, b and c"``
    """
    names = list(words)
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} more"]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}" if names else "none"


def counted(number: int, word: str) -> str:
    """
    Return a number with its noun.

    :param number: The number
    :param word: The noun, singular, with a regular plural
    :return: E.g. ``"1 run"`` or ``"1,000 runs"``
    """
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def method_paragraph(facts: StudyFacts, findings: Findings) -> str:
    """
    Return the paragraph that says what was compared and how, which a reader can quote.

    :param facts: What is known of the study
    :param findings: What was found
    :return: The paragraph
    """
    environments = list(findings.environments)
    if not environments:
        return ""
    counted_runs = [run for run in facts.runs if run.counts]
    others = [arm for arm in findings.arms if arm != findings.baseline]
    if findings.baseline is not None and others:
        compared = f"We compare {listed(others)} with {findings.baseline}"
    else:
        compared = f"We measure {listed(findings.arms)}"
    numbers = sorted({len(each.seeds) for arms in findings.environments.values() for each in arms.values()})
    seeds = counted(numbers[0], "seed") if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]} seeds"
    sentences = [
        f"{compared} on {listed(environments)}, with {seeds} each ({counted(len(counted_runs), 'run')} of {_steps(facts)}).",
        _protocol(facts, findings),
        _statistics(findings),
        _versions(facts),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def result_sentences(findings: Findings) -> str:
    """
    Return what was found, in a few sentences.

    :param findings: The findings
    :return: The sentences
    """
    if not findings.environments:
        return "No run counts yet, so there is nothing to compare; the page names each run with the reason."
    sentences = []
    for place, arms in ({OVERALL: findings.overall} if findings.overall else findings.environments).items():
        unit = "normalised return" if place == OVERALL and findings.quantity == "return" else findings.unit
        parts = [f"{arm} {_with_interval(each.score)}{_verdict(each, findings.baseline)}" for arm, each in arms.items()]
        sentences.append(
            f"{'Over' if place == OVERALL else 'On'} {place}, the interquartile mean of the {unit} is {'; '.join(parts)}."
        )
    if findings.overall and findings.baseline is not None:
        parts = []
        for arm in findings.arms:
            verdicts = [arms[arm].comparison for arms in findings.environments.values() if arm in arms]
            words = [each.verdict for each in verdicts if each is not None]
            counts = [f"{word} on {words.count(word)}" for word in ("better", "worse", "undecided") if word in words]
            if words:
                parts.append(f"{arm} is {listed(counts)} of {len(words)}")
        sentences.append(f"By environment, compared with {findings.baseline}: {'; '.join(parts)}.")
    return "\n".join(sentences)


def sentence(words: str) -> str:
    """
    Return words as they begin a sentence.

    :param words: The words, which are no name
    :return: The same with a capital letter
    """
    return f"{words[:1].upper()}{words[1:]}"


def verdict_text(finding: ArmFinding) -> str | None:
    """
    Return the verdict of a comparison.

    :param finding: What was found of the arm
    :return: The verdict, or None if the arm is compared with nothing
    """
    return None if finding.comparison is None else finding.comparison.verdict


def notices(facts: StudyFacts) -> list[str]:
    """
    Return what the reader must know first: which runs are missing, and why.

    :param facts: What is known of the study
    :return: Sentences
    """
    found: list[str] = []
    left_out: dict[str, list[str]] = {}
    for run in facts.runs:
        if not run.counts:
            seed = "" if run.seed is None else f", seed {run.seed}"
            reason = run.why_not or run.status
            left_out.setdefault(reason, []).append(f"{run.arm} on {run.environment}{seed}")
    for reason, names in left_out.items():
        verb = "does" if len(names) == 1 else "do"
        found.append(f"{counted(len(names), 'run')} ({reason}) {verb} not count: {listed(names, most=6)}.")
    if not facts.is_study:
        found.append(
            "These runs belong to no study and have had no final evaluation on seeds of its own: the last evaluation during "
            "each training counts, which has fewer episodes."
        )
    return [*found, *facts.notices]


def ends(estimate: IntervalEstimate) -> tuple[float, float] | None:
    """
    Return the ends of an estimate's interval.

    :param estimate: The estimate
    :return: Lower and upper end, or None if it has no interval
    """
    return None if estimate.low is None or estimate.high is None else (estimate.low, estimate.high)


def _with_interval(score: IntervalEstimate) -> str:
    interval = ends(score)
    if interval is None:
        return number_text(score.value)
    low, high = interval
    return f"{number_text(score.value)} ({number_text(low)} to {number_text(high)})"


def _verdict(finding: ArmFinding, baseline: str | None) -> str:
    if finding.comparison is None:
        return ""
    verdict = finding.comparison.verdict
    if verdict != "undecided":
        return f", {verdict} than {baseline}"
    needed = finding.comparison.seeds_needed
    return ", undecided" if needed is None else f", undecided (about {counted(needed, 'seed')} would decide)"


def _steps(facts: StudyFacts) -> str:
    steps = sorted({run.total_steps for run in facts.runs if run.counts and run.total_steps is not None})
    if not steps:
        return "unknown length"
    return f"{steps[0]:,} joint steps" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,} joint steps"


def _protocol(facts: StudyFacts, findings: Findings) -> str:
    if facts.is_online:
        every = "" if facts.evaluation_every is None else f" of {facts.evaluation_every:,} joint steps"
        last = "the last ones" if facts.final_episodes is None else f"the last {facts.final_episodes:,}"
        return (
            "The episodes of the training count themselves, with sampled actions: a point of a learning curve is the mean of "
            f"those{every}, and a run's score that of {last}."
        )
    manner = "acting greedily" if findings.deterministic else "sampling its actions"
    every = "" if facts.evaluation_every is None else f" every {facts.evaluation_every:,} joint steps"
    episodes = "" if facts.evaluation_episodes is None else f" over {counted(facts.evaluation_episodes, 'episode')}"
    if findings.checkpoint == "current":
        return f"Each team was evaluated{every}{episodes} during its training, {manner}; the last evaluation counts."
    which = "last team" if findings.checkpoint == "last" else "best team by those evaluations"
    final = "" if facts.final_episodes is None else f" over {counted(facts.final_episodes, 'episode')}"
    return (
        f"Each team was evaluated{every}{episodes} during its training; the {which}, {manner}, was then evaluated{final} on "
        f"seeds that neither the training nor those evaluations used."
    )


def _statistics(findings: Findings) -> str:
    sentences = [
        f"A run's score is its mean {findings.unit}. Given are interquartile means over seeds with 95 % intervals by a "
        "stratified bootstrap, widened for few seeds."
    ]
    if findings.overall:
        how = (
            "unchanged, since success rates are comparable"
            if findings.quantity == "success"
            else "after scaling those of each environment to 0 for the lowest and 1 for the highest run"
        )
        n_environments = len({name.split(", ", 1)[1] for each in findings.overall.values() for name in map(str, each.seeds)})
        sentences.append(f"Over the {n_environments} environments in which all algorithms have runs, scores are pooled {how}.")
    if findings.baseline is not None:
        sentences.append(
            f"An algorithm is called better or worse than {findings.baseline} where the two intervals are disjoint, and "
            "undecided otherwise; p-values are of permutation tests, corrected after Holm."
        )
    return " ".join(sentences)


def _versions(facts: StudyFacts) -> str:
    found = facts.versions()
    named = [f"{label} {' / '.join(found[package])}" for package, label in _NAMED.items() if package in found]
    return f"Versions: {', '.join(named)}." if named else ""


def sorted_arms(arms: Iterable[str], order: Sequence[str]) -> list[str]:
    """
    Return arms in a common order.

    :param arms: The arms
    :param order: The order of all arms
    :return: The arms as they come in it
    """
    return sorted(arms, key=list(order).index)
