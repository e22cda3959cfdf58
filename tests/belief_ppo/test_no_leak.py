"""Nothing of an action that the agent could not see reaches it, bit for bit."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import sb3_belief.belief_ppo.algorithm as algorithm_module
from sb3_belief.belief import filled_rows
from sb3_belief.belief_ppo import MaskableBeliefPPO
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, VARIANTS, Trace, make_model, same_parameters

OBSERVATIONS: dict[str, spaces.Space] = {
    "vector": spaces.Box(-1, 1, (5,), np.float32),
    "image": spaces.Box(0, 255, (3, 36, 36), np.uint8),
    "discrete": spaces.Discrete(6),
    "multi-discrete": spaces.MultiDiscrete([3, 4]),
    "multi-binary": spaces.MultiBinary(5),
    "dict": spaces.Dict(kind=spaces.Discrete(4), image=spaces.Box(0, 255, (3, 36, 36), np.uint8), at=spaces.Box(-1, 1, (2,))),
}
ACTIONS: dict[str, spaces.Space] = {
    "discrete": spaces.Discrete(3),
    "box": spaces.Box(-1, 1, (2,), np.float32),
    "multi-discrete": spaces.MultiDiscrete([2, 3]),
    "multi-binary": spaces.MultiBinary(2),
}
#: Each of another kind and width
ALL_KINDS: dict[str, spaces.Space] = {
    "b": spaces.Discrete(3),
    "c": spaces.Box(-5, 5, (2,), np.float32),
    "d": spaces.MultiDiscrete([2, 4]),
    "e": spaces.MultiBinary(3),
}
FINITE = {name: space for name, space in ALL_KINDS.items() if name != "c"}
FEW: dict[str, Any] = dict(n_envs=2, n_steps=6, batch_size=6, n_epochs=1, history_length=20, keep_ratio=0.3)


def trace(seed: int, env_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> Trace:
    """A training of three iterations, in which ``seed`` draws the actions that the agent does not see."""
    result = Trace()
    model = make_model(env_kwargs={"others": ALL_KINDS, **(env_kwargs or {}), "invisible_seed": seed}, **{**FEW, **kwargs})
    model.learn(3 * 12, callback=result)
    assert not model.policy.has_belief or not model.rollout_buffer.others_visible.all()
    return result


def traces(**kwargs: Any) -> list[Trace]:
    """Two trainings that differ in nothing but the actions that the agent does not see."""
    return [trace(seed, **kwargs) for seed in (0, 1)]


@pytest.mark.parametrize("actions", ACTIONS)
@pytest.mark.parametrize("observations", OBSERVATIONS)
def test_an_invisible_action_changes_nothing_in_any_space(observations, actions):
    first, second = traces(env_kwargs=dict(action_space=ACTIONS[actions], observation_space=OBSERVATIONS[observations]))
    assert first.differences(second) == set()
    kinds = {name.split(" ")[0] for name, _ in first.entries}
    assert kinds == {"rollout", "gradient", "state", "log", "last"}
    assert any("history_actions" in name and value.any() for name, value in first.entries)
    ratios = [value for name, value in first.entries if name.endswith("belief/first_log_ratio")]
    assert len(ratios) == 3 and max(ratios) < 1e-5


@pytest.mark.parametrize("actions", ["discrete", "multi-discrete", "multi-binary"])
@pytest.mark.parametrize("observations", ["vector", "dict"])
def test_an_invisible_action_changes_nothing_with_masks(observations, actions):
    env_kwargs = dict(action_space=ACTIONS[actions], observation_space=OBSERVATIONS[observations])
    first, second = traces(env_kwargs=env_kwargs, algorithm=MaskableBeliefPPO)
    assert first.differences(second) == set()


SWITCHES: list[dict[str, Any]] = [
    *(dict(belief=variant) for variant in (*VARIANTS[1:], "none")),
    *(dict(belief=variant, action_loss="cross_entropy", env_kwargs=dict(others=FINITE)) for variant in VARIANTS),
    dict(policy_latent="mean"),
    dict(similarity="observation"),
    dict(detach_belief=True),
    dict(env_kwargs=dict(inactive=3)),
    dict(belief="adaptive", env_kwargs=dict(inactive=3), prediction_steps=3, belief_replay=2, critic_sees_others=True),
]


@pytest.mark.parametrize("switches", SWITCHES, ids=str)
def test_an_invisible_action_changes_nothing_in_any_variant(switches):
    first, second = traces(**switches)
    assert first.differences(second) == set()


@pytest.mark.parametrize("other", ALL_KINDS)
def test_an_invisible_action_of_a_single_other_changes_nothing(other):
    first, second = traces(env_kwargs=dict(others={other: ALL_KINDS[other]}))
    assert first.differences(second) == set()


def test_an_invisible_action_that_is_no_number_changes_nothing(monkeypatch):
    read = algorithm_module.read_others

    def careless(infos, layout):
        for info in infos:
            hidden = ~info["others_visible"][layout.owners]
            info["others_actions"] = np.where(hidden, np.float32(np.nan), info["others_actions"])
        return read(infos, layout)

    clean = trace(0)
    monkeypatch.setattr(algorithm_module, "read_others", careless)
    assert clean.differences(trace(0)) == set()


def test_a_leak_would_be_noticed(monkeypatch):
    def leaking(infos, layout):
        return np.stack([info["others_actions"] for info in infos]), np.stack([info["others_visible"] for info in infos])

    monkeypatch.setattr(algorithm_module, "read_others", leaking)
    first, second = traces()
    found = first.differences(second)
    assert "rollout others_actions" in found
    for part in ("key.weight", "decoder.weight", "action_net.weight"):
        assert any(name.startswith("gradient") and name.endswith(part) for name in found)
    assert any(name.startswith("log") and name.endswith("belief/action_loss") for name in found)


def test_nothing_of_an_invisible_other_reaches_the_agent():
    models = [make_model(env_kwargs=dict(invisible_seed=seed)).learn(4 * ROLLOUT) for seed in (0, 1)]
    hidden = [model.env.envs[0].unwrapped.invisible.random(4).tolist() for model in models]
    assert hidden[0] != hidden[1]
    assert same_parameters(*models)
    for name in ("others_actions", "others_visible", "noise", "selected", "advantages", "log_probs"):
        first, second = (getattr(model.rollout_buffer, name) for model in models)
        assert np.array_equal(first, second), name
    for a, b in zip(models[0].policy.optimizer.state.values(), models[1].policy.optimizer.state.values(), strict=True):
        assert th.equal(a["exp_avg"], b["exp_avg"])


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("belief", ["dynamic", "context"])
def test_the_history_never_holds_a_row_of_the_rollout_trained_on(algorithm, belief):
    # A history longer than a rollout: it would have room for it
    model = make_model(algorithm=algorithm, belief=belief, history_length=100, env_kwargs=dict(inactive=5))
    checked, step = [], model.policy.optimizer.step

    def rows(array) -> set[bytes]:
        return {row.tobytes() for row in np.asarray(array, dtype=np.float32).reshape(-1, 5)}

    def watched(*args):
        history, rollout = rows(filled_rows(model.policy.history).observations), rows(model.rollout_buffer.observations)
        assert len(rollout) == ROLLOUT and not history & rollout
        checked.append(len(history))
        return step(*args)

    model.policy.optimizer.step = watched
    model.learn(4 * ROLLOUT)
    n_active = int(model.rollout_buffer.active.sum())
    assert 30 < n_active < ROLLOUT
    assert len(checked) == 4 * 6 and set(checked) == {0, checked[6], checked[12], 100} and 30 < checked[6] < checked[12] < 100
    assert rows(model.policy.history.observations) & rows(model.rollout_buffer.observations)


# -- visibility at its extremes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_loss", ["mse", "cross_entropy"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_others_that_are_never_visible_teach_nothing(algorithm, action_loss):
    env_kwargs = dict(visible=0.0, others=FINITE)
    first, second = traces(env_kwargs=env_kwargs, algorithm=algorithm, action_loss=action_loss)
    assert first.differences(second) == set()
    names = {name for name, _ in first.entries}
    assert not any(name.endswith(("belief/accuracy", "belief/base_rate")) for name in names)
    for name, value in first.entries:
        assert np.isfinite(value).all(), name
        if name.endswith(("belief/action_loss", "belief/history_gain", "belief/visible_fraction", "history_actions")):
            assert not value.any(), name
        if name.startswith("gradient") and "decoder" in name:
            assert not value.any(), name
    assert any(name.startswith("gradient") and "encoder" in name and value.any() for name, value in first.entries)


def test_others_that_are_always_visible_are_all_trained_on():
    model = make_model(env_kwargs=dict(visible=1.0)).learn(2 * ROLLOUT)
    assert model.rollout_buffer.others_visible.all()
    assert model.logger.name_to_value["belief/visible_fraction"] == 1
    assert (model.policy.history.actions.sum(dim=1) == 2).all()  # one one-hot vector of each


@pytest.mark.parametrize("belief", VARIANTS)
def test_many_others(belief):
    kinds = [spaces.Discrete(2), spaces.MultiBinary(2), spaces.MultiDiscrete([2, 3]), spaces.Box(-1, 1, (1,), np.float32)]
    others = {f"other_{i}": kinds[i % 4] for i in range(12)}
    first, second = traces(env_kwargs=dict(others=others), belief=belief)
    assert first.differences(second) == set()
    width = next(value for name, value in first.entries if name == "rollout others_actions").shape[-1]
    assert width == 3 * (2 + 2 + 5 + 1)
