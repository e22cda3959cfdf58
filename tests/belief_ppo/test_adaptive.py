"""A belief that adapts while it plays: what it remembers of the rollout under way, and of what an agent does when deployed."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.belief.adaptive import AdaptiveBelief
from sb3_belief.belief.memory import valid_rows
from sb3_belief.belief_ppo import algorithm
from sb3_belief.belief_ppo.adaptive import replayed
from tests.belief_ppo.helpers import ALGORITHMS, ROLLOUT, SMALL, make_model, observations_of, same_parameters
from tests.belief_ppo.test_no_leak import ACTIONS, OBSERVATIONS
from tests.belief_ppo.test_update import check_log_ratios

ADAPTIVE: dict[str, Any] = dict(belief="adaptive", n_own=3, n_pool=4)
N_ENVS, N_STEPS = 3, SMALL["n_steps"]


def adaptive(**kwargs: Any) -> Any:
    return make_model(**{**ADAPTIVE, **kwargs})


class Kept(BaseCallback):
    """Callback that keeps what the environment gave in each step, and at the end of each rollout what was attended to."""

    def __init__(self) -> None:
        super().__init__()
        self.rewards: list[np.ndarray] = []
        self.actions: list[np.ndarray] = []
        self.rollouts: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        # SB3 adds values to the array at time limits
        self.rewards.append(self.locals["rewards"].copy())
        self.actions.append(self.locals["actions"].copy())
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        buffer = model.rollout_buffer
        self.rollouts.append(
            {
                "frozen": valid_rows(model.policy.history),
                "selected": buffer.selected.copy(),
                "stamps": buffer.stamps.copy(),
                "valid": (buffer.active | waits(buffer.active, buffer.episode_starts)) & buffer.attended_visible.any(axis=-1),
            }
        )


def waits(active, starts):
    """Where an agent is out of play within a return in which it has acted."""
    result = np.zeros_like(active)
    for t, copy in zip(*np.nonzero(~active), strict=True):
        first = max((s for s in range(t + 1) if starts[s, copy]), default=0)
        result[t, copy] = active[first:t, copy].any()
    return result


@pytest.mark.parametrize("inactive", [0, 3])
def test_each_step_attends_to_earlier_ones_only(inactive):
    kept = Kept()
    adaptive(env_kwargs=dict(inactive=inactive)).learn(3 * ROLLOUT, callback=kept)
    for number, rollout in enumerate(kept.rollouts):
        frozen, n_frozen = rollout["frozen"], len(rollout["frozen"].valid)
        assert (n_frozen > 0) == (number > 0)
        _, copies = np.divmod(np.arange(N_STEPS * N_ENVS), N_ENVS)
        copy_of = np.concatenate([frozen.stamps[:, 1].numpy(), copies])
        is_valid = np.concatenate([frozen.valid.numpy(), rollout["valid"].reshape(-1)])
        met = 0
        for t in range(N_STEPS):
            for copy in range(N_ENVS):
                rows = rollout["selected"][t, copy]
                own, pool = (part[part >= 0] for part in (rows[:3], rows[3:7]))
                assert rows[7] == -1 and (copy_of[own] == copy).all() and (copy_of[pool] != copy).all()
                both = np.concatenate([own, pool])
                assert is_valid[both].all() and (both < n_frozen + t * N_ENVS).all()
                met += int((both >= n_frozen).sum())
        assert met > N_STEPS
        # The steps are numbered through all rollouts
        assert (rollout["stamps"][..., 1] == np.arange(N_ENVS)).all()
        assert (np.diff(rollout["stamps"][..., 0], axis=0) == 1).all()
        assert not len(frozen.stamps) or frozen.stamps[:, 0].max() < rollout["stamps"][0, 0, 0]
        # Episodes of seven steps
        assert (rollout["stamps"][..., 0] - rollout["stamps"][..., 2] == np.arange(N_STEPS)[:, None] % 7).all()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_memory_holds_what_the_agent_did_and_got(algorithm):
    kept = Kept()
    model = adaptive(algorithm=algorithm, history_length=ROLLOUT, env_kwargs=dict(visible=1.0)).learn(
        2 * ROLLOUT, callback=kept
    )
    history = model.policy.history
    # The last rollout, its episodes' ends included, without the values that SB3 adds to rewards at time limits
    np.testing.assert_allclose(history.own[:, -1], np.concatenate(kept.rewards[N_STEPS:]), atol=1e-5)
    assert np.array_equal(history.own[:, :-1].argmax(dim=1), np.concatenate(kept.actions[N_STEPS:]))
    bootstrapped = model.rollout_buffer.rewards.reshape(N_ENVS, N_STEPS).T.reshape(-1)
    assert not np.allclose(history.own[:, -1], bootstrapped, atol=1e-3)


SWITCHES: list[dict[str, Any]] = [
    {},
    dict(n_own=0),
    dict(n_pool=0),
    dict(n_own=200, n_pool=200),
    dict(history_dropout=0.5),
    dict(belief_replay=2),
    dict(prediction_steps=3, belief_replay=2),
    dict(critic_sees_others=True),
    dict(row_features=["reward", "episode"]),
    dict(action_loss="cross_entropy"),
    dict(detach_belief=True),
    dict(history_length=4),
]


@pytest.mark.parametrize("inactive", [0, 3])
@pytest.mark.parametrize("switches", SWITCHES, ids=str)
def test_the_ratio_starts_at_one(switches, inactive):
    check_log_ratios(adaptive(env_kwargs=dict(inactive=inactive), learning_rate=1e-2, **switches), n_iterations=3)


def test_dropped_steps_see_the_null_row_only():
    kept = Kept()
    adaptive(n_steps=200, batch_size=600, n_epochs=1, history_dropout=0.25).learn(2 * 600, callback=kept)
    nothing = (kept.rollouts[1]["selected"] < 0).all(axis=-1)
    # Four standard errors of 600 draws
    assert abs(nothing.mean() - 0.25) < 0.07


class Later(BaseCallback):
    """Callback that keeps a rollout's rows, and what each is trained to predict of later steps, before and in the update."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        buffer = model.rollout_buffer
        whole: dict[str, Any] = {
            name: getattr(buffer, name).copy() for name in ("others_actions", "others_visible", "episode_starts")
        }
        whole["before"] = buffer.belief_minibatch(buffer.rows_of(np.arange(ROLLOUT)))
        next(buffer.get(4))
        whole["after"] = buffer.belief_minibatch(buffer.rows_of(np.arange(ROLLOUT)))
        self.seen.append(whole)


