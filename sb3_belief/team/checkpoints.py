"""Checkpoints of a team that learns: files from which the training goes on, and a state in memory for an interruption."""

import io
import os
import re
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.common.durable_files import make_folder, replaced_file

#: Joint steps between checkpoints if each of them resets the environment, and no other number is given
RESET_FREQ = 50_000
# A state is kept in memory after this many times as long as keeping it takes, that is for a hundredth of the time
_RARELY = 100
# Larger states, such as those with large replay buffers, are not held in memory beside the team
_MOST_BYTES = 256 * 2**20
# How many rollouts a checkpoint waits for one that all agents begin together before that is said
_LONG_WAIT = 20
_NAME = re.compile(r"_(\d+)_steps\.zip")


@dataclass
class _Kept:
    """
    The last good state.

    :param steps: Number of the team's timesteps; -1 before the first
    :param content: The bytes of its file; None if it is too large for the memory, so that it is on the disk only
    :param is_exact: Whether the training goes on from it exactly
    :param taken_at: When it was taken, by ``time.monotonic()``
    :param seconds: How long that took
    :param path: Its file, if it has been written
    """

    steps: int = -1
    content: bytes | None = None
    is_exact: bool = False
    taken_at: float = -float("inf")
    seconds: float = 0.0
    path: Path | None = None


@dataclass
class _Plan:
    """
    When and where files are written. SB3's callbacks have counters as attributes, which checkpoints hold; these are none.

    :param folder: Folder of the files
    :param save_freq: Timesteps between them; None for none by steps
    :param save_every: Seconds between them; None for none by time
    :param keep: How many stay
    :param name_prefix: How their names begin
    :param saved_steps: Timesteps at the last one
    :param saved_at: When it was written, by ``time.monotonic()``
    :param needs_reset: Whether checkpoints reset the environment, so that they must not depend on the clock; None as long as
        it is unknown
    :param exact: Whether the team can be saved so that the training goes on exactly
    :param kept: The last good state
    :param kept_exact: The last one from which the training goes on exactly; mostly the same
    :param skipped: How many rollouts have begun since a file was due, because not all agents began one
    """

    folder: Path
    save_freq: int | None
    save_every: float | None
    keep: int
    name_prefix: str
    saved_steps: int = -1
    saved_at: float = -float("inf")
    needs_reset: bool | None = None
    exact: bool = True
    kept: _Kept = field(default_factory=_Kept)
    kept_exact: _Kept = field(default_factory=_Kept)
    skipped: int = 0

    def keep_state(self, kept: _Kept) -> None:
        """
        Take a state for the last one.

        :param kept: The state
        """
        self.kept = kept
        if kept.is_exact:
            self.kept_exact = kept

    def is_due(self, steps: int) -> bool:
        """
        Tell whether a file is to be written.

        :param steps: Number of the team's timesteps
        """
        if self.save_freq is None and self.save_every is None:
            return False
        freq = self.save_freq or (RESET_FREQ if self.needs_reset else None)
        if freq is not None and steps // freq > self.saved_steps // freq:
            return True
        if self.needs_reset:
            return False
        return self.save_every is not None and time.monotonic() - self.saved_at >= self.save_every


