"""The page that describes a trained team on the Hugging Face hub."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sb3_belief.report.evaluations import EVALUATIONS
from sb3_belief.zoo.run_folder import BEST_MODEL, CONFIG, TEAM, folder_name
from sb3_belief.zoo.run_score import LEVEL, RunScore
from sb3_belief.zoo.settings import observation_arguments

_BRACKETS = (
    "Brackets are 95 % intervals over the episodes (percentile bootstrap of the return, Wilson's interval of the success rate)"
    ". They say how well *this* team is known, one run with one seed, and nothing of what the algorithm gives with other"
    " seeds."
)
_OF_BEST = " The best evaluation is the highest of many, so the score of that team is too high on average."
_OF_FINAL = (
    " The best team was chosen by its evaluations, not by these episodes, so its score is not too high for that reason."
)
TAGS = ("reinforcement-learning", "deep-reinforcement-learning", "multi-agent", "stable-baselines3", "sb3-belief")


@dataclass(frozen=True)
class CardContent:
    """
    What a card says.

    :param repo_id: Name of the repository
    :param record: Record of the run
    :param settings: Settings of the run, as its configuration file holds them
    :param algorithms: Class of each agent's algorithm, by agent
    :param joint_steps: Joint steps that the team was trained for
    :param scores: Scores, of which the first is in the metadata: of the last evaluation and of the best one, or of the final
        episodes of the best team and of the last one. Empty for none
    :param with_best: Whether the best model is there too
    :param with_evaluations: Whether the file of the evaluations is there too
    :param is_final: Whether the scores are those of final episodes
    """

    repo_id: str
    record: dict[str, Any]
    settings: dict[str, Any]
    algorithms: dict[str, str]
    joint_steps: int
    scores: Sequence[RunScore]
    with_best: bool
    with_evaluations: bool
    is_final: bool = False


def model_card(content: CardContent) -> str:
    """
    Write the card.

    :param content: What it says
    :return: Its text, with the metadata that the hub reads at its beginning
    """
    return f"---\n{_metadata(content)}\n---\n\n{_text(content)}"


def _metadata(content: CardContent) -> str:
    from huggingface_hub import EvalResult, ModelCardData

    env, results = content.record["env"], []
    if content.scores:
        first = content.scores[0]
        common: dict[str, Any] = {
            "task_type": "reinforcement-learning",
            "task_name": "reinforcement-learning",
            "dataset_type": folder_name(env),
            "dataset_name": env,
        }
        arguments = {
            "episodes": first.n_episodes,
            "deterministic": first.deterministic,
            "joint_steps": first.joint_steps,
            "level": LEVEL,
            "team": first.file,
        }
        # As SB3's own cards give it, with the standard deviation over episodes
        value = f"{first.returns.mean:.2f} +/- {first.spread:.2f}"
        interval = {"interval": _ends(first.returns), "kind": "percentile bootstrap over episodes"}
        results.append(
            EvalResult(**common, metric_type="mean_reward", metric_value=value, metric_args={**interval, **arguments})
        )
        if first.success is not None:
            interval = {"interval": _ends(first.success), "kind": "Wilson, over episodes"}
            share = round(first.success.mean, 4)
            results.append(
                EvalResult(**common, metric_type="success_rate", metric_value=share, metric_args={**interval, **arguments})
            )
    data = ModelCardData(
        library_name="stable-baselines3",
        model_name=content.record["algo"],
        tags=[*TAGS, folder_name(env)],
        eval_results=results or None,
        ignore_metadata_errors=False,
    )
    return data.to_yaml(line_break="\n").strip()


def _ends(value: Any) -> list[float] | None:
    return None if value.low is None else [round(value.low, 4), round(value.high, 4)]


def _text(content: CardContent) -> str:
    record, repo_id, note = content.record, content.repo_id, content.record.get("note")
    kinds = sorted(set(content.algorithms.values()))
    rows = {
        "Environment": f"`{record['env']}`",
        "Arguments of the environment": f"`{json.dumps(content.settings.get('env_kwargs', {}))}`".replace("|", "\\|"),
        "Algorithm": f"`{record['algo']}` ({', '.join(kinds)})" + (f": {note}" if note else ""),
        "Models" if note else "Agents": f"{len(content.algorithms)}{'' if note else ', each with a model of its own'}:"
        f" {', '.join(map(_code, content.algorithms))}",
        "Joint steps of training": f"{content.joint_steps:,}",
        "Seed": f"{record.get('seed')}",
    }
    files = {
        TEAM: "the team at the end of its training",
        **({BEST_MODEL: "the team that was best in an evaluation during the training"} if content.with_best else {}),
        CONFIG: "all settings, with which `sb3-belief train --conf-file` repeats the run",
        "run.json": "algorithm, environment, seed and versions",
        **({EVALUATIONS: "the returns of all evaluations"} if content.with_evaluations else {}),
    }
    parts = [
        f"# {repo_id.rpartition('/')[2]}",
        "A team that was trained with sb3-belief"
        + (
            f". It {note}."
            if note
            else ": each agent is a model of Stable-Baselines3 that has learned by itself from what it observed itself."
        ),
        _table({"": "", **rows}),
        "## Score",
        _score(content),
        "## How to use it",
        f"```bash\nsb3-belief load {repo_id} -o team\nsb3-belief enjoy team\n```",
        "or from Python:",
        f"```python\n{usage(content)}\n```",
        "## Files",
        "Files are data: `Team.load` reads them without pickle, and runs nothing of whoever made them.",
        _table({"File": "", **{_code(name): text for name, text in files.items()}}),
        "## Versions",
        _table({"Package": "Version", **{str(name): str(version) for name, version in record.get("versions", {}).items()}}),
    ]
    return "\n\n".join(parts) + "\n"


def usage(content: CardContent) -> str:
    """
    Return the program that the card shows: it plays one episode.

    :param content: What the card says
    """
    kwargs = content.settings.get("env_kwargs", {})
    given = {**({"env_kwargs": kwargs} if kwargs else {}), **observation_arguments(content.settings)}
    arguments = "".join(f", {name}={value!r}" for name, value in given.items())
    wrapped = content.settings.get("env_wrapper") or content.settings.get("visibility")
    note = (
        f"# {CONFIG} names wrappers, which sb3-belief enjoy applies, and make_team_env(wrapper=...) takes\n" if wrapped else ""
    )
    masks = ", action_masks=env.action_masks()" if "mask" in str(content.algorithms).lower() else ""
    return f"""\
