"""Check by random play whether an environment keeps the contract of a team, and report each fault with what to change."""

import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from functools import partial
from io import StringIO
from typing import Any

import cloudpickle
import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from sb3_belief.common.plain_data import NotPlainError
from sb3_belief.envs.adapters.pettingzoo import in_model_form
from sb3_belief.envs.random_play import PlayRecord, RandomPlayer, play_randomly
from sb3_belief.envs.registry import spec
from sb3_belief.envs.suites import load_attribute
from sb3_belief.vec_env.copy_state import CopyState
from sb3_belief.vec_env.observation_forms import ObservationForms
from sb3_belief.vec_env.own_state import own_state, state_row
from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member
from sb3_belief.vec_env.user_env import UserEnv, check_interface
from sb3_belief.vec_env.validation import check_spaces

# Named, not imported, as the registry names environments: a team is built on what stands here
_TRIAL = "sb3_belief.team.trial:try_to_learn"
# Steps of PettingZoo's own test
_PETTINGZOO_STEPS = 50
_STATE_STEPS = 50


@dataclass(frozen=True)
class Finding:
    """
    One line of a :class:`Report`.

    :param topic: The part of the contract that was checked
    :param verdict: ``"ok"``, ``"note"`` (allowed, but worth knowing) or ``"FAIL"``
    :param text: What was observed and, for a failure, what to change
    """

    topic: str
    verdict: str
    text: str

    def __str__(self) -> str:
        return f"{self.verdict:4s}  {self.topic}: {self.text}"


@dataclass
class Report:
    """
    The findings about one environment.

    :param findings: Findings in the order in which they were made
    """

    findings: list[Finding] = field(default_factory=list)

    @property
    def failures(self) -> list[Finding]:
        """The findings that require a change of the environment."""
        return [finding for finding in self.findings if finding.verdict == "FAIL"]

    def add(self, topic: str, verdict: str, text: str) -> None:
        """
        Append a finding.

        :param topic: See :class:`Finding`
        :param verdict: See :class:`Finding`
        :param text: See :class:`Finding`
        """
        self.findings.append(Finding(topic, verdict, text))

    def __str__(self) -> str:
        failures = len(self.failures)
        return "\n".join(map(str, self.findings)) + f"\n{failures or 'No'} failure{'' if failures == 1 else 's'}."


def check_team_env(
    env: str | Callable[..., ParallelEnv], env_kwargs: Mapping[str, Any] | None = None, n_steps: int = 500, seed: int = 0
) -> Report:
    """
    Check an environment: by PettingZoo's own test, by playing it with random actions that its masks allow, and by a small team
    that learns in it for a moment.

    Random play covers what a team needs: spaces, names of agents, seeding, masks, visibility, ``active``, ``life_end``, ends
    of episodes, infos, saving and restoring the state, and pickling. Where all is well, a team of ``BeliefPPO`` plays and
    learns, so that an environment without failures is one in which a team can be trained. What PettingZoo's test says are
    notes, since a team asks for less in some respects.

    :param env: An id, or a callable that returns a PettingZoo ``ParallelEnv``, as ``make_team_env`` takes them
    :param env_kwargs: Keyword arguments of the environment
    :param n_steps: Number of steps to play, at least 2
    :param seed: Seed of the environment's first reset
    :return: The findings. ``print(report)`` shows them
    :raises ValueError: For an unknown id or too few steps
    :raises ModuleNotFoundError: If the package of an id is not installed
    """
    if n_steps < 2:
        raise ValueError(f"n_steps={n_steps} must be at least 2.")
    kwargs = dict(env_kwargs or {})
    make = spec(env).maker(**kwargs) if isinstance(env, str) else partial(env, **kwargs)
    report = Report()
    first = _make_env(make, report)
    if first is None:
        return report
    try:
        # An environment with faulty spaces cannot be played, so the report ends there
        if _report_spaces(first, report):
            # Played as a team plays it
            played, make_played = in_model_form(first), partial(_make_played, make)
            record = play_randomly(played, n_steps, seed)
            for topic, text in record.faults.items():
                report.add(topic, "FAIL", text)
            _report_like_masks(first, record, report)
            _report_pettingzoo(make, bool(record.masked), report)
            # With the fault "play" the environment could not be stepped, so there is nothing to compare or describe
            if "play" not in record.faults:
                _report_seeding(make_played, played, record, seed, report)
                _report_play(record, report)
                _report_state(played, seed, report)
                _report_global_state(played, seed, report)
            _report_pickling(make, report)
            _report_trial(make, n_steps, seed, report)
    finally:
        first.close()
    return report


def _make_played(make: Callable[[], Any]) -> ParallelEnv:
    return in_model_form(UserEnv(make()))


