"""Where a return ends nothing is bootstrapped, where it is cut off the last observation's value is, and a death is neither."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.baselines import AMFPPO, IAC
from sb3_belief.references.adapters import shared_weights, shared_with_state
from sb3_belief.references.mappo import MAPPO
from sb3_belief.references.shared import SharedMAPPO, SharedPPO
from sb3_belief.references.with_state import with_state
from tests.team.helpers import Team, make_team_env
from tests.team.toy_envs import ScriptedEnv

GAMMA = 0.9
AGENTS = ["stays", "dies", "cut", "last"]
#: At which steps, from 1, of which agents a return is cut off by a limit. That of "stays" ended at 3, that of "dies" at 5
CUTS = {("stays", 8), ("cut", 6), ("last", 8)}
IN_PLAY = {"stays": {1, 2, 3, 6, 7, 8}, "dies": {1, 2, 3, 4, 5}, "cut": {1, 2, 3, 4, 5, 6}, "last": set(range(1, 9))}


class Lasts(BaseCallback):
    """Keeps the last observations of returns that are cut off, by step and row."""

    def __init__(self) -> None:
        super().__init__()
        self.found: dict[tuple[int, int], Any] = {}

    def _on_step(self) -> bool:
        for row, info in enumerate(self.locals["infos"]):
            if info.get("TimeLimit.truncated"):
                self.found[self.n_calls, row] = info["terminal_observation"]
        return True


@pytest.mark.parametrize(
    "algorithm, adapter",
    [(IAC, None), (AMFPPO, None), (SharedPPO, shared_weights), (MAPPO, with_state), (SharedMAPPO, shared_with_state)],
)
def test_only_the_right_returns_are_bootstrapped(algorithm, adapter):
    env = make_team_env(ScriptedEnv, n_envs=1, seed=0)
    policy = "MultiInputPolicy" if issubclass(algorithm, MAPPO) else "MlpPolicy"
    kwargs: dict[str, Any] = {} if algorithm is IAC else {"batch_size": 8, "n_epochs": 1}
    team = Team(
        algorithm,
        policy,
        env if adapter is None else adapter(env),
        seed=0,
        n_steps=8,
        gamma=GAMMA,
        learning_rate=0.0,
        device="cpu",
        **kwargs,
    )
    callbacks = {agent: Lasts() for agent in team.agents}
    team.learn(8, agent_callbacks=callbacks)
    for agent, model in team.agents.items():
        names = AGENTS if agent == "team" else [agent]
        buffer, lasts = model.rollout_buffer, callbacks[agent].found
        assert {(names[row], step) for step, row in lasts} == {cut for cut in CUTS if cut[0] in names}
        active = buffer.active.reshape(len(names), 8)
        for row, name in enumerate(names):
            earned = 1 + 10 * AGENTS.index(name) + np.arange(1, 9) / 100
            added = buffer.rewards[:, row] - earned
            for step in range(1, 9):
                expected = 0.0
                if (name, step) in CUTS:
                    last = lasts[step, row]
                    with th.no_grad():
                        expected = GAMMA * float(model.policy.predict_values(model.policy.obs_to_tensor(last)[0]))
                    assert expected != 0.0
                assert added[step - 1] == pytest.approx(expected, abs=1e-4), (name, step)
            assert set(np.flatnonzero(active[row]) + 1) == IN_PLAY[name]
