"""Teams and checks that the tests of the Gymnasium tuple environments share."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief import BeliefPPO, Team, make_team_env
from sb3_belief.zoo.evaluate import evaluate

SMALL: dict[str, Any] = dict(batch_size=32, n_epochs=1, history_length=32, device="cpu")
POLICY_KWARGS: dict[str, Any] = {"net_arch": [8], "embedding_dim": 8, "latent_dim": 4}


def make_team(make_env: Callable[[], Any], n_steps: int, algorithm: Any = BeliefPPO, **kwargs: Any) -> Any:
    """Return a small team in two copies of the environment."""
    env = make_team_env(make_env, n_envs=2, seed=0)
    return Team(algorithm, "BeliefPolicy", env, seed=0, n_steps=n_steps, policy_kwargs=POLICY_KWARGS, **{**SMALL, **kwargs})


def act(env: Any, *actions: int) -> Any:
    """Step with the agents' actions in their order."""
    return env.step(dict(zip(env.possible_agents, actions, strict=True)))


def check_same_course(env: Any, other: Any, n_steps: int) -> None:
    """
    Check that two environments in the same state give the same steps, beyond the ends of episodes.

    :param env: One environment
    :param other: The other one
    :param n_steps: Number of steps and resets, with random actions
    """
    rng = np.random.default_rng(1)
    n_actions = env.action_space(env.possible_agents[0]).n
    for _ in range(n_steps):
        if not env.agents:
            pair: Any = env.reset(), other.reset()
        else:
            actions = rng.integers(n_actions, size=len(env.possible_agents)).tolist()
            pair = act(env, *actions), act(other, *actions)
            assert pair[0][1:4] == pair[1][1:4] and env.agents == other.agents
        assert all(np.array_equal(pair[0][0][agent], pair[1][0][agent]) for agent in pair[0][0])


def check_images_need_no_display(env: Any) -> None:
    """
    Check that pictures are our own drawings, and change with the game.

    :param env: Made with ``render_mode="rgb_array"``
    """
    pytest.importorskip("pygame")
    env.reset(seed=0)
    env.game.render = None  # the package's own, which opens a window
    pictures = [env.render()]
    for _ in range(5):
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        pictures.append(env.render())
    assert all(picture.dtype == np.uint8 and picture.shape == pictures[0].shape for picture in pictures)
    assert pictures[0].shape[2] == 3 and any((picture != pictures[0]).any() for picture in pictures)


def check_window_is_the_packages_own(env: Any) -> None:
    """
    Check that a window is left to the package.

    :param env: Made with ``render_mode="human"``
    """
    asked = []
    env.game.render = lambda mode="human": asked.append(mode)
    env.reset(seed=0)
    before = len(asked)
    env.render()
    assert asked[before:] == ["human"]


def train_save_load_evaluate(make_env: Callable[[], Any], folder: Any, algorithm: Any = BeliefPPO) -> list:
    """
    Train a team for two short iterations, save it, load it, evaluate it and train it further.

    :param make_env: Makes one environment
    :param folder: Where the team is saved
    :param algorithm: Class of the agents
    :return: Returns of two evaluation episodes
    """
    team = make_team(make_env, 16, algorithm)
    before = {agent: _weights(model) for agent, model in team.agents.items()}
    team.learn(64)
    assert all(not th.equal(before[agent], _weights(model)) for agent, model in team.agents.items())
    assert all(model.logger.name_to_value["belief/first_log_ratio"] < 1e-5 for model in team.agents.values())
    team.save(folder / "team")
    loaded = Team.load(folder / "team.zip", env=make_team_env(make_env, n_envs=2, seed=0))
    assert all(th.equal(_weights(team.agents[agent]), _weights(model)) for agent, model in loaded.agents.items())
    test_env: Any = make_team_env(make_env, n_envs=2, seed=9)
    outcome = evaluate(loaded, test_env, 2)
    loaded.learn(32)
    return list(outcome.returns)


def _weights(model: Any) -> th.Tensor:
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


def check_advantages(
    make_env: Callable[[], Any], terminates: Callable[[np.ndarray], bool], n_steps: int, algorithm: Any = BeliefPPO
) -> list[bool]:
    """
    Compare the advantages in all agents' rollout buffers with those computed here from the environment's own steps.

    :param make_env: Makes one environment
    :param terminates: Tells from an episode's last observation whether the episode terminated, rather than being truncated
    :param n_steps: Length of a rollout, of which there are two
    :param algorithm: Class of the agents
    :return: For each end of an episode within a rollout, whether it was a termination
    """
    team = make_team(make_env, n_steps, algorithm, gamma=0.9, gae_lambda=0.8, n_epochs=1)
    watches = {agent: _Advantages(terminates) for agent in team.agents}
    team.learn(2 * n_steps, agent_callbacks=watches)
    assert all(watch.compared == 2 * n_steps for watch in watches.values())
    return [end for watch in watches.values() for end in watch.ends]


class _Advantages(BaseCallback):
    """Callback that computes one agent's advantages by their definition and compares them with its buffer's."""

    def __init__(self, terminates: Callable[[np.ndarray], bool]):
        super().__init__()
        self.terminates = terminates
        self.steps: list[tuple[Any, ...]] = []
        self.ends: list[bool] = []
        self.compared = 0

    def _on_step(self) -> bool:
        # Copied now, since SB3 adds the bootstrapped values to the rewards in place
        last = [info.get("terminal_observation") for info in self.locals["infos"]]
        self.steps.append((self.locals["rewards"].copy(), self.locals["new_obs"].copy(), last))
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        buffer, gamma, decay = model.rollout_buffer, model.gamma, model.gamma * model.gae_lambda

        def value(observation: np.ndarray) -> float:
            with th.no_grad():
                return float(model.policy.predict_values(th.as_tensor(observation[None])))

        for copy in range(buffer.n_envs):
            errors, ended = [], []
            for t, (rewards, new_obs, last) in enumerate(self.steps):
                if last[copy] is not None:
                    self.ends.append(self.terminates(last[copy]))
                    following = 0.0 if self.ends[-1] else value(last[copy])
                elif t + 1 < len(self.steps):
                    following = buffer.values[t + 1, copy]  # Not value(), since acting has sampled the belief
                else:
                    following = value(new_obs[copy])
                errors.append(rewards[copy] + gamma * following - buffer.values[t, copy])
                ended.append(last[copy] is not None)
            for t in range(len(errors)):
                stop = next((k for k in range(t, len(errors)) if ended[k]), len(errors) - 1)
                expected = sum(decay ** (k - t) * errors[k] for k in range(t, stop + 1))
                np.testing.assert_allclose(buffer.advantages[t, copy], expected, atol=1e-5)
                self.compared += 1