class Checkpoints(BaseCallback):
    """
    Callback of a team that writes checkpoints from which the training goes on exactly.

    They are taken where a rollout starts: all agents have learned from the last one, and none has acted in the next. The first
    is written when the training starts. ``Team.load(file, env=env, exact=True)`` and a ``learn`` with the same callbacks go
    on from there as if nothing had happened. It is the first callback of the list, so that checkpoints hold nothing of what
    other callbacks do where the rollout starts.

    If the disk is full there is a warning, and the training goes on. Between the files the last state is kept in memory
    (``last``), so seldom that it takes a hundredth of the time at most: a program that is interrupted can write it.
    Environments whose state cannot be saved are reset at each checkpoint, which must then not depend on the clock: without
    ``save_freq`` there is one every 50,000 joint steps. Where agents have rollouts of unequal lengths, a checkpoint waits
    until all of them begin one, and what is kept in memory meanwhile are the models only.

    :param folder: Folder of the files ``<name_prefix>_<steps>_steps.zip``
    :param save_freq: Joint steps between checkpoints; None for none by steps
    :param save_every: Seconds between checkpoints; None for none by time. Without both, only the state in memory is kept
    :param keep: How many files stay, those with the highest numbers of steps
    :param name_prefix: How their names begin
    :param resumed_from: The checkpoint from which the team was loaded, which need not be written again; None for a new team
    :param verbose: 1 or more to print each file
    :raises ValueError: If a number is not positive
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        save_freq: int | None = None,
        save_every: float | None = None,
        keep: int = 2,
        name_prefix: str = "team",
        resumed_from: str | os.PathLike[str] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        for name, value in (("save_freq", save_freq), ("save_every", save_every), ("keep", keep)):
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, or None, not {value!r}.")
        self._plan = _Plan(Path(folder), save_freq, save_every, keep, name_prefix)
        self._resumed_from = None if resumed_from is None else Path(resumed_from)

    @property
    def last(self) -> _Kept:
        """The last good state; its ``steps`` are -1 if there is none yet."""
        return self._plan.kept

    def _on_training_start(self) -> None:
        path, self._resumed_from = self._resumed_from, None
        plan, steps = self._plan, self._team.num_timesteps
        if steps < plan.saved_steps:
            # Counted anew
            plan.saved_steps, plan.saved_at = -1, -float("inf")
            plan.kept = plan.kept_exact = _Kept()
        if path is not None:
            small = path.stat().st_size <= _MOST_BYTES
            plan.keep_state(_Kept(steps, path.read_bytes() if small else None, True, time.monotonic(), path=path))
            plan.saved_steps, plan.saved_at = steps, time.monotonic()

    def _on_rollout_start(self) -> None:
        plan, team = self._plan, self._team
        steps = team.num_timesteps
        if steps == plan.kept.steps:
            return
        if plan.needs_reset is None:
            # It is found out by trying, which takes time
            plan.needs_reset = bool(team.exact_needs_reset)
        due, all_begin = plan.is_due(steps), self._all_begin
        if due and all_begin:
            plan.saved_steps, plan.skipped = steps, 0
            self._save()
            plan.saved_at = time.monotonic()
            return
        if due:
            self._skip()
        if time.monotonic() - plan.kept.taken_at >= _RARELY * plan.kept.seconds and self._fits:
            # An exact one would reset the environment, or there is none here
            self._take(exact=all_begin and not plan.needs_reset)

    def _skip(self) -> None:
        plan = self._plan
        plan.skipped += 1
        if plan.skipped == _LONG_WAIT:
            warnings.warn(
                f"A checkpoint has been due for {_LONG_WAIT} rollouts, but the agents' rollouts have unequal lengths and do"
                " not begin together. Give all agents the same number of steps between updates for checkpoints from which the"
                " training goes on exactly."
            )

    @property
    def _all_begin(self) -> bool:
        """Whether all agents begin a rollout: with rollouts of several lengths one may be in the middle of it."""
        loop = self._team._loop
        return loop is None or loop.begins_rollouts

    def _on_step(self) -> bool:
        return True

    def save_last(self) -> Path | None:
        """
        Write the last state from which the training goes on exactly as the newest checkpoint, if it has not been written yet.

        :return: Its file; None if there is no such state
        :raises OSError: If it cannot be written
        """
        kept = self._plan.kept_exact
        if kept.path is None and kept.content is not None:
            self._write(kept)
        return kept.path

    def save_now(self) -> Path | None:
        """
        Write a checkpoint of a team that has finished learning, so that it can learn further.

        :return: Its file; None if the training does not go on exactly from there
        :raises OSError: If it cannot be written
        """
        plan = self._plan
        if not plan.exact:
            return None
        if plan.kept_exact.steps != self._team.num_timesteps or plan.kept_exact.path is None:
            try:
                self._take(exact=True)
            except ValueError:
                # Some agents have finished before others, so they are not in step
                return None
            self._write(plan.kept)
        return plan.kept.path

    # Taking and writing

    @property
    def _team(self) -> Any:
        return self.model

    @property
    def _fits(self) -> bool:
        kept = self._plan.kept
        return kept.content is not None or kept.path is None

    def _save(self) -> None:
        plan = self._plan
        try:
            if self._fits:
                self._take(exact=True)
                self._write(plan.kept)
            else:
                self._write_directly()
        except OSError as error:
            warnings.warn(
                f"The checkpoint at {plan.saved_steps} joint steps could not be written to {plan.folder} ({error}): the"
                " training goes on without it."
            )

    def _take(self, exact: bool) -> None:
        """Keep the team's present state in memory."""
        plan, start, file = self._plan, time.monotonic(), io.BytesIO()
        if exact and plan.exact:
            try:
                self._team.save(file, exact=True)
            except (TypeError, ValueError) as error:
                if plan.kept.steps >= 0:
                    raise
                warnings.warn(f"This training cannot be continued exactly, its checkpoints hold the models only: {error}")
                plan.exact, file = False, io.BytesIO()
        if not (exact and plan.exact):
            self._team.save(file)
        end = time.monotonic()
        plan.keep_state(_Kept(self._team.num_timesteps, file.getvalue(), exact and plan.exact, end, end - start))

    def _path(self, steps: int) -> Path:
        return self._plan.folder / f"{self._plan.name_prefix}_{steps}_steps.zip"

    def _write(self, kept: _Kept) -> None:
        """Write a state in memory, and what the logs hold up to it."""
        assert kept.content is not None
        self._sync_logs()
        make_folder(self._plan.folder)
        path = self._path(kept.steps)
        with replaced_file(path) as file:
            file.write(kept.content)
        self._on_written(kept, path)
        if len(kept.content) > _MOST_BYTES:
            kept.content = None

    def _write_directly(self) -> None:
        """Write the team's present state without a copy in memory."""
        self._sync_logs()
        path = self._path(self._team.num_timesteps)
        self._team.save(path, exact=True)
        self._plan.keep_state(_Kept(self._team.num_timesteps, None, True, time.monotonic()))
        self._on_written(self._plan.kept, path)

    def _on_written(self, kept: _Kept, path: Path) -> None:
        plan = self._plan
        kept.path = path
        if self.verbose:
            print(f"Checkpoint: {path}")
        numbered = checkpoint_files(plan.folder, plan.name_prefix)
        # Those of later steps are damaged ones, from before the training went on from an earlier one
        for _, old in [pair for pair in numbered if pair[0] <= kept.steps][: -plan.keep]:
            old.unlink(missing_ok=True)

    def _sync_logs(self) -> None:
        # A checkpoint counts on the rows that were written before it
        if self._team._log is not None:
            self._team._log.sync()
        env: Any = self.training_env.unwrapped
        env.sync_monitor()


def checkpoint_files(folder: str | os.PathLike[str], name_prefix: str = "team") -> list[tuple[int, Path]]:
    """
    List the checkpoints in a folder.

    :param folder: The folder
    :param name_prefix: How their names begin
    :return: Number of steps and path of each, in the order of the numbers
    """
    found = []
    for path in Path(folder).glob("*_steps.zip"):
        match = _NAME.fullmatch(path.name.removeprefix(name_prefix))
        if match is not None and path.name.startswith(name_prefix):
            found.append((int(match[1]), path))
    return sorted(found)