def _make_env(make: Callable[[], Any], report: Report) -> UserEnv | None:
    try:
        env = make()
    except Exception as error:
        report.add("making", "FAIL", f"it raises {_describe_error(error)}. Change: the callable must return an environment.")
        return None
    if isinstance(env, AECEnv):
        change = "wrap it: sb3_belief.envs.to_parallel(env)"
        report.add("making", "FAIL", f"it is an AEC environment, in which agents act in turn. Change: {change}.")
        return None
    try:
        check_interface(env)
    except TypeError:
        change = "return an object of a subclass of pettingzoo.ParallelEnv"
        report.add("making", "FAIL", f"it returns a {type(env).__name__}. Change: {change}.")
    else:
        # Copies that are one and the same object would step each other
        other = make()
        if other is not env:
            return _known_env(env, report)
        report.add("making", "FAIL", "it returns the same environment each time. Change: make a new one at each call.")
    return None


def _known_env(env: Any, report: Report) -> UserEnv | None:
    """Return the environment with names and spaces as a team knows them, if they can be known."""
    try:
        user_env = UserEnv(env)
        spaces_of = ObservationForms(user_env).spaces, user_env.action_spaces
        check_spaces(user_env.possible_agents, *spaces_of, ScriptedOthers(env).action_spaces)
    except Exception as error:
        change = "define possible_agents, observation_space(agent) and action_space(agent) before the first reset"
        report.add("spaces", "FAIL", f"{_describe_error(error)}. Change: {change}, with spaces that a team supports.")
        return None
    return user_env


def _report_spaces(env: UserEnv, report: Report) -> bool:
    agents, observation_spaces, action_spaces = env.possible_agents, env.observation_spaces, env.action_spaces
    again = UserEnv(env.env)
    for agent in agents:
        given = again.observation_spaces.get(agent), again.action_spaces.get(agent)
        if given != (observation_spaces[agent], action_spaces[agent]):
            change = "make them once and return the same objects"
            report.add("spaces", "FAIL", f"those of {agent!r} differ from call to call. Change: {change}.")
            return False
    kinds = {(str(observation_spaces[agent]), str(action_spaces[agent])) for agent in agents}
    report.add("spaces", "ok", f"{len(agents)} agents, {len(kinds)} kind{'s' if len(kinds) > 1 else ''} of spaces")
    return True


def _report_seeding(make: Callable[[], Any], env: UserEnv, record: PlayRecord, seed: int, report: Report) -> None:
    n_steps = min(sum(entry[0] != "reset" for entry in record.trace), 60)
    try:
        # The same environment reveals what an episode leaves behind, a new one what depends on the process or the instance
        again = play_randomly(env, n_steps, seed).trace
        other = UserEnv(make())
        fresh = play_randomly(other, n_steps, seed).trace
        different = play_randomly(other, n_steps, seed + 1).trace
        other.close()
    except Exception as error:
        change = "reset() must start a new episode at any time"
        report.add("seeding", "FAIL", f"a further episode raises {_describe_error(error)}. Change: {change}.")
        return
    change = "reset(seed=s) must seed every generator and clear everything that an episode has left behind"
    for trace, what in ((again, "when the same environment is reset with it again"), (fresh, "in a new environment")):
        # The traces may differ in length: the first one is the whole play, the others are cut after n_steps
        step = next((t for t, (a, b) in enumerate(zip(record.trace, trace, strict=False)) if a != b), None)
        if step is not None:
            when = f"from step {step} on" if step else "from the reset on"
            text = f"the same seed and actions give something else {when}, {what}"
            report.add("seeding", "FAIL", f"{text}. Change: {change}.")
            return
    same = " (another seed gives the same too: nothing is random)" if different == fresh else ""
    report.add("seeding", "note" if same else "ok", f"the same seed and actions give the same {n_steps} steps{same}")


def _report_play(record: PlayRecord, report: Report) -> None:
    """Describe what was observed of each part of the contract that has no fault."""
    faults = record.faults
    if "names" not in faults:
        report.add("names", "ok", "agents keep theirs")
    if "observations" not in faults:
        report.add("observations", "ok", "all in their spaces")
    if "rewards" not in faults:
        report.add("rewards", "ok", f"from {min(record.rewards):.3g} to {max(record.rewards):.3g}")
    if "masks" not in faults:
        report.add("masks", "ok", record.mask_summary())
    if "visibility" not in faults:
        report.add("visibility", *record.visibility_summary())
    if "flags" not in faults:
        life_ends = f"life_end {record.life_ends} times within an episode"
        report.add("flags", "ok", f"inactive in {record.n_inactive} of {record.n_actions} actions, {life_ends}")
    if "infos" not in faults:
        report.add("infos", "ok", f"keys outside this contract: {', '.join(sorted(record.other_keys)) or 'none'}")
    if "ends" not in faults:
        report.add("ends", *record.ends_summary())
        report.add("success", *record.success_summary())


def _report_like_masks(env: UserEnv, record: PlayRecord, report: Report) -> None:
    """Note what may be meant as a mask and is an input like others."""
    for agent, names in ObservationForms(env).like_masks.items():
        if names and agent not in record.masked:
            change = "if it is one, call it 'action_mask' in a Dict, or give it as infos[agent]['action_mask']"
            text = f"{names[0]!r} of the observation of {agent!r} looks like a mask of its actions, and is an ordinary input"
            report.add("masks", "note", f"{text}; {change}")
            return


