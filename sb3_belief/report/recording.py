"""
Recordings of episodes: what the agents of a team believed, saw and did at each step, and what the environment looked like.

A recorded episode is the very episode that ``evaluate_policy`` plays with the same seed: the actions come from one call of
``Team.predict`` a step, and what is read of the agents besides draws no random number and changes no history.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_belief.belief_ppo.others import OthersPrediction
from sb3_belief.belief_ppo.policies import BeliefPolicyMixin
from sb3_belief.common.action_encoding import action_encoding
from sb3_belief.report.frames import FrameStore, frame_of
from sb3_belief.report.own_policy import OwnChoice, own_choice
from sb3_belief.team import Team, TeamVecEnv
from sb3_belief.vec_env.team_vec_env import JointObs


class AgentMoment(NamedTuple):
    """
    One agent at one step of an episode.

    :param observation: Its observation when it acted, as its model gets it, ``[1, ...]``
    :param features: The same as belief and history hold it, float ``[d_o]``; None without a belief
    :param active: Whether it was in play when it acted
    :param choice: What it would do
    :param reward: Its reward for this step
    :param visible: Whose action of this step it could observe, bool ``[n_others]``
    :param prediction: What it believed that the others do; None if it predicts nothing
    """

    observation: Any
    features: np.ndarray | None
    active: bool
    choice: OwnChoice
    reward: float
    visible: np.ndarray
    prediction: OthersPrediction | None


class Moment(NamedTuple):
    """
    One step of an episode.

    :param frame: Number of the picture of the state in which the agents acted
    :param positions: Where agents and scripted others are in the picture, as fractions of its width and height from the upper
        left corner; empty if the environment does not say
    :param actions: What agents and scripted others did, by name, each flattened: an index for each part of a Discrete or
        MultiDiscrete space, otherwise the numbers
    :param reward: The team's reward
    :param agents: The agents by name
    """

    frame: int
    positions: dict[str, tuple[float, float]]
    actions: dict[str, np.ndarray]
    reward: float
    agents: dict[str, AgentMoment]


class Episode(NamedTuple):
    """
    An episode.

    :param moments: Its steps
    :param team_return: The team's return
    :param success: Whether it succeeded; None if the environment does not say
    :param finished: Whether it was recorded to its end
    """

    moments: list[Moment]
    team_return: float
    success: bool | None
    finished: bool = True


@dataclass(frozen=True)
class Recording:
    """
    Episodes of a team.

    :param team: The team
    :param action_spaces: Action spaces of agents and scripted others, by name in order
    :param action_names: Names of actions where the environment gives them: for each part of an action space, a name for each
        value
    :param frames: The pictures
    :param episodes: The episodes
    :param deterministic: Whether the agents acted greedily
    """

    team: Team
    action_spaces: dict[str, spaces.Space]
    action_names: dict[str, list[list[str]]]
    frames: FrameStore
    episodes: list[Episode]
    deterministic: bool

    def others_of(self, agent: str) -> list[str]:
        """
        Return the names of an agent's others.

        :param agent: Name of the agent
        :return: The other agents in order, then the scripted others
        """
        return [name for name in self.action_spaces if name != agent]


def record_episodes(
    team: Team, env: TeamVecEnv, episodes: int = 1, deterministic: bool = True, most_steps: int = 2000
) -> Recording:
    """
    Play episodes from a reset on, and record them.

    :param team: The team
    :param env: Environment with one copy and the render mode ``"rgb_array"``, seeded by the caller
    :param episodes: Number of episodes
    :param deterministic: Whether the agents act greedily. Otherwise they sample their actions
    :param most_steps: Steps after which the recording ends in any case. The episode under way is then its last one
    :return: The recording
    :raises ValueError: If the environment has several copies
    :raises NoPictureError: If it renders no picture
    """
    if env.num_envs != 1:
        raise ValueError(f"an episode is recorded in one copy of an environment, and this one has {env.num_envs}.")
    acted = env.action_space
    assert isinstance(acted, spaces.Dict)
    action_spaces = {**{agent: acted[agent] for agent in env.possible_agents}, **env.scripted_action_spaces}
    recorded: list[Episode] = []
    recording = Recording(team, action_spaces, _action_names(env, action_spaces), FrameStore(), recorded, deterministic)
    tells_positions = env.has_attr("picture_positions")
    state: dict[str, Any] | None = None
    obs, episode_start = env.reset(), np.ones(1, dtype=bool)
    moments: list[Moment] = []
    while len(recorded) < episodes:
        frame = recording.frames.add(frame_of(env))
        positions = env.env_method("picture_positions")[0] if tells_positions else {}
        masks = env.action_masks()
        before = {
            agent: _before_acting(team, agent, obs[agent], masks, (state or {}).get(agent), _starts(obs, agent, episode_start))
            for agent in env.possible_agents
        }
        actions, state = team.predict(obs, state, episode_start, deterministic, action_masks=masks)
        obs, rewards, dones, infos = env.step(actions)
        episode_start = dones
        info = infos[0]
        moments.append(
            Moment(
                frame,
                {str(name): (float(x), float(y)) for name, (x, y) in positions.items()},
                _flat_actions(actions, info, env),
                float(rewards[0]),
                {
                    agent: before[agent]._replace(
                        active=bool(info["active"][i]),
                        reward=float(info["agent_rewards"][i]),
                        visible=np.array(info["visible"][i], dtype=bool),
                    )
                    for i, agent in enumerate(env.possible_agents)
                },
            )
        )
        cut = sum(len(episode.moments) for episode in recorded) + len(moments) >= most_steps
        if cut and not dones[0]:
            recorded.append(Episode(moments, sum(moment.reward for moment in moments), None, False))
            break
        if dones[0]:
            success = bool(info["is_success"]) if "is_success" in info else None
            recorded.append(Episode(moments, float(info["episode"]["r"]), success))
            moments = []
            if cut:
                break
    return recording


def _starts(obs: Any, agent: str, episode_start: np.ndarray) -> np.ndarray:
    """Return where an agent's recurrent state starts anew: with the team's episode, and where its own return has ended."""
    ends = obs.life_ends(agent) if isinstance(obs, JointObs) else None
    return episode_start if ends is None else episode_start | ends


def _before_acting(
    team: Team,
    agent: str,
    observation: Any,
    masks: Mapping[str, np.ndarray] | None,
    state: tuple[np.ndarray, ...] | None,
    episode_start: np.ndarray,
) -> AgentMoment:
    """Return what is known of an agent before it acts; the rest is filled in after the step."""
    model = team.agents[agent]
    seen = team.observed_by(agent, observation)
    policy: Any = model.policy
    features, prediction = None, None
    if isinstance(policy, BeliefPolicyMixin) and policy.has_belief:
        features = policy.flat_observations(policy.obs_to_tensor(seen)[0]).cpu().numpy()[0]
        if policy.options.variant is not None and policy.options.variant.predicts:
            batch = policy.predict_others(seen)
            expected = {name: rows[0] for name, rows in batch.actions.items()}
            prediction = OthersPrediction(expected, *(array[0] for array in batch[1:]))
    choice = own_choice(model, seen, None if masks is None else masks.get(agent), state, episode_start)
    return AgentMoment(seen, features, True, choice, 0.0, np.zeros(0, dtype=bool), prediction)


def _flat_actions(actions: Mapping[str, np.ndarray], info: Mapping[str, Any], env: TeamVecEnv) -> dict[str, np.ndarray]:
    flat = {agent: np.asarray(actions[agent])[0].reshape(-1) for agent in env.possible_agents}
    start = 0
    for name, space in env.scripted_action_spaces.items():
        encoding = action_encoding(name, space)
        row = np.asarray(info["scripted_actions"])[start : start + encoding.width]
        start += encoding.width
        flat[name] = decoded_action(row, encoding.kind, encoding.widths)
    return flat


def decoded_action(row: np.ndarray, kind: str, widths: Sequence[int]) -> np.ndarray:
    """
    Return the action that a part of a vector of the others' actions encodes.

    :param row: Columns of one of the others, ``[width]``
    :param kind: As of ``ActionEncoding``
    :param widths: As of ``ActionEncoding``
    :return: An index for each one-hot vector, otherwise the numbers
    """
    if kind != "categorical":
        return row
    return np.array([part.argmax() for part in np.split(row, np.cumsum(widths)[:-1])])


def _action_names(env: TeamVecEnv, action_spaces: Mapping[str, spaces.Space]) -> dict[str, list[list[str]]]:
    """Return the names that the environment's optional ``action_names`` gives, where they fit the spaces."""
    given = env.get_attr("action_names")[0] if env.has_attr("action_names") else {}
    by_name = {str(name): names for name, names in given.items()} if isinstance(given, Mapping) else None
    found = {}
    for name, space in action_spaces.items():
        names = given if by_name is None else by_name.get(name)
        widths = action_encoding(name, space).widths
        if names and isinstance(names[0], str):
            names = [names]
        if names and [len(part) for part in names] == widths:
            found[name] = [[str(word) for word in part] for part in names]
    return found
