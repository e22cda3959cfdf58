"""Fixed partners of a learner: models, saved files and functions that choose the actions of an agent in a team."""

import os
import pathlib
import pickle
import warnings
import zipfile
from contextlib import nullcontext
from typing import Any, TypeAlias

import numpy as np
import sb3_contrib
import stable_baselines3
from gymnasium import spaces
from numpy.random import mtrand
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_belief.belief_ppo import BeliefPPO, MaskableBeliefPPO
from sb3_belief.common.rng import RngState, RngSwitch, sampling_from
from sb3_belief.common.safe_files.archive import names_in
from sb3_belief.common.safe_files.models import class_of, plain_objects
from sb3_belief.common.safe_files.trust import PICKLE, UNTRUSTED, Trust
from sb3_belief.team.checkpoint import as_models_see, read_team
from sb3_belief.team.fixed_partners.functions import PartnerFunction
from sb3_belief.team.model_zips import find_algorithm, load_algorithm
from sb3_belief.team.predictor import PolicyState, Predictor

# That a partner was given no statistics, which is not the same as None
_UNKNOWN = object()

# The path of a zip, an SB3 model or another object with its ``predict``, a callable ``obs -> action``, or a
# pair of one of the first two and statistics
PartnerLike: TypeAlias = Any

# An SB3 zip names its policy but not its algorithm. Where several algorithms have the same policies, one of them can load the
# zips of all, since they differ in how they learn and not in how they act (PPO also reads A2C's and TRPO's, TD3 also DDPG's)
_READERS: tuple[type[BaseAlgorithm], ...] = (
    BeliefPPO,
    MaskableBeliefPPO,
    stable_baselines3.PPO,
    stable_baselines3.SAC,
    stable_baselines3.TD3,
    stable_baselines3.DQN,
    sb3_contrib.MaskablePPO,
    sb3_contrib.RecurrentPPO,
    sb3_contrib.QRDQN,
    sb3_contrib.TQC,
    sb3_contrib.CrossQ,
)


class CallersRng(RngState):
    """
    The random number generators of the caller, whose state is kept while partners draw from their own.

    It is used in every step, where ``RngSwitch`` would take longer than the rest of the step, and so does only what is needed.
    """

    def suspend(self) -> None:
        """Keep the state of the caller's generators."""
        # Unlike a partner's, the caller's numpy generator may be another object at each step
        self._numpy = mtrand.get_bit_generator()  # type: ignore[assignment]
        super().suspend()


