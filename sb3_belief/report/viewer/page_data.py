"""The numbers of a viewer's page, as plain data that JSON can hold."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_belief.common.action_encoding import ActionEncoding, action_encoding
from sb3_belief.report.recording import AgentMoment, Episode, Moment, Recording, decoded_action

#: Attended rows of a step of which the page shows what happened there
CARDS = 6
# Columns of an observation in its compact form
_COLUMNS = 96


def page_data(recording: Recording, title: str, subtitle: str = "", agent: str | None = None) -> dict[str, Any]:
    """
    Return all that a viewer's page shows.

    :param recording: The episodes
    :param title: Heading of the page
    :param subtitle: What stands below it
    :param agent: Name of the agent that is shown at first; None for the one with a belief that sees the others most
    :return: Plain data. ``spaces`` describes actions; ``agents`` each agent with its others and the history rows that it
        attends to; ``episodes`` the steps, in which ``views`` holds what each agent saw, believed and would do
    """
    encodings = {name: action_encoding(name, space) for name, space in recording.action_spaces.items()}
    agents = list(recording.team.agents)
    return {
        "title": title,
        "subtitle": subtitle,
        "agent": agent or _most_seeing(recording),
        "deterministic": recording.deterministic,
        "names": list(recording.action_spaces),
        "spaces": {name: _space(name, recording, encoding) for name, encoding in encodings.items()},
        "agents": {agent: _agent(agent, recording, encodings) for agent in agents},
        "frames": recording.frames.urls(),
        "episodes": [_episode(episode, recording, encodings) for episode in recording.episodes],
    }


def _most_seeing(recording: Recording) -> str:
    def seen(agent: str) -> tuple[bool, int]:
        moments = [moment.agents[agent] for episode in recording.episodes for moment in episode.moments]
        return any(each.prediction is not None for each in moments), sum(int(each.visible.sum()) for each in moments)

    return max(recording.team.agents, key=seen)


def _space(name: str, recording: Recording, encoding: ActionEncoding) -> dict[str, Any]:
    space: Any = recording.action_spaces[name]
    described: dict[str, Any] = {"kind": encoding.kind, "widths": encoding.widths}
    if encoding.kind == "number":
        described["low"], described["high"] = (_rounded(bound.reshape(-1)) for bound in (space.low, space.high))
    elif name in recording.action_names:
        described["labels"] = recording.action_names[name]
    elif encoding.kind == "categorical":
        described["labels"] = [[str(k) for k in range(width)] for width in encoding.widths]
    else:
        described["labels"] = [[str(k) for k in range(encoding.width)]]
    return described


# What an agent believes and does


def _episode(episode: Episode, recording: Recording, encodings: dict[str, ActionEncoding]) -> dict[str, Any]:
    return {
        "return": _number(episode.team_return),
        "success": episode.success,
        "steps": [
            {
                "frame": moment.frame,
                "at": {name: [round(x, 4), round(y, 4)] for name, (x, y) in moment.positions.items()},
                "did": {name: _rounded(action) for name, action in moment.actions.items()},
                "reward": _number(moment.reward),
                "views": {
                    agent: _view(agent_moment, moment, recording.others_of(agent), encodings)
                    for agent, agent_moment in moment.agents.items()
                },
            }
            for moment in episode.moments
        ],
    }


def _view(agent: AgentMoment, moment: Moment, others: Sequence[str], encodings: dict[str, ActionEncoding]) -> dict[str, Any]:
    view: dict[str, Any] = {
        "active": agent.active,
        "reward": _number(agent.reward),
        "value": None if agent.choice.value is None else _number(agent.choice.value),
        "own": {"kind": agent.choice.kind, "numbers": _rounded(agent.choice.numbers)},
        "sees": [bool(seen) for seen in agent.visible],
    }
    if agent.prediction is not None:
        expected = agent.prediction.actions
        view["expects"] = [_rounded(expected[other]) for other in others]
        # The most likely action of each part, and how far a mean is off
        judged = [judge(expected[other], moment.actions[other], encodings[other]) for other in others]
        view["right"] = [
            right if seen and agent.active else None for (right, _), seen in zip(judged, agent.visible, strict=True)
        ]
        view["error"] = [None if error is None else _number(error) for _, error in judged]
        rows = sorted(zip(agent.prediction.weights.tolist(), agent.prediction.rows.tolist(), strict=True), reverse=True)
        # The null row of an adaptive belief has no step behind it
        view["rows"] = [[row, round(weight, 5)] for weight, row in rows if row >= 0]
    return view


def judge(expected: np.ndarray, action: np.ndarray, encoding: ActionEncoding) -> tuple[list[bool] | None, float | None]:
    """
    Compare what was expected of an other with what it did.

    :param expected: As in ``OthersPrediction.actions``, ``[width]``
    :param action: As in ``Moment.actions``
    :param encoding: Of its action space
    :return: For each part of a Discrete or MultiDiscrete space, or each entry of a MultiBinary one, whether the most likely
        value is what it did, otherwise None; and the mean absolute error for a Box space, otherwise None
    """
    if encoding.kind == "number":
        return None, float(np.abs(expected - action).mean())
    if encoding.kind == "binary":
        return [bool(one) for one in (expected > 0.5) == (action > 0.5)], None
    guessed = decoded_action(expected, encoding.kind, encoding.widths)
    return [bool(one) for one in guessed == action], None


# What it attends to


def _agent(agent: str, recording: Recording, encodings: dict[str, ActionEncoding]) -> dict[str, Any]:
    model = recording.team.agents[agent]
    others = recording.others_of(agent)
    policy: Any = model.policy
    described = {"algorithm": type(model).__name__, "others": others}
    joint = [moment for episode in recording.episodes for moment in episode.moments]
    moments = [moment.agents[agent] for moment in joint]
    predictions = [moment.prediction for moment in moments if moment.prediction is not None]
    if not predictions:
        return described
    described["belief"] = policy.options.belief
    history = policy.history
    if history is None or not bool(history.valid.any()):
        return described
    # Of the rows that no card shows, the page needs the weight only
    shown = sorted({int(row) for each in predictions for row in each.rows[np.argsort(-each.weights)[:CARDS]] if row >= 0})
    filled = int(history.valid.sum())
    columns = [encodings[other] for other in others]
    remembered = history.observations.cpu().numpy()[shown]
    now = np.array([moment.features for moment in moments])
    strips, current = _strips(remembered, now)
    actions = history.actions.cpu().numpy()
    acts = np.array([_seen_actions(moment, agent, others, encodings) for moment in joint])
    alike = _alike(remembered, now, actions[shown], acts)
    return {
        **described,
        "history": filled,
        "cards": {
            str(row): {
                "age": filled - row,
                "did": _remembered_actions(actions[row], columns),
                "seen": strips[i],
                "like": alike[i],
            }
            for i, row in enumerate(shown)
        },
        "now": current,
    }


def _remembered_actions(row: np.ndarray, encodings: Sequence[ActionEncoding]) -> list[list[float] | None]:
    """Return the others' actions in a row of the history; None for an other that was not visible, which only zeros tell."""
    parts = np.split(row, np.cumsum([encoding.width for encoding in encodings])[:-1])
    return [
        _rounded(decoded_action(part, encoding.kind, encoding.widths)) if part.any() else None
        for part, encoding in zip(parts, encodings, strict=True)
    ]


