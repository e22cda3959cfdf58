"""Pools of partners: who is drawn when, and that only the log is told."""

import csv
import io
from typing import Any

import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO

from sb3_belief.baselines import IQL
from sb3_belief.common.redraws import RedrawSchedule
from sb3_belief.team import PartnerPool, PartnersVecEnv
from sb3_belief.vec_env.observe_last import ObserveLastVecEnv
from tests.team.fixed_partners.helpers import one, save_exploring_team, toy, zero
from tests.team.helpers import PPO_KWARGS, Record, Team, make_team_env, parameters
from tests.team.partners.helpers import ZERO_ONE, noisy, partnered, play, pool_of, saved_team


def drawn(schedule, number, n, copy_seed=0):
    return str(schedule.draw(number, [1.0] * n, copy_seed))


def test_each_copy_draws_by_its_seed_every_k_episodes():
    env = partnered({"agent_1": pool_of(3, redraw_every=2, seed=7)}, n_envs=4, seed=10)
    steps = play(env, 7 * 8, begin=True)
    schedule = RedrawSchedule(2, "episodes", True, 7)
    expected = [[drawn(schedule, t // 14, 3, 10 + copy) for copy in range(4)] for t in range(7 * 8)]
    # The partner that has acted in a step is named in its info, and its action was its name
    assert [names for _, names in steps] == expected
    assert [[str(action) for action in actions] for actions, _ in steps] == expected
    assert len({tuple(names) for names in expected}) > 2
    # A reset without a seed ends the episodes under way, and one with a seed begins anew
    play(env, 3)
    env.reset()
    assert env.get_attr("partner") == [drawn(schedule, 4, 3, 10 + copy) for copy in range(4)]
    env.seed(10)
    env.reset()
    assert env.get_attr("partner", [1]) == [expected[0][1]]


def test_all_copies_change_with_the_teams_rollouts():
    pool = pool_of(2, redraw_every=3, redraw_unit="rollouts", per_copy=False, seed=1)
    env = make_team_env(toy(2), n_envs=2)
    record = Record(keep=("infos",))
    team = Team(PPO, "MlpPolicy", env, seed=0, partners={"agent_1": pool}, **PPO_KWARGS)
    team.learn(2 * 8 * 9, callback=record)
    schedule = RedrawSchedule(3, "rollouts", False, 1)
    names = [[info["partner"] for info in kept["infos"]] for kept in record.kept]
    assert names == [[drawn(schedule, t // 24, 2)] * 2 for t in range(8 * 9)]
    assert len(set(map(tuple, names))) == 2
    # A further learn() goes on with the next rollout
    team.learn(16, callback=record, reset_num_timesteps=False)
    assert record.kept[-1]["infos"][0]["partner"] == drawn(schedule, 3, 2)
    # Where no team learns, no rollouts pass
    alone = partnered({"agent_1": pool})
    assert {names[0] for _, names in play(alone, 40, begin=True)} == {drawn(schedule, 0, 2)}


def test_weights_and_held_out_members():
    pool = pool_of(4, weights=[1, 0, 3, 2], held_out=["3"])

    def counts(**kwargs: Any):
        env = partnered({"agent_1": pool}, n_envs=50, **kwargs)
        names = [name for _, names in play(env, 7 * 8, begin=True)[::7] for name in names]
        return {name: names.count(name) / len(names) for name in set(names)}

    found = counts()
    assert found.keys() == {"0", "2"} and found["2"] == pytest.approx(0.75, abs=0.06)
    assert counts(evaluation=True) == {"3": 1.0}
    # Without any that is held out evaluations meet all, each for one episode
    both = PartnerPool(ZERO_ONE, redraw_every=None, redraw_unit="rollouts", per_copy=False)
    steps = play(partnered({"agent_1": both}, n_envs=8, evaluation=True), 7 * 4, begin=True)
    by_episode = [{names[i] for _, names in steps[t : t + 7]} for t in range(0, 28, 7) for i in range(8)]
    assert all(len(names) == 1 for names in by_episode) and set.union(*by_episode) == {"zero", "one"}


def test_a_pool_of_several_agents_is_drawn_for_all_of_them(tmp_path):
    members = {"zeros": zero, "mixed": {"agent_1": zero, "agent_3": one}}
    pool, other = PartnerPool(members), pool_of(2, seed=5)
    partners = {"agent_3": pool, "agent_1": pool, "agent_0": other}
    env = PartnersVecEnv(make_team_env(toy(4), n_envs=6, seed=0), partners)
    env.reset()
    met = set()
    for _ in range(30):
        for info in env.step({"agent_2": np.ones(6, int)})[3]:
            other_name, name = info["partner"].split("+")
            did = info["scripted_actions"].reshape(3, 3).argmax(axis=1).tolist()
            assert did == [int(other_name), 0, int(name == "mixed")]
            met.add(info["partner"])
    assert len(met) == 4
    wrong = PartnerPool({"lacking": {"agent_1": zero}})
    with pytest.raises(ValueError, match=r"'lacking' .* partners for \['agent_1'\], but .* \['agent_1', 'agent_3'\]"):
        PartnersVecEnv(make_team_env(toy(4)), {"agent_1": wrong, "agent_3": wrong})


@pytest.mark.parametrize("schedule", [{}, {"redraw_unit": "rollouts", "per_copy": False}])
def test_two_pools_draw_apart(schedule):
    env = partnered({"agent_1": pool_of(3, **schedule), "agent_2": pool_of(3, **schedule)}, n_agents=3, n_envs=60)
    env.reset()
    met = set()
    for _ in range(40):
        env.begin_rollout()
        met |= set(env.partner_names)
    assert len(met) == 9


def test_the_memory_starts_with_a_partner_who_comes_with_a_rollout():
    pool = pool_of(3, redraw_unit="rollouts", per_copy=False)
    env = ObserveLastVecEnv(partnered({"agent_1": pool}, n_envs=2), observe_last=True, partner_starts=True)
    env.reset()
    changes = 0
    for _ in range(12):
        before = env.get_attr("partner")
        env.begin_rollout()
        came = env.get_attr("partner") != before
        changes += came
        for starts in (came, False):
            obs = env.step({"agent_0": np.ones(2, int)})[0]["agent_0"]
            assert obs["memory_start"].ravel().tolist() == [starts] * 2
            # What the newcomer did in its first step is not lost, nor at the ends of episodes
            expected = np.eye(3)[[int(name) for name in env.get_attr("partner")]]
            np.testing.assert_array_equal(obs["observation"][:, 2:5], expected)
    assert 4 < changes < 12


def test_each_present_member_makes_one_pass_and_keeps_its_memory(tmp_path):
    """In a pool of recurrent members every copy is played as by its member alone."""
    kwargs: dict[str, Any] = {"policy_kwargs": {"lstm_hidden_size": 4}}
    paths = {f"r{s}": saved_team(tmp_path / f"r{s}.zip", RecurrentPPO, "MlpLstmPolicy", seed=s, **kwargs) for s in range(3)}
    pool = PartnerPool(paths, seed=3)
    env = partnered({"agent_1": pool}, n_envs=6, seed=20, deterministic=True)
    calls: list[int] = []

    def counted(predict):
        def call(obs, *args):
            calls.append(len(obs))
            return predict(obs, *args)

        return call

    members: Any = env._seats[0][0]._members
    for member in members:
        member._predictor.predict = counted(member._predictor.predict)
    steps = play(env, 28, begin=True)
    assert sum(calls) == 28 * 6 and len(calls) == sum(len(set(names)) for _, names in steps)
    for copy in range(6):
        # The same copy in an environment of its own: only the draws of this copy, one after the other
        alone = partnered({"agent_1": pool}, n_envs=1, seed=20 + copy, deterministic=True)
        assert [(did[copy], names[copy]) for did, names in steps] == [
            (did[0], names[0]) for did, names in play(alone, 28, begin=True)
        ]


def test_a_state_of_unknown_form_is_refused_only_where_it_would_have_to_be_divided():
    class Counts:
        def predict(self, obs, state=None, episode_start=None, deterministic=False):
            return np.zeros(len(obs), int), (0,)

    members = {"a": Counts(), "b": Counts()}
    same = PartnerPool(members, redraw_unit="rollouts", per_copy=False)
    assert len(play(partnered({"agent_1": same}, n_envs=3), 8, begin=True)) == 8
    with pytest.raises(TypeError, match="of which the copies cannot be told apart"):
        play(partnered({"agent_1": PartnerPool(members)}, n_envs=8), 30, begin=True)


def test_learners_do_not_learn_who_the_partner_is():
    """Two pools whose members act alike and have other names teach the same, to the bit."""

    def learned(names):
        pool = PartnerPool(dict(zip(names, (zero, zero), strict=True)))
        team = Team(PPO, "MlpPolicy", make_team_env(toy(3), n_envs=2), seed=4, partners={"agent_1": pool}, **PPO_KWARGS)
        seen: list[Any] = []

        def look(local: dict[str, Any], _: Any) -> None:
            seen.append(local["infos"])

        team.learn(64, agent_callbacks={"agent_0": look})
        return np.stack([parameters(model) for model in team.agents.values()]), seen, team

    first, infos, team = learned(["zero", "null"])
    second, _, _ = learned(["friend", "foe"])
    assert np.array_equal(first, second)
    assert "zero" not in str(infos) and "null" not in str(infos) and "partner" not in str(infos)
    with pytest.raises(AttributeError):
        team.agents["agent_0"].get_env().get_attr("partner")


def test_the_log_has_the_returns_beside_each_partner(tmp_path):
    pool = PartnerPool(ZERO_ONE)
    env = make_team_env(toy(3), n_envs=4)
    team = Team(PPO, "MlpPolicy", env, seed=0, partners={"agent_2": pool}, log_dir=str(tmp_path), **PPO_KWARGS)
    team.learn(4 * 32)
    episodes = list(team.ep_info_buffer)
    with open(tmp_path / "progress.csv") as file:
        row = list(csv.DictReader(file))[-1]
    for name in ZERO_ONE:
        expected = np.mean([episode["r"] for episode in episodes if episode["partner"] == name])
        assert float(row[f"partners/{name}/ep_rew_mean"]) == pytest.approx(expected)
    # Of many partners only those that were met last
    many = pool_of(40)
    many_team = Team(PPO, "MlpPolicy", make_team_env(toy(2), n_envs=50), partners={"agent_1": many}, **PPO_KWARGS).learn(800)
    logged = [key for key in many_team.logger.name_to_value if key.startswith("partners/")]
    assert len({episode["partner"] for episode in many_team.ep_info_buffer}) > 20 and logged == []
    recorded: dict[str, float] = {}
    many_team.logger.dump = lambda step=0: recorded.update(many_team.logger.name_to_value)
    many_team.dump_logs()
    assert sum(key.startswith("partners/") for key in recorded) == 20


def test_names_may_be_as_long_as_paths(capsys):
    names = [f"/{'folder/' * 20}seed_{seed}/ppo/{'environment' * 3}_1/team.zip" for seed in (10, 11)]
    pool = PartnerPool(dict(zip(names, (zero, one), strict=True)))
    env = make_team_env(toy(2), n_envs=4)
    Team(PPO, "MlpPolicy", env, seed=0, partners={"agent_1": pool}, verbose=1, **PPO_KWARGS).learn(4 * 32)
    table = capsys.readouterr().out
    assert all(f"{name}/ep_rew_mean" in table for name in names)


def make_resumable(tmp_path, env):
    """Return a team beside a pool of recurrent, sampling, exploring and scripted partners, and another pool by rollouts."""
    recurrent = saved_team(
        tmp_path / "r.zip", RecurrentPPO, "MlpLstmPolicy", policy_kwargs={"lstm_hidden_size": 4}, n_agents=3
    )
    sampling = saved_team(tmp_path / "s.zip", PPO, n_agents=3)
    exploring = {algo.__name__: save_exploring_team(tmp_path / f"{algo.__name__}.zip", algo, 3) for algo in (DQN, IQL)}
    members = {"recurrent": recurrent, "sampling": sampling, "noisy": noisy, **exploring}
    partners = {
        "agent_1": PartnerPool(members, redraw_every=2),
        "agent_2": PartnerPool(members, 1, "rollouts", per_copy=False, seed=3),
    }
    return PartnersVecEnv(env, partners)


class SaveAt(Record):
    """Callback that saves the team exactly where a rollout begins."""

    def __init__(self, at):
        super().__init__(keep=("infos",))
        self.at, self.saved = at, b""

    def _on_rollout_start(self):
        if self.model.num_timesteps == self.at:
            buffer = io.BytesIO()
            self.model.save(buffer, exact=True)  # type: ignore[call-arg]
            self.saved = buffer.getvalue()


def test_a_training_goes_on_exactly(tmp_path):
    def new_env(seed):
        return make_resumable(tmp_path, make_team_env(toy(3), n_envs=2, seed=seed))

    saving = SaveAt(80)
    team = Team(PPO, "MlpPolicy", new_env(0), seed=0, **PPO_KWARGS).learn(240, callback=saving)
    assert len({info["partner"] for kept in saving.kept for info in kept["infos"]}) > 4
    (tmp_path / "exact.zip").write_bytes(saving.saved)
    again = SaveAt(-1)
    resumed = Team.load(tmp_path / "exact.zip", env=new_env(99), exact=True, device="cpu")
    resumed.learn(160, callback=again, reset_num_timesteps=False)
    assert np.array_equal(parameters(resumed.agents["agent_0"]), parameters(team.agents["agent_0"]))
    names, expected = ([[info["partner"] for info in kept["infos"]] for kept in each.kept] for each in (again, saving))
    assert names == expected[40:]
    others, expected_others = (
        [info["scripted_actions"].tolist() for kept in each.kept for info in kept["infos"]] for each in (again, saving)
    )
    assert others == expected_others[80:]
    assert list(resumed.ep_info_buffer) != [] and [episode["partner"] for episode in resumed.ep_info_buffer] == [
        episode["partner"] for episode in team.ep_info_buffer
    ]
    # Beside others it cannot go on exactly
    other = Team.load(
        tmp_path / "exact.zip",
        env=make_team_env(toy(3), n_envs=2),
        exact=True,
        partners={"agent_1": pool_of(3), "agent_2": zero},
    )
    with pytest.raises(ValueError, match="is of a pool of the members"):
        other.learn(160, reset_num_timesteps=False)


@pytest.mark.parametrize(
    "members, kwargs, error, message",
    [
        ({}, {}, ValueError, "The pool is empty"),
        ([zero], {}, TypeError, "are a dict {name: partner}, not list"),
        ({"": zero}, {}, ValueError, "has the name ''"),
        (ZERO_ONE, {"redraw_every": 0}, ValueError, "redraw_every=0 must be an integer >= 1"),
        (ZERO_ONE, {"redraw_unit": "steps"}, ValueError, "redraw_unit='steps' is not one of 'rollouts', 'episodes'"),
        (ZERO_ONE, {"per_copy": False}, ValueError, "needs per_copy=True"),
        (ZERO_ONE, {"seed": -1}, ValueError, "seed=-1 must be an integer >= 0"),
        (ZERO_ONE, {"held_out": ["two"]}, ValueError, r"\['two'\] are held out but not in the pool, which has"),
        (ZERO_ONE, {"held_out": ["zero", "one"]}, ValueError, "All members of the pool are held out"),
        (ZERO_ONE, {"weights": [1]}, ValueError, "has 2 members, .* but 1 weights"),
        (ZERO_ONE, {"weights": [1, -1]}, ValueError, "-1 is no weight"),
        (ZERO_ONE, {"weights": [0, 0]}, ValueError, "not held out have the weight 0"),
        (ZERO_ONE, {"weights": [1, 0], "held_out": "one"}, ValueError, "held out have the weight 0"),
        (ZERO_ONE, {"weights": "ab"}, TypeError, "a list of one number for each member"),
        (ZERO_ONE, {"held_out": 3}, TypeError, "held_out of a pool is a list of names of members, not 3"),
    ],
)
def test_wrong_pools(members, kwargs, error, message):
    with pytest.raises(error, match=message):
        PartnerPool(members, **kwargs)


@pytest.mark.parametrize("held_out", [(), "three"])
def test_every_member_is_checked_before_anything_starts(held_out):
    with pytest.raises(TypeError, match="The partner 'agent_1' is 3"):
        partnered({"agent_1": PartnerPool({"zero": zero, "three": 3}, held_out=held_out)})