class Partner:
    """
    Partner that acts for one agent, with random number generators and a recurrent state of its own.

    :param name: Name of the agent
    :param given: What chooses the actions, see ``AgentEnv``
    :param observation_space: Observation space of the agent
    :param action_space: Action space of the agent
    :param deterministic: Passed on to ``predict``: whether to take the most likely action instead of a sample
    :param seed: Seed of its random numbers; None takes one from the operating system's entropy
    :param trust: Whom the files of partners may name
    :raises TypeError: If ``given`` cannot act
    :raises ValueError: If it has been made for other spaces, or if a zip cannot be read as a model
    """

    def __init__(
        self,
        name: str,
        given: PartnerLike,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        deterministic: bool,
        seed: int | None = None,
        trust: Trust = UNTRUSTED,
    ):
        self.rng = RngState(seed)
        self._name, self.deterministic = name, deterministic
        self._state: PolicyState = None
        self._new = True
        # Nobody else changes a model that was loaded here
        self._owns_model = False
        statistics: VecNormalize | None = None
        own_statistics: Any = _UNKNOWN
        if isinstance(given, tuple) and len(given) == 2:
            given, own_statistics = given
        if isinstance(given, (str, os.PathLike)):
            if own_statistics is _UNKNOWN:
                _warn_of_statistics(name, given)
            # Building a network draws random numbers, which must not come from the learner's generators
            with RngSwitch(self.rng):
                given, statistics = load_model(given, name, trust)
            self._owns_model = True
        elif isinstance(given, BaseAlgorithm):
            statistics = given.get_vec_normalize_env()
        if own_statistics is not _UNKNOWN:
            statistics = _statistics(name, own_statistics, observation_space, trust)
        self._predictor: Predictor | None = None
        if isinstance(given, type) or not (callable(given) or hasattr(given, "predict")):
            raise TypeError(
                f"The partner {name!r} is {given!r}; it must be an SB3 model, the path of the zip of one, an object with SB3's"
                " predict(obs, state, episode_start, deterministic), a callable obs -> action, or a pair of a model or path"
                " and its VecNormalize statistics."
            )
        if hasattr(given, "predict"):
            _check_spaces(name, given, observation_space, action_space)
            self._predictor = Predictor(given, statistics)
        else:
            self._function = PartnerFunction(name, given)

    def act(self, obs: Any, episode_start: bool, mask: np.ndarray | None) -> np.ndarray:
        """
        Choose the agent's action.

        :param obs: Observation of the agent
        :param episode_start: Whether its return ended at the last step
        :param mask: Its possible actions, bool ``[k]``; None if the environment has no masks for it
        :return: The action
        :raises TypeError: If ``predict`` does not return an action and a state
        """
        if self._predictor is None:
            return self._function.one(obs, mask, self.rng.generator())
        start, self._new = np.array([episode_start or self._new]), False
        action, self._state = self._predict(obs, self._state, start, mask)
        return action

    def _predict(
        self, obs: Any, state: PolicyState, starts: np.ndarray, masks: np.ndarray | None
    ) -> tuple[np.ndarray, PolicyState]:
        assert self._predictor is not None
        # DQN and those like it explore by samples of their action space, which has a generator of its own
        space = getattr(self._predictor.model, "action_space", None)
        with sampling_from(space, self.rng.generator()) if isinstance(space, spaces.Space) else nullcontext():
            result = self._predictor.predict(obs, state, starts, self.deterministic, masks)
        if not (isinstance(result, tuple) and len(result) == 2):
            raise TypeError(
                f"predict() of the partner {self._name!r} returned {result!r}; as SB3's it must return (action, state)."
            )
        return np.asarray(result[0]), result[1]

    def reset(self, seed: int | None = None) -> None:
        """
        Reset the recurrent state, and the random numbers if a seed is given.

        :param seed: Seed of its random numbers; None continues with its generators as they are
        """
        self._state, self._new = None, True
        if seed is not None:
            self.rng = RngState(seed)


def load_model(path: str | os.PathLike, agent: str, trust: Trust = UNTRUSTED) -> tuple[BaseAlgorithm, VecNormalize | None]:
    """
    Load the model of a partner.

    :param path: Path of an SB3 zip or of a saved team, with or without ".zip", or ``"team.zip:<agent>"``
    :param agent: Name of the agent whose model is taken from a saved team, unless the path names one
    :param trust: Whom the file may name
    :return: The model, and its normalisation if the team's file has one
    :raises FileNotFoundError: If there is no such file
    :raises ValueError: If it is damaged, lacks the agent, needs trust that it is not given, or holds a model of an algorithm
        that is not known here
    """
    file = os.fspath(path)
    # The name of an agent may contain a colon, too
    head, marker, member = file.partition(".zip:")
    if marker:
        file, agent = f"{head}.zip", member
    if not pathlib.Path(file).exists() and pathlib.Path(f"{file}.zip").exists():
        file = f"{file}.zip"
    if not pathlib.Path(file).is_file():
        raise FileNotFoundError(f"There is no {file!r} to load a partner from.")
    with open(file, "rb") as opened:
        names = names_in(opened, repr(file))
        opened.seek(0)
        content = b"" if "team.json" in names else opened.read()
    if "team.json" in names:
        saved = read_team(file, trust)
        if agent not in saved.models:
            raise ValueError(
                f"{file!r} is a team of {list(saved.models)}, without {agent!r}: name one of them, e.g."
                f" '{file}:{next(iter(saved.models), 'agent')}'."
            )
        return saved.load_model(agent, device="cpu"), saved.statistics.get(agent)
    name = class_of(content, file)
    if name is not None:
        return load_algorithm(find_algorithm(name, file, trust), content, file, trust, None, device="cpu"), None
    # Raises an error that says what it would mean to trust the file
    plain_objects(content, file, trust, {})
    data, _, _ = load_from_zip_file(file, device="cpu")
    policy_class = (data or {}).get("policy_class")
    for base in getattr(policy_class, "__mro__", ()):
        for reader in _READERS:
            if base in reader.policy_aliases.values():
                return load_algorithm(reader, content, file, trust, None, device="cpu"), None
    known = ", ".join(reader.__name__ for reader in _READERS)
    raise ValueError(
        f"{file!r} holds a model with the policy {policy_class}, from which its algorithm cannot be told: pass the model"
        f" itself, loaded with its own class, instead of its path. Paths are for {known} and what shares their policies."
    )