@pytest.mark.parametrize("inactive", [0, 3])
def test_later_steps_are_those_of_the_same_episode(inactive):
    later = Later()
    adaptive(prediction_steps=3, env_kwargs=dict(inactive=inactive)).learn(2 * ROLLOUT, callback=later)
    for whole in later.seen:
        n_seen = 0
        for number in range(ROLLOUT):
            t, copy = divmod(number, N_ENVS)
            for ahead in (1, 2):
                goes_on = t + ahead < N_STEPS and not whole["episode_starts"][t + 1 : t + ahead + 1, copy].any()
                visible = whole["others_visible"][t + ahead, copy] if goes_on else np.zeros(2, dtype=bool)
                for part in (whole["before"], whole["after"]):
                    assert np.array_equal(part.later_visible[number, ahead - 1], visible)
                    if goes_on:
                        actions = whole["others_actions"][t + ahead, copy]
                        assert np.array_equal(part.later_actions[number, ahead - 1], actions)
                n_seen += int(visible.sum())
        assert n_seen > ROLLOUT / 2


def test_later_steps_have_a_part_of_the_loss():
    model = adaptive(prediction_steps=3, action_loss="cross_entropy", env_kwargs=dict(visible=1.0)).learn(ROLLOUT)
    policy, buffer = model.policy, model.rollout_buffer
    table = policy.history
    some = buffer.belief_minibatch(np.arange(ROLLOUT))
    flat = policy.flat_observations(th.as_tensor(buffer.observations))
    output = policy.features_extractor.judged(flat, some._replace(selected=th.full_like(some.selected, -1)), table)
    width = policy.layout.width
    logits = policy.belief.decoder(output.mean)
    errors = []
    for step in range(3):
        actions = some.others_actions if step == 0 else some.later_actions[:, step - 1]
        visible = some.others_visible if step == 0 else some.later_visible[:, step - 1]
        error = th.zeros(())
        for other, (_, first, n) in enumerate(policy.layout.blocks):
            columns = logits[:, step * width + first : step * width + first + n]
            likelihood = (columns.log_softmax(dim=1) * actions[:, first : first + n]).sum(dim=1)
            error = error - likelihood[visible[:, other]].sum()
        errors.append(error / visible.sum())
    th.testing.assert_close(policy.predictions_error(output, some), sum(errors) / 3)
    # Policy and value are given the present step's alone
    assert policy.features_extractor.belief_width == policy.belief.latent_dim + width


