"""Quick pictures of learning curves, from what the folders of runs hold at the moment."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_belief.common.durable_files import make_folder
from sb3_belief.report.evaluations import read_evaluations
from sb3_belief.report.figures.curves import Curve, curves_spec
from sb3_belief.report.figures.drawing import check_drawing
from sb3_belief.report.figures.theme import arm_colours, arm_dashes
from sb3_belief.report.learning_curve import QUANTITIES, binned, read_episodes
from sb3_belief.report.page.content import unique_name
from sb3_belief.report.page.files import FIGURE_FORMATS, write_figure
from sb3_belief.report.study_page.facts import Series, curve_of, thinned
from sb3_belief.study.groups import LENGTH, labels
from sb3_belief.study.run_reading import RunData, read_run, run_folders
from sb3_belief.zoo.errors import ConfigError, reason_of, short

_BINS = 40


def plot_runs(folders: Sequence[str], output: str, quantity: str | None = None, title: str = "") -> list[Path]:
    """
    Draw the learning curves of runs, finished or not: of each group of runs the mean over its seeds, and each seed as a thin
    line.

    Greedy evaluations are drawn if all runs of an environment have had two of them, otherwise the episodes of the training.

    :param folders: Folders of runs, or with runs
    :param output: Picture to write, ``.png`` or ``.svg``. With runs of several environments each has a picture, whose name
        ends in that of the environment
    :param quantity: ``"return"`` or ``"success"``. None for successes if all runs report them
    :param title: Title. Empty for the environment's id
    :return: The pictures
    :raises ConfigError: If there is no run, nothing to draw, or the picture cannot be written
    """
    target = Path(output)
    if target.suffix.lower() not in FIGURE_FORMATS:
        raise ConfigError(f"-o: {short(output)} must end in {' or '.join(FIGURE_FORMATS)}.")
    check_drawing()
    runs = _runs(folders)
    names = dict(zip([run.folder for run in runs], labels(runs, ignored=LENGTH), strict=True))
    environments = list(dict.fromkeys(run.env for run in runs))
    specs = {}
    for env in environments:
        series, of_what = _series([run for run in runs if run.env == env], quantity)
        groups: dict[str, dict[int | str, Series]] = {}
        for run in runs:
            if run.folder in series:
                own = groups.setdefault(names[run.folder], {})
                # Two runs of one seed are two lines
                seed = "?" if run.seed is None else str(run.seed)
                own[seed if seed not in own else f"{seed} ({run.folder.name})"] = series[run.folder]
        curves: Mapping[str, Curve] = {name: curve_of(own) for name, own in groups.items()}
        arms = sorted(curves)
        baseline = "ippo" if "ippo" in arms and len(arms) > 1 else None
        specs[env] = curves_spec(
            title or f"{env}, {of_what[0]}",
            {arm: curves[arm] for arm in arms},
            arm_colours(arms, baseline),
            arm_dashes(arms, baseline),
            y_title=QUANTITIES[of_what[1]],
            y_domain=(0, 1) if of_what[1] == "success" else None,
        )
    taken: set[str] = set()
    paths = []
    try:
        make_folder(target.parent)
        for env, spec in specs.items():
            one = len(specs) == 1
            paths.append(target if one else target.with_name(f"{target.stem}-{unique_name(env, taken)}{target.suffix}"))
            write_figure(spec, paths[-1])
    except OSError as error:
        raise ConfigError(f"-o: cannot write {short(output)} ({reason_of(error)}).") from None
    return paths


def _runs(folders: Sequence[str]) -> list[RunData]:
    found: dict[Path, RunData] = {}
    for folder in folders:
        own = list(run_folders(Path(folder)))
        if not own:
            raise ConfigError(f"plot: no run in {short(folder)}: give the folder of a run, or one with runs.")
        found.update((path.resolve(), read_run(path)) for path in own)
    return list(found.values())


def _series(runs: Sequence[RunData], quantity: str | None) -> tuple[dict[Path, Series], tuple[str, str]]:
    """Return the curve of each run that has one, and of what: the words for it, and the quantity."""
    evaluations, episodes = {}, {}
    try:
        for run in runs:
            read = read_evaluations(run.folder)
            if read is not None and len(read.steps) > 1:
                evaluations[run.folder] = read.steps, read.mean_returns, read.success_rates
        greedy = len(evaluations) == len(runs)
        for run in runs if not greedy else []:
            try:
                episodes[run.folder] = read_episodes(run.folder)
            except (FileNotFoundError, ValueError) as error:
                # A run that has just begun, or was killed early, has nothing to show
                if "is not an episode" in str(error):
                    raise
    except (OSError, ValueError) as error:
        raise ConfigError(f"plot: {error}") from None
    read_series = evaluations if greedy else episodes
    if not read_series:
        raise ConfigError(f"plot: no episode has ended in {', '.join(short(str(run.folder)) for run in runs[:3])} yet.")
    reported = not any(np.isnan(successes).any() for _, _, successes in read_series.values())
    if quantity == "success" and not reported:
        raise ConfigError("--quantity: success is not reported by all of these runs: draw return.")
    chosen = quantity or ("success" if reported else "return")
    column = 2 if chosen == "success" else 1
    if greedy:
        return {folder: (read[0], read[column]) for folder, read in evaluations.items()}, ("greedy evaluations", chosen)
    end = max(steps[-1] for steps, _, _ in episodes.values())
    edges = np.linspace(0, end, _BINS + 1)
    return {folder: thinned((edges[1:], binned(read[0], read[column], edges)), _BINS) for folder, read in episodes.items()}, (
        "while learning",
        chosen,
    )
