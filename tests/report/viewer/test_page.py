import json
import re

import numpy as np
import pytest

from sb3_belief.common.action_encoding import action_encoding
from sb3_belief.report.viewer.page import viewer_page, write_viewer
from sb3_belief.report.viewer.page_data import CARDS, judge, page_data
from tests.report.recorded import LIMIT, SCRIPTED, SPACES, recorded, trained


@pytest.fixture(scope="module")
def recording():
    return recorded(*trained(), episodes=2)


@pytest.fixture(scope="module")
def data(recording):
    # As a browser reads it
    return json.loads(json.dumps(page_data(recording, "A title", "below it"), allow_nan=False))


def pairs(recording, data):
    """Each step as recorded and as on the page."""
    return [
        (moment, step)
        for episode, shown in zip(recording.episodes, data["episodes"], strict=True)
        for moment, step in zip(episode.moments, shown["steps"], strict=True)
    ]


def test_the_page_has_the_numbers_of_the_recording(recording, data):
    assert len(pairs(recording, data)) == 2 * LIMIT
    assert data["names"] == [*SPACES, "clock"] and list(data["agents"]) == list(SPACES)
    assert [episode["return"] for episode in data["episodes"]] == pytest.approx(
        [episode.team_return for episode in recording.episodes], rel=1e-3
    )
    for moment, step in pairs(recording, data):
        assert step["frame"] == moment.frame < len(data["frames"])
        for name, action in moment.actions.items():
            assert step["did"][name] == pytest.approx(action.tolist(), rel=1e-3)
        for agent, mine in moment.agents.items():
            view, others = step["views"][agent], recording.others_of(agent)
            assert view["sees"] == mine.visible.tolist() and view["active"] == mine.active
            assert view["own"]["numbers"] == pytest.approx(mine.choice.numbers.tolist(), rel=1e-3, abs=1e-9)
            for other, expected in zip(others, view["expects"], strict=True):
                assert expected == pytest.approx(mine.prediction.actions[other].tolist(), rel=1e-3, abs=1e-9)
            assert dict(view["rows"]) == pytest.approx(
                dict(zip(mine.prediction.rows.tolist(), mine.prediction.weights.tolist(), strict=True)), abs=1e-5
            )
            weights = [weight for _, weight in view["rows"]]
            assert weights == sorted(weights, reverse=True) and sum(weights) == pytest.approx(1.0, abs=1e-3)


def test_right_and_wrong_count_only_where_the_agent_saw(recording, data):
    counted = 0
    for moment, step in pairs(recording, data):
        for agent, view in step["views"].items():
            for k, other in enumerate(recording.others_of(agent)):
                right, expected, did = view["right"][k], np.array(view["expects"][k]), step["did"][other]
                if other == "numbers":
                    assert right is None
                    assert view["error"][k] == pytest.approx(np.abs(expected - did).mean(), rel=2e-3)
                elif not (view["sees"][k] and moment.agents[agent].active):
                    assert right is None
                elif other == "switches":
                    assert right == [(p > 0.5) == (d == 1) for p, d in zip(expected, did, strict=True)]
                else:
                    parts = np.split(expected, np.cumsum(action_encoding(other, recording.action_spaces[other]).widths)[:-1])
                    assert right == [int(part.argmax()) == d for part, d in zip(parts, did, strict=True)]
                    counted += 1
    assert counted > 2 * LIMIT


@pytest.mark.parametrize(
    ("space", "expected", "action", "right", "error"),
    [
        (SCRIPTED, [0.4, 0.6], [1], [True], None),
        (SPACES["several"], [0.9, 0.1, 0.2, 0.3, 0.5], [0, 1], [True, False], None),
        (SPACES["switches"], [0.9, 0.1, 0.6], [1, 0, 0], [True, True, False], None),
        (SPACES["numbers"], [0.5, -1.0], [1.0, -1.5], None, 0.5),
    ],
)
def test_judge(space, expected, action, right, error):
    assert judge(np.array(expected), np.array(action), action_encoding("other", space)) == (right, error)