def test_own_actions_are_remembered_as_the_environment_got_them():
    model = adaptive(env_kwargs=dict(action_space=spaces.Box(-0.5, 0.5, (2,), np.float32), visible=1.0)).learn(ROLLOUT)
    buffer = model.rollout_buffer
    assert abs(buffer.actions).max() > 0.5
    own = model.policy.history.own[:, :-1]
    assert own.abs().max() == 0.5 and len({*own.flatten().tolist()}) > 10


def test_what_a_row_does_not_tell_changes_nothing():
    """Through the arguments of BeliefPPO: the reward of a remembered step, and whether it is of the same episode."""
    for features, name in (([], "reward"), (["reward"], "episode"), (["reward", "episode"], None)):
        model = adaptive(row_features=features).learn(2 * ROLLOUT)
        policy, obs = model.policy, observations_of(model, 4)
        policy.remember(obs, {"b": np.arange(4) % 3}, copies=np.arange(4))

        def found(policy=policy, obs=obs):
            return policy.predict_others(obs).mean

        before, history = found(), policy.history
        policy.restore_history(history._replace(own=history.own + th.tensor([0.0, 0.0, 0.0, 1.0])))
        assert np.array_equal(found(), before) == (name == "reward")
        policy.restore_history(history)
        policy.end_episodes()
        assert np.array_equal(found(), before) == (name in ("reward", "episode"))


def test_values_attend_to_the_rollout_as_acting_does(monkeypatch):
    """Those of the last observations, and those at time limits, not to the history from before it."""
    asked: list[tuple[int, int]] = []
    forward = AdaptiveBelief.forward

    def spied(self, observations, stamps, memory, *args, **kwargs):
        if not th.is_grad_enabled():
            asked.append((len(observations), len(memory.valid)))
        return forward(self, observations, stamps, memory, *args, **kwargs)

    monkeypatch.setattr(AdaptiveBelief, "forward", spied)
    adaptive(history_length=4, n_epochs=1, n_envs=2).learn(2 * N_STEPS * 2, callback=(rollouts := AtRollouts(asked)))
    assert len(rollouts.spans) == 2
    for begin, end in rollouts.spans:
        frozen = asked[begin][1]
        assert (frozen > 0) == (begin > 0)
        # All copies at each step, once more where the episodes of both end, and the observations after the last step
        steps = [t for t in range(N_STEPS) for _ in range(2 if t % 7 == 6 else 1)]
        assert asked[begin:end] == [(2, frozen + 2 * t) for t in [*steps, N_STEPS]]


class AtRollouts(BaseCallback):
    """Callback that notes which of the entries of a list were added in each rollout."""

    def __init__(self, entries: list[Any]) -> None:
        super().__init__()
        self.entries = entries
        self.spans: list[tuple[int, int]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.begin = len(self.entries)

    def _on_rollout_end(self) -> None:
        self.spans.append((self.begin, len(self.entries)))


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(n_own=-1), "n_own=-1 must be an integer >= 0"),
        (dict(n_pool=1.5), "n_pool=1.5 must be an integer"),
        (dict(n_own=0, n_pool=0), "nothing would be attended to"),
        (dict(belief_replay=-1), "belief_replay=-1 must be an integer >= 0"),
        (dict(critic_sees_others=1), "critic_sees_others is 1; it must be True or False"),
        (dict(belief="dynamic", critic_sees_others=True), "belongs to belief='adaptive', and belief is 'dynamic'"),
        (dict(prediction_steps=0), "prediction_steps=0 must be an integer >= 1"),
        (dict(history_dropout=1.0), r"history_dropout is 1.0; it must be in \[0, 1\)"),
        (dict(row_features=["rewards"]), "row_features: an entry is 'rewards'; it must be one of 'own_action', 'reward'"),
        (dict(row_features="reward"), "row_features is 'reward'"),
        (dict(row_features=None), "row_features is None; it must be a list"),
        (dict(history_dropout="0.1"), "history_dropout is '0.1'"),
        (dict(history_dropout=None), "history_dropout is None"),
    ],
)
def test_wrong_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        adaptive(**kwargs)