def _warn_of_statistics(name: str, path: str | os.PathLike) -> None:
    """Warn if statistics of a ``VecNormalize`` lie beside a model's zip, which does not say that it needs them."""
    file = pathlib.Path(path)
    found = sorted(str(beside) for beside in file.parent.glob("*vecnormalize*.pkl"))
    if found and file.parent.is_dir() and not _is_team(file):
        warnings.warn(
            f"The partner {name!r}, {os.fspath(path)!r}, acts on observations as they are, but beside it there is {found}. If"
            f" it has learned in VecNormalize, give it as the pair ({os.fspath(path)!r}, {found[0]!r}); if not, as"
            f" ({os.fspath(path)!r}, None)."
        )


def _is_team(file: pathlib.Path) -> bool:
    path = file if file.exists() else file.with_name(f"{file.name}.zip")
    return not zipfile.is_zipfile(path) or "team.json" in zipfile.ZipFile(path).namelist()


def _statistics(name: str, given: Any, observation_space: spaces.Space, trust: Trust) -> VecNormalize | None:
    """Return the statistics that a partner is given explicitly: those of a file, a ``VecNormalize``, or None for none."""
    statistics = given
    if isinstance(given, (str, os.PathLike)):
        with open(given, "rb") as file:
            if not trust.trust_pickle:
                raise ValueError(
                    f"The statistics of the partner {name!r}, {os.fspath(given)!r}, have to be unpickled, and {PICKLE}. If you"
                    " trust that person: trust_pickle=True, or load them yourself by VecNormalize.load()."
                )
            try:
                statistics = pickle.load(file)
            except (pickle.UnpicklingError, EOFError):
                pass
    if statistics is not None and not isinstance(statistics, VecNormalize):
        raise TypeError(
            f"The statistics of the partner {name!r} must be a VecNormalize, the path of a file that VecNormalize.save() has"
            f" written, or None, got {given!r}."
        )
    if statistics is not None and statistics.observation_space.shape != observation_space.shape:
        raise ValueError(
            f"The statistics of the partner {name!r} are of the observation space {statistics.observation_space}, but"
            f" {name!r} has {observation_space} in this environment."
        )
    return statistics


def _check_spaces(name: str, model: Any, observation_space: spaces.Space, action_space: spaces.Space) -> None:
    for kind, wanted in (("observation", observation_space), ("action", action_space)):
        found = getattr(model, f"{kind}_space", wanted)
        if kind == "observation":
            # An agent whose critic saw more in training acts on its own part
            found = getattr(getattr(model, "policy", None), "own_space", found)
        if found not in (wanted, as_models_see(wanted)):
            raise ValueError(
                f"The partner {name!r} has been made for the {kind} space {found}, but {name!r} has {wanted} in this"
                " environment."
            )