def _report_state(env: UserEnv, seed: int, report: Report) -> None:
    get_state, set_state = optional_member(env, "get_state"), optional_member(env, "set_state")
    if get_state is None or set_state is None:
        env.reset(seed=seed)
        try:
            CopyState(env.env).get()
            how = "its attributes are saved in their place, and a run is resumed exactly"
        except NotPlainError as error:
            how = f"a run begins new episodes at each checkpoint, since {error}"
        report.add("state", "note", f"no get_state() and set_state(): {how}")
        return
    change = "get_state() must return all that decides the following steps, as copies; set_state() must restore it"
    player = RandomPlayer(env, seed=0)
    try:
        player.reset(seed)
        player.step()
        if not env.agents:
            player.reset(None)
        masks, rng_state = player.masks, player.rng.bit_generator.state
        # The state goes through pickle, as it does when a run is saved and loaded
        state = cloudpickle.loads(cloudpickle.dumps(get_state()))
        first = _continue_play(player)
        set_state(state)
        # The player's own state is restored too, so that it chooses the same actions again
        player.masks, player.rng.bit_generator.state = masks, rng_state
        second = _continue_play(player)
    except Exception as error:
        report.add("state", "FAIL", f"raises {_describe_error(error)}. Change: {change}.")
        return
    if first != second:
        report.add("state", "FAIL", f"after set_state() the same actions give something else. Change: {change}.")
    else:
        report.add("state", "ok", "set_state() restores the environment to where get_state() was called")


def _report_global_state(env: UserEnv, seed: int, report: Report) -> None:
    """Check what joint learners are given as the state."""
    state = own_state(env)
    if state is None:
        widths = [spaces.flatdim(env.observation_space(agent)) for agent in env.possible_agents]
        text = f"no state(): joint learners are given all observations, {sum(widths)} numbers"
        report.add("global state", "note", text)
        return
    player, rows = RandomPlayer(env, seed=0), []
    try:
        player.reset(seed)
        for t in range(_STATE_STEPS):
            rows.append(state_row(state(), f"after step {t}"))
            player.step()
            if not env.agents:
                # The last state of an episode counts as well: where a limit cut it off, what follows is valued by it
                rows.append(state_row(state(), f"after step {t + 1}"))
                player.reset(None)
        player.reset(seed)
        again = state_row(state(), "at reset")
    except Exception as error:
        change = "state() must return an array of finite numbers at any time after reset()"
        report.add("global state", "FAIL", f"{_describe_error(error)}. Change: {change}.")
        return
    if len({len(row) for row in rows}) > 1:
        widths = sorted({len(row) for row in rows})
        report.add("global state", "FAIL", f"it has {widths} entries at different steps. Change: give it one shape.")
    elif not np.array_equal(again, rows[0]):
        report.add("global state", "FAIL", "it differs after two resets with one seed. Change: seed all that it shows.")
    else:
        report.add("global state", "ok", f"state() gives {len(again)} numbers, for joint learners alone")


def _continue_play(player: RandomPlayer) -> list[tuple]:
    start = len(player.record.trace)
    for _ in range(5):
        if not player.env.agents or not player.step():
            break
    return player.record.trace[start:]


def _report_pickling(make: Callable[[], Any], report: Report) -> None:
    try:
        UserEnv(cloudpickle.loads(cloudpickle.dumps(make))()).close()
    except Exception as error:
        change = "keep open files, locks and environments out of the callable and its arguments"
        text = f"the callable cannot be sent to a worker process: {_describe_error(error)}"
        report.add("pickling", "FAIL", f"{text}. Change: {change}.")
    else:
        report.add("pickling", "ok", "worker processes can make it")


def _report_pettingzoo(make: Callable[[], Any], masked: bool, report: Report) -> None:
    """Run PettingZoo's own test in an environment of its own, and report what it says."""
    if masked:
        report.add("pettingzoo", "note", "parallel_api_test() was left out, since it knows no masks in infos")
        return
    # Imported here, since PettingZoo's tests need more than its environments do
    from pettingzoo.test import parallel_api_test

    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught, redirect_stdout(StringIO()):
        warnings.simplefilter("always")
        try:
            parallel_api_test(make(), _PETTINGZOO_STEPS)
        except Exception as error:
            # Many of its assertions have no text
            said.append(f"fails with {_describe_error(error)}")
    said += dict.fromkeys(f"warns: {warning.message}" for warning in caught)
    for text in said:
        report.add("pettingzoo", "note", f"parallel_api_test() {text}")
    if not said:
        report.add("pettingzoo", "ok", "parallel_api_test() passes")


def _report_trial(make: Callable[[], Any], n_steps: int, seed: int, report: Report) -> None:
    if report.failures:
        report.add("training", "note", "not tried before the failures are mended")
        return
    try:
        load_attribute(_TRIAL)(make, n_steps, seed)
    except Exception as error:
        change = "mend what it says; a training would end there"
        report.add("training", "FAIL", f"a small team fails with {_describe_error(error)}. Change: {change}.")
    else:
        report.add("training", "ok", "a small team of BeliefPPO learns")


def _describe_error(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(".")