def _strips(remembered: np.ndarray, now: np.ndarray) -> tuple[list[str], list[str]]:
    """Return observations in a compact form: the columns that vary most, as bytes from the least value to the largest."""
    both = np.concatenate([remembered, now])
    low, high = both.min(axis=0), both.max(axis=0)
    scaled = (both - low) / np.where(high > low, high - low, 1.0)
    most = np.sort(np.argsort(-scaled.std(axis=0), kind="stable")[:_COLUMNS])
    levels = np.rint(255 * scaled[:, most]).astype(np.uint8)
    texts = [base64.b64encode(row.tobytes()).decode() for row in levels]
    return texts[: len(remembered)], texts[len(remembered) :]


def _alike(remembered: np.ndarray, now: np.ndarray, acted: np.ndarray, acts: np.ndarray) -> list[list[Any]]:
    """
    Find the step of the recording at which an agent's observation was most like a remembered one.

    :param remembered: Observations in the history, ``[N, d_o]``
    :param now: Those of the recording, ``[K, d_o]``
    :param acted: What it saw the others do at the remembered steps, ``[N, W]``
    :param acts: The same of the recording, ``[K, W]``
    :return: For each remembered step the number of the step, and whether observation and actions were the same
    """
    low, high = now.min(axis=0), now.max(axis=0)
    scale = np.where(high > low, high - low, 1.0)
    found = []
    for row, others in zip(remembered, acted, strict=True):
        same_actions = np.isclose(acts, others, atol=1e-6).all(axis=1)
        # Of equal observations, those at which the others did the same
        distances = np.abs((now - row) / scale).mean(axis=1) + 1e-9 * ~same_actions
        nearest = int(distances.argmin())
        found.append([nearest, bool(same_actions[nearest] and np.allclose(now[nearest], row, atol=1e-6))])
    return found


def _seen_actions(moment: Moment, agent: str, others: Sequence[str], encodings: dict[str, ActionEncoding]) -> np.ndarray:
    """Return what an agent saw the others do, as the rows of a history hold it, ``[W]``."""
    parts = []
    for other, seen in zip(others, moment.agents[agent].visible, strict=True):
        encoding, action = encodings[other], moment.actions[other]
        part = np.zeros(encoding.width)
        if encoding.kind == "categorical":
            part[action.astype(int) + np.concatenate([[0], np.cumsum(encoding.widths)[:-1]]).astype(int)] = 1.0
        else:
            part[:] = action
        parts.append(part * seen)
    return np.concatenate(parts)


def _number(value: float) -> float:
    return float(f"{value:.4g}")


def _rounded(values: Any) -> list[float]:
    # Shorter than JSON's 17 digits, and whole numbers without a point
    numbers = [float(f"{float(value):.4g}") for value in np.asarray(values).reshape(-1)]
    return [int(number) if number.is_integer() else number for number in numbers]