def test_past_rollouts_are_replayed():
    model = adaptive(belief_replay=2).learn(3 * ROLLOUT)
    kept = model.rollout_buffer.replay
    last = [int(part["minibatch_stamps"][:, 0].max()) for part in kept]
    # The last two of three, with the tables of then
    assert last == [2 * N_STEPS - 1, 3 * N_STEPS - 1]
    for part, end in zip(kept, last, strict=True):
        assert end - N_STEPS < part["table_stamps"][:, 0].max() < end and len(part["flat"]) == ROLLOUT
        selected, stamps = part["minibatch_selected"], part["minibatch_stamps"]
        # Nobody attends to what is not there, and nothing is there to which nobody attends
        assert np.unique(selected[selected >= 0]).tolist() == list(range(len(part["table_stamps"])))
        # A step attends to earlier ones only
        ages = stamps[:, None, 0] - part["table_stamps"][selected.clip(min=0), 0]
        assert (ages[selected >= 0] > 0).all()


def test_what_is_replayed_is_believed_as_it_was():
    model, found = adaptive(), []
    real = algorithm.to_be_replayed

    def compared(table, flat, minibatch):
        kept = replayed(real(table, flat, minibatch), model.device)
        assert len(kept.table.valid) < len(table.valid)
        judged = model.policy.features_extractor.judged
        found.append((judged(flat, minibatch, table).mean, judged(flat, kept.minibatch, kept.table).mean))
        return real(table, flat, minibatch)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(algorithm, "to_be_replayed", compared)
        model.learn(3 * ROLLOUT)
    assert len(found) == 3
    for whole, part in found:
        th.testing.assert_close(part, whole, rtol=1e-5, atol=1e-6)


def test_a_replay_trains_the_belief_and_leaves_policy_and_value_alone():
    model = adaptive(belief_replay=1).learn(2 * ROLLOUT)
    extractor = model.policy.features_extractor
    extractor.replay = [replayed(kept, model.device) for kept in model.rollout_buffer.replay]
    model.policy.optimizer.zero_grad()
    model.policy._replayed_loss(extractor).backward()
    trained = {name for name, weight in model.policy.named_parameters() if weight.grad is not None and weight.grad.any()}
    assert "features_extractor.belief.decoder.weight" in trained and "features_extractor.belief.key.weight" in trained
    assert all(name.startswith("features_extractor.belief.") for name in trained)
    # The loss is that of the prediction which was made then
    past = extractor.replay[0]
    output = extractor.judged(past.flat, past.minibatch, past.table)
    expected = model.policy.action_coef * model.policy.action_error(output.prediction, past.minibatch)
    assert th.equal(model.policy._replayed_loss(extractor), expected)
    # And it makes a difference
    assert not same_parameters(model, adaptive(belief_replay=0).learn(2 * ROLLOUT))


def test_the_rollout_does_not_outlive_its_end():
    model = adaptive().learn(ROLLOUT)
    extractor = model.policy.features_extractor
    assert extractor.online is None and extractor.table is None and extractor.replay == []


@pytest.mark.parametrize("observations", ["image", "dict", "discrete"])
@pytest.mark.parametrize("actions", ["box", "multi-discrete", "multi-binary"])
def test_any_spaces(observations, actions):
    env_kwargs = dict(observation_space=OBSERVATIONS[observations], action_space=ACTIONS[actions])
    check_log_ratios(adaptive(env_kwargs=env_kwargs, learning_rate=1e-2), n_iterations=2)
