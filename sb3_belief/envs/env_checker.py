"""Does an environment keep the contract of a team? Found by playing it, and every fault said with what to change."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cloudpickle
from pettingzoo import AECEnv, ParallelEnv

from sb3_belief.envs.random_play import PlayRecord, RandomPlayer, play_randomly
from sb3_belief.envs.registry import spec
from sb3_belief.vec_env.scripted_others import ScriptedOthers, optional_member
from sb3_belief.vec_env.team_vec_env import check_spaces


@dataclass(frozen=True)
class Finding:
    """
    :param topic: what was looked at
    :param verdict: ``"ok"``, ``"note"`` (allowed, but worth to know) or ``"FAIL"``
    :param text: what was found; for a failure also what to change
    """

    topic: str
    verdict: str
    text: str

    def __str__(self) -> str:
        return f"{self.verdict:4s}  {self.topic}: {self.text}"


@dataclass
class Report:
    """
    :param findings: in the order in which they were made
    """

    findings: list[Finding] = field(default_factory=list)

    @property
    def failures(self) -> list[Finding]:
        """
        :return: what has to be changed
        """
        return [finding for finding in self.findings if finding.verdict == "FAIL"]

    def add(self, topic: str, verdict: str, text: str) -> None:
        """
        :param topic: see :class:`Finding`
        :param verdict: see :class:`Finding`
        :param text: see :class:`Finding`
        """
        self.findings.append(Finding(topic, verdict, text))

    def __str__(self) -> str:
        failures = len(self.failures)
        return "\n".join(map(str, self.findings)) + f"\n{failures or 'No'} failure{'' if failures == 1 else 's'}."


def check_team_env(
    env: str | Callable[..., ParallelEnv], env_kwargs: Mapping[str, Any] | None = None, n_steps: int = 500, seed: int = 0
) -> Report:
    """
    Play an environment with random actions, those that its masks allow, and check what a team needs of it: spaces, names,
    seeding, masks, visibility, ``active``, ``life_end``, ends of episodes, infos, pickling.

    :param env: what ``make_team_env`` takes: an id, or a callable that returns a PettingZoo ``ParallelEnv``
    :param env_kwargs: keyword arguments of the environment
    :param n_steps: how long to play, at least 2 steps
    :param seed: of the environment
    :return: the findings; ``print(report)`` shows them
    :raises ValueError: for an unknown id or too few steps
    :raises ModuleNotFoundError: if the package of an id is not installed
    """
    if n_steps < 2:
        raise ValueError(f"n_steps={n_steps} must be at least 2.")
    kwargs = dict(env_kwargs or {})
    make = spec(env).maker(**kwargs) if isinstance(env, str) else partial(env, **kwargs)
    report = Report()
    first = _make(make, report)
    if first is None:
        return report
    try:
        if _check_spaces(first, report):
            # Nothing further can be played if this fails
            found = play_randomly(first, n_steps, seed)
            for topic, text in found.faults.items():
                report.add(topic, "FAIL", text)
            if "play" not in found.faults:
                _check_seeding(make, first, found, seed, report)
                _describe(found, report)
                _check_state(first, seed, report)
            _check_pickling(make, report)
    finally:
        first.close()
    return report


def _make(make: Callable[[], Any], report: Report) -> ParallelEnv | None:
    try:
        env = make()
    except Exception as error:
        report.add("making", "FAIL", f"it raises {_said(error)}. Change: what is called must return an environment.")
        return None
    if isinstance(env, AECEnv):
        change = "wrap it: sb3_belief.envs.to_parallel(env)"
        report.add("making", "FAIL", f"it is an AEC environment, agents act in turn. Change: {change}.")
    elif not isinstance(env, ParallelEnv):
        change = "return an object of a subclass of pettingzoo.ParallelEnv"
        report.add("making", "FAIL", f"it returns a {type(env).__name__}. Change: {change}.")
    else:
        other = make()
        if other is not env:
            other.close()
            return env
        report.add("making", "FAIL", "it returns the same environment each time. Change: make a new one at each call.")
    return None


def _check_spaces(env: ParallelEnv, report: Report) -> bool:
    try:
        agents = list(env.possible_agents)
        observation_spaces = {agent: env.observation_space(agent) for agent in agents}
        action_spaces = {agent: env.action_space(agent) for agent in agents}
        check_spaces(agents, observation_spaces, action_spaces, ScriptedOthers(env).action_spaces)
    except Exception as error:
        change = "possible_agents, observation_space(agent) and action_space(agent) must be there once the environment is made"
        report.add("spaces", "FAIL", f"{_said(error)}. Change: {change}, with spaces that a team can have.")
        return False
    for agent in agents:
        if env.observation_space(agent) != observation_spaces[agent] or env.action_space(agent) != action_spaces[agent]:
            report.add("spaces", "FAIL", f"those of {agent!r} differ from call to call. Change: make them once, return these.")
            return False
    kinds = {(str(observation_spaces[agent]), str(action_spaces[agent])) for agent in agents}
    report.add("spaces", "ok", f"{len(agents)} agents, {len(kinds)} kind{'s' if len(kinds) > 1 else ''} of spaces")
    return True


def _check_seeding(make: Callable[[], Any], env: ParallelEnv, found: PlayRecord, seed: int, report: Report) -> None:
    n_steps = min(sum(entry[0] != "reset" for entry in found.trace), 60)
    try:
        again = play_randomly(env, n_steps, seed).trace
        other = make()
        fresh = play_randomly(other, n_steps, seed).trace
        different = play_randomly(other, n_steps, seed + 1).trace
        other.close()
    except Exception as error:
        report.add("seeding", "FAIL", f"a further episode raises {_said(error)}. Change: reset() must begin anew at any time.")
        return
    change = "reset(seed=s) must set every generator and clear all that an episode has left behind"
    for trace, what in ((again, "when the same environment is reset with it again"), (fresh, "in a new environment")):
        step = next((t for t, (a, b) in enumerate(zip(found.trace, trace, strict=False)) if a != b), None)
        if step is not None:
            when = f"from step {step} on" if step else "from the reset on"
            report.add("seeding", "FAIL", f"the same seed and actions give something else {when}, {what}. Change: {change}.")
            return
    same = " (another seed gives the same too: nothing is random)" if different == fresh else ""
    report.add("seeding", "note" if same else "ok", f"the same seed and actions give the same {n_steps} steps{same}")


def _describe(found: PlayRecord, report: Report) -> None:
    """What was seen of the parts of the contract that have no fault."""
    faults = found.faults
    if "names" not in faults:
        report.add("names", "ok", "agents keep theirs")
    if "observations" not in faults:
        report.add("observations", "ok", "all in their spaces")
    if "rewards" not in faults:
        report.add("rewards", "ok", f"from {min(found.rewards):.3g} to {max(found.rewards):.3g}")
    if "masks" not in faults:
        report.add("masks", "ok", found.mask_summary())
    if "visibility" not in faults:
        report.add("visibility", *found.visibility_summary())
    if "flags" not in faults:
        report.add(
            "flags",
            "ok",
            f"inactive in {found.inactive} of {found.acted} actions, {found.life_ends} ends of a life within an episode",
        )
    if "infos" not in faults:
        report.add("infos", "ok", f"keys of others than this contract: {', '.join(sorted(found.other_keys)) or 'none'}")
    if "ends" not in faults:
        report.add("ends", *found.ends_summary())


def _check_state(env: ParallelEnv, seed: int, report: Report) -> None:
    get_state, set_state = optional_member(env, "get_state"), optional_member(env, "set_state")
    if get_state is None or set_state is None:
        report.add("state", "note", "no get_state() and set_state(): runs can go on, but not exactly where they stopped")
        return
    change = "get_state() must return all that decides how it goes on, as copies; set_state() must take that back"
    player = RandomPlayer(env, seed=0)
    try:
        player.reset(seed)
        player.step()
        if not env.agents:
            player.reset(None)
        masks, rng = player.masks, player.rng.bit_generator.state
        # As it is when a run is saved and loaded
        state = cloudpickle.loads(cloudpickle.dumps(get_state()))
        first = _go_on(player)
        set_state(state)
        player.masks, player.rng.bit_generator.state = masks, rng
        second = _go_on(player)
    except Exception as error:
        report.add("state", "FAIL", f"raises {_said(error)}. Change: {change}.")
        return
    if first != second:
        report.add("state", "FAIL", f"after set_state() the same actions give something else. Change: {change}.")
    else:
        report.add("state", "ok", "set_state() brings it back to where get_state() was called")


def _go_on(player: RandomPlayer) -> list[tuple]:
    start = len(player.found.trace)
    for _ in range(5):
        if not player.env.agents or not player.step():
            break
    return player.found.trace[start:]


def _check_pickling(make: Callable[[], Any], report: Report) -> None:
    try:
        cloudpickle.loads(cloudpickle.dumps(make))().close()
    except Exception as error:
        change = "let the callable and its arguments be plain (no open files, locks or environments in them)"
        report.add("pickling", "FAIL", f"what makes it cannot be sent to a worker process: {_said(error)}. Change: {change}.")
    else:
        report.add("pickling", "ok", "worker processes can make it")


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(".")