def test_cards_say_what_happened_at_the_rows_that_are_attended_to(recording, data):
    for agent, model in recording.team.agents.items():
        history, shown = model.policy.history, data["agents"][agent]
        filled = int(history.valid.sum())
        assert shown["history"] == filled > 0 and len(shown["now"]) == 2 * LIMIT
        first = {row for _, step in pairs(recording, data) for row, _ in step["views"][agent]["rows"][:CARDS]}
        assert {int(row) for row in shown["cards"]} == first
        for row, card in shown["cards"].items():
            assert card["age"] == filled - int(row) >= 1
            actions = history.actions[int(row)].numpy()
            start = 0
            for other, did in zip(recording.others_of(agent), card["did"], strict=True):
                encoding = action_encoding(other, recording.action_spaces[other])
                part = actions[start : start + encoding.width]
                start += encoding.width
                if did is None:
                    assert not part.any()
                elif encoding.kind == "categorical":
                    assert [column for column in np.flatnonzero(part)] == [
                        index + offset for index, offset in zip(did, np.cumsum([0, *encoding.widths[:-1]]), strict=True)
                    ]
                else:
                    assert did == pytest.approx(part.tolist(), rel=1e-3)
            # The environment draws its observations anew, so nothing of the training lies in these episodes
            assert 0 <= card["like"][0] < 2 * LIMIT and card["like"][1] is False


@pytest.mark.parametrize("shift", [0.0, 0.25])
def test_a_moment_of_the_episode_in_the_history_is_found(shift):
    team, env = trained()
    moments = recorded(team, env).episodes[0].moments
    observations = np.concatenate([moment.agents["several"].observation for moment in moments])
    others = {
        name: np.stack([moment.actions[name].reshape(space.shape) for moment in moments])
        for name, space in {**SPACES, "clock": SCRIPTED}.items()
        if name != "several"
    }
    # With other actions the same observation is another moment
    others["numbers"] = others["numbers"] + shift
    seen = np.stack([moment.agents["several"].visible for moment in moments])
    seen[:, 2] = True
    visible = {name: seen[:, k] for k, name in enumerate(others)}
    team.agents["several"].policy.remember(observations, others, visible)
    recording = recorded(team, env)
    for moment in recording.episodes[0].moments:
        moment.agents["several"].visible[2] = True
    cards = page_data(recording, "")["agents"]["several"]["cards"]
    same = {LIMIT - card["age"]: card["like"][0] for card in cards.values() if card["like"][1]}
    assert bool(same) == (shift == 0.0) and all(step == row for row, step in same.items())


def test_nothing_is_loaded_and_no_text_becomes_html(recording, tmp_path):
    page = viewer_page(recording, "</script><script>alert(1)</script>", "{{program}} <img src=x onerror=alert(2)>")
    assert page.count("<script") == 2 and "alert(1)</script>" not in page.replace("&lt;", "<").split("</title>")[1]
    assert "default-src 'none'" in page
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert data is not None
    read = json.loads(data[1])
    assert read["title"] == "</script><script>alert(1)</script>" and read["subtitle"].startswith("{{program}}")
    assert read["spaces"]["discrete"]["labels"] == [["stay", "<b>left</b>", "right"]]
    outside = page.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(
        r"https?://|//[a-z]+\.|@import|url\(|<link|src=\"(?!data:)|fetch\(|XMLHttpRequest|innerHTML",
        outside.replace(data[1], ""),
    )
    path = write_viewer(recording, tmp_path / "new" / "page.html", "T")
    assert path.read_text(encoding="utf-8").startswith("<!doctype html>") and path.stat().st_size < 1_000_000


def test_the_agent_that_is_shown_first(recording, data):
    assert data["agent"] in SPACES and page_data(recording, "", agent="several")["agent"] == "several"
    assert page_data(recording, "")["agents"]["several"]["belief"] == "dynamic"


@pytest.mark.parametrize("belief", ["static", "wide", "none"])
def test_beliefs_without_a_history_and_none(belief):
    recording = recorded(*trained(belief=belief))
    data = page_data(recording, "")
    view = data["episodes"][0]["steps"][0]["views"]["several"]
    assert ("expects" in view) == (belief == "static") and "cards" not in data["agents"]["several"]
    assert data["agents"]["several"].get("belief") == (belief if belief == "static" else None)
    assert view["own"]["kind"] == "probabilities"


def test_the_null_row_of_an_adaptive_belief_is_no_step():
    recording = recorded(*trained(belief="adaptive"), episodes=1)
    data = page_data(recording, "")
    shares = []
    for moment, step in pairs(recording, data):
        for agent, mine in moment.agents.items():
            rows = dict(step["views"][agent]["rows"])
            assert -1 not in rows and set(rows) == {int(row) for row in mine.prediction.rows if row >= 0}
            shares.append(sum(rows.values()))
    assert 0 < min(shares) and max(shares) < 1
    assert all(card["age"] > 0 for agent in data["agents"].values() for card in agent["cards"].values())
