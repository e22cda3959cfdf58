"""Small runs of many kinds, and whether two of them are the same to the bit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_belief.team import Team
from tests.zoo.runs import check_same_run, record_of, table


@dataclass(frozen=True)
class Combination:
    """
    A kind of run: ten or so rollouts of small networks, with checkpoints and evaluations between them.

    :param algo: The algorithm
    :param env: The environment
    :param total: Number of joint steps
    :param save_freq: Joint steps between checkpoints
    :param settings: Settings of ``-params``
    :param words: Further words of the command line
    """

    algo: str
    env: str
    total: int
    save_freq: int
    settings: tuple[str, ...]
    words: tuple[str, ...] = ()

    def command(self, folder: Path, seed: int) -> list[str]:
        """Return the words that train it."""
        return [
            *("train", "--algo", self.algo, "--env", self.env, "-f", str(folder), "--seed", str(seed), "-n", str(self.total)),
            *("--save-freq", str(self.save_freq), "--eval-freq", str(2 * self.save_freq + 40), "--eval-episodes", "4"),
            *("--n-eval-envs", "2", "--verbose", "0", *self.words, "-params", *self.settings),
        ]

    @property
    def allowed(self) -> list[str]:
        """The words that a resume needs, since no file says whom the user trusts."""
        given = list(self.words)
        return given[given.index("--allow-package") :][:2] if "--allow-package" in given else []


_PPO = ("n_envs:4", "n_steps:20", "batch_size:40", "n_epochs:2", "policy_kwargs.net_arch:[16,16]")
_BELIEF = (*_PPO, "history_length:40")
_REPLAY = ("n_envs:4", "buffer_size:300", "learning_starts:60", "batch_size:16", "policy_kwargs.net_arch:[16,16]")
EASY, SPREAD, FORAGING = "traffic-junction-easy", "mpe/simple_spread_v3", "lbf/Foraging-2s-5x5-2p-1f-coop-v3"
_SUBPROC, _TWO_JOBS = ("--vec-env", "subproc"), ("--jobs", "2")
_FEW = ("n_envs:2", "n_steps:40", *_BELIEF[2:])
_GAME = ("n_steps:16", "batch_size:32", "n_epochs:2", "policy_kwargs.net_arch:[16]", "history_length:40")

#: BeliefPPO over environments x {dummy, subproc} x jobs {1, 2} x normalize {off, on}: a sample in which each level is met
BELIEF = {
    "junction, dummy, 1 job": Combination("belief_ppo", EASY, 1600, 160, _BELIEF),
    "junction, subproc, 2 jobs, normalize": Combination(
        "belief_ppo", EASY, 1600, 160, (*_FEW, "normalize:true"), (*_SUBPROC, *_TWO_JOBS)
    ),
    "spread, subproc, 1 job, normalize": Combination("belief_ppo", SPREAD, 1600, 80, (*_FEW, "normalize:true"), _SUBPROC),
    "spread, dummy, 2 jobs": Combination("belief_ppo", SPREAD, 1600, 160, _BELIEF, _TWO_JOBS),
    "foraging, dummy, 2 jobs, normalize": Combination(
        "belief_ppo", FORAGING, 2400, 80, (*_BELIEF, "normalize:true"), _TWO_JOBS
    ),
    "convention, subproc, 1 job": Combination("belief_ppo", "convention-swap", 3200, 320, (*_GAME, "n_envs:2"), _SUBPROC),
    "convention, dummy, 1 job, normalize": Combination(
        "belief_ppo", "convention-swap", 5120, 256, (*_GAME, "n_envs:8", "normalize:true")
    ),
}
#: Teams of other algorithms
OTHERS = {
    "dqn": Combination("dqn", EASY, 1200, 120, _REPLAY),
    "sac": Combination("sac", SPREAD, 480, 80, _REPLAY, ("--env-kwargs", "continuous_actions:true")),
    "maskable_ppo": Combination("maskable_ppo", EASY, 2400, 160, _PPO),
    "recurrent_ppo": Combination("recurrent_ppo", SPREAD, 1600, 160, (*_PPO, "policy_kwargs.lstm_hidden_size:16")),
}


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, th.Tensor):
        return isinstance(other, th.Tensor) and th.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return bool(np.array_equal(one, other))


def check_equal_to(run: Path, undisturbed: Path) -> int:
    """
    Check that a run has left what its undisturbed twin has.

    :return: Number of its episodes
    """
    check_same_run(run, undisturbed)
    mine, theirs = (Team.load(folder / "team.zip") for folder in (run, undisturbed))
    assert mine.num_timesteps == theirs.num_timesteps
    for agent, model in theirs.agents.items():
        found, expected = mine.agents[agent].get_parameters(), model.get_parameters()
        assert any("optimizer" in name for name in expected)
        assert _equal(found, expected), f"{agent}: {[key for key in expected if not _equal(found[key], expected[key])]}"
    assert mine._agents.statistics.keys() == theirs._agents.statistics.keys()
    for agent, statistics in theirs._agents.statistics.items():
        for name in ("obs_rms", "ret_rms", "returns"):
            pair = [getattr(each, name, None) for each in (mine._agents.statistics[agent], statistics)]
            assert _equal(*(vars(each) if hasattr(each, "__dict__") else each for each in pair)), (agent, name)
    for name in ("status", "timesteps", "total_timesteps", "start_timesteps", "seed"):
        assert record_of(run)[name] == record_of(undisturbed)[name], name
    # None lost and none doubled, whatever else is equal
    episodes = len(table(run / "monitor.csv", 1))
    assert episodes == len(table(undisturbed / "monitor.csv", 1)) > 0
    assert not list(run.rglob("*.tmp"))
    return episodes