from huggingface_hub import hf_hub_download
from sb3_belief import Team, make_team_env

{note}env = make_team_env({content.record["env"]!r}, n_envs=1, seed=0{arguments})
team = Team.load(hf_hub_download({content.repo_id!r}, {TEAM!r}))
obs, state, done, score = env.reset(), None, False, 0.0
while not done:
    actions, state = team.predict(obs, state, deterministic=True{masks})
    obs, rewards, dones, infos = env.step(actions)
    score, done = score + float(rewards[0]), bool(dones[0])
print(score)"""


def _score(content: CardContent) -> str:
    if not content.scores:
        return "The run was not evaluated."
    has_successes = content.scores[0].success is not None
    rows = {"": "Mean return" + (" | Success rate" if has_successes else "")}
    for score in content.scores:
        if score.file != BEST_MODEL or content.with_best:
            rows[_row_name(score, content.is_final)] = f"{score.returns}" + (f" | {score.success}" if has_successes else "")
    notes = f"{_origin(content)} {_BRACKETS}"
    if content.with_best:
        notes += _OF_FINAL if content.is_final else _OF_BEST
    return f"{_table(rows)}\n\n{notes}"


def _row_name(score: RunScore, is_final: bool) -> str:
    which = "Best" if score.file == BEST_MODEL else "Last"
    if is_final:
        return f"{which} team, of {score.joint_steps:,} joint steps (`{score.file}`)"
    return f"{which} evaluation, at {score.joint_steps:,} joint steps" + (f" (`{score.file}`)" if which == "Best" else "")


def _origin(content: CardContent) -> str:
    first = content.scores[0]
    if not content.is_final:
        return f"Means over {first.n_episodes} episodes of greedy play on seeds that the training did not use."
    if not first.deterministic:
        return f"Means over the last {first.n_episodes} episodes of the training, with sampled actions."
    return (
        f"Means over the {first.n_episodes} final episodes of a study: greedy play after the training, on seeds that neither"
        " it nor its evaluations used."
    )


def _table(rows: dict[str, str]) -> str:
    """Return a table, whose first row is its head."""
    lines = [f"| {name} | {value} |" for name, value in rows.items()]
    n_columns = lines[0].count("|") - 1
    return "\n".join([lines[0], "|" + " --- |" * n_columns, *lines[1:]])


def _code(text: str) -> str:
    return f"`{text}`"
