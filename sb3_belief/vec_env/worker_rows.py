"""
A joint step of one copy as one row of bytes.

The results of a step have the same shapes and types at every step. A worker therefore packs them into one row of a structured
array, and the main process reads the rows of all copies as a single array. Pickling a step's dictionaries, arrays and records
one by one and stacking them again took most of the time that workers cost.
"""

import pickle
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_belief.common.action_masks import mask_width
from sb3_belief.vec_env.events import StepRecord
from sb3_belief.vec_env.observation_forms import parts_of

# Fields of a row that become entries of infos; read_rows() relies on agent_rewards being the first
_INFO_FIELDS = ("agent_rewards", "visible", "active", "life_end", "truncated")


def row_type(
    observation_spaces: dict[str, spaces.Space],
    action_spaces: dict[str, spaces.Space],
    scripted_action_spaces: dict[str, spaces.Space],
) -> np.dtype:
    """
    Return the structured type of a row, which holds a joint step of one copy.

    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    :param scripted_action_spaces: Action space of each scripted other
    :return: The type; in ``observations``, the field of an agent has its number as its name, and so have the fields of the
        entries of a dict within it
    """
    n = len(observation_spaces)
    observations = [(str(i), *_field(space)) for i, space in enumerate(observation_spaces.values())]
    return np.dtype(
        [
            ("observations", observations),
            ("reward", np.float32),
            ("done", bool),
            ("agent_rewards", np.float32, (n,)),
            ("visible", bool, (n, n - 1 + len(scripted_action_spaces))),
            *((name, bool, (n,)) for name in ("active", "life_end", "truncated")),
            ("scripted_actions", np.float32, (sum(map(spaces.flatdim, scripted_action_spaces.values())),)),
            ("has_masks", bool),
            ("action_masks", bool, (sum(map(mask_width, action_spaces.values())),)),
        ]
    )


def _field(space: spaces.Space) -> tuple[Any, ...]:
    """Return type and, except for a dict, shape of the field of an agent's observations."""
    if isinstance(space, spaces.Dict):
        return ([(str(j), *_field(part)) for j, part in enumerate(space.spaces.values())],)
    return space.dtype, space.shape or ()


class RowPacker:
    """
    Packs the steps of one copy into rows.

    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    :param scripted_action_spaces: Action space of each scripted other
    """

    def __init__(
        self,
        observation_spaces: dict[str, spaces.Space],
        action_spaces: dict[str, spaces.Space],
        scripted_action_spaces: dict[str, spaces.Space],
    ):
        dtype = row_type(observation_spaces, action_spaces, scripted_action_spaces)
        self._row = np.zeros((), dtype=dtype)
        #: Number of bytes of a row
        self.size = dtype.itemsize
        # Views of the row, made once: each step writes into them
        self._observations: list[tuple[str, str | None, np.ndarray]] = []
        for i, (agent, space) in enumerate(observation_spaces.items()):
            field = self._row["observations"][str(i)]
            for j, key in enumerate(parts_of(space)):
                self._observations.append((agent, key, field if key is None else field[str(j)]))
        self._fields = {name: self._row[name] for name in dtype.names or ()}

    def pack(
        self,
        obs: dict[str, Any],
        reward: float,
        done: bool,
        record: StepRecord,
        masks: np.ndarray | None,
        others: dict[str, Any],
    ) -> bytes:
        """
        Pack what ``step_and_reset`` returned.

        :param obs: Observations by agent
        :param reward: Team reward
        :param done: Whether an episode has ended
        :param record: The ``StepRecord``
        :param masks: Masks for the next actions
        :param others: What else the infos hold
        :return: The row, followed by a pickle of ``others``, if there are any
        """
        fields = self._fields
        for agent, key, field in self._observations:
            field[...] = obs[agent] if key is None else obs[agent][key]
        fields["reward"][...], fields["done"][...] = reward, done
        fields["agent_rewards"][...], fields["visible"][...] = record.agent_rewards, record.visible
        fields["active"][...], fields["life_end"][...], fields["truncated"][...] = record.flags
        if record.scripted_actions is not None:
            fields["scripted_actions"][...] = record.scripted_actions
        fields["has_masks"][...] = masks is not None
        if masks is not None:
            fields["action_masks"][...] = masks
        return self._row.tobytes() + pickle.dumps(others) if others else self._row.tobytes()


class RowReader:
    """
    Reads the rows of all copies.

    :param observation_spaces: Observation space of each agent
    :param action_spaces: Action space of each agent
    :param scripted_action_spaces: Action space of each scripted other
    """

    def __init__(
        self,
        observation_spaces: dict[str, spaces.Space],
        action_spaces: dict[str, spaces.Space],
        scripted_action_spaces: dict[str, spaces.Space],
    ):
        self._observation_spaces = observation_spaces
        self._row_type = row_type(observation_spaces, action_spaces, scripted_action_spaces)
        self._info_names = _INFO_FIELDS + ("scripted_actions",) * bool(scripted_action_spaces)
        #: Number of bytes of a row
        self.size = self._row_type.itemsize
        #: What the last rows held besides: the agents' own rewards, float32 ``[num_envs, n]``, and the masks of all agents
        #: side by side, bool ``[num_envs, sum of their widths]``; None without masks
        self.agent_rewards: np.ndarray = np.zeros(0, dtype=np.float32)
        self.action_masks: np.ndarray | None = None

    def read(self, messages: Sequence[bytes]) -> VecEnvStepReturn:
        """
        Read a joint step of all copies.

        :param messages: For each copy, what ``RowPacker.pack`` returned
        :return: Observations ``[num_envs, ...]`` by agent, rewards float32 ``[num_envs]``, dones bool ``[num_envs]`` and infos
            as those of a ``TeamVecEnv``
        """
        size = self.size
        rows = np.frombuffer(b"".join([message[:size] for message in messages]), dtype=self._row_type)
        # Copies, since rows are read-only, and whoever kept a view of one field would keep the whole array alive
        observations: Any = {
            agent: _unpacked(rows["observations"][str(i)], space)
            for i, (agent, space) in enumerate(self._observation_spaces.items())
        }
        columns = [rows[name].copy() for name in self._info_names]
        self.agent_rewards = columns[0]
        infos = [dict(zip(self._info_names, entries, strict=True)) for entries in zip(*columns, strict=True)]
        # A worker appends a pickle to its row where the infos hold more, as they do at the end of an episode
        for info, message in zip(infos, messages, strict=True):
            if len(message) > size:
                info.update(pickle.loads(message[size:]))
        self.action_masks = rows["action_masks"].copy() if rows["has_masks"][0] else None
        return observations, rows["reward"].copy(), rows["done"].copy(), infos


def _unpacked(field: np.ndarray, space: spaces.Space) -> Any:
    """Copy an agent's observations out of the rows of all copies."""
    if isinstance(space, spaces.Dict):
        return {key: field[str(j)].copy() for j, key in enumerate(space.spaces)}
    return field.copy()
