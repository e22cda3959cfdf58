"""The training of a run, from its callbacks to what it leaves behind however it ends."""

import os
import shutil
import signal
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_belief.common.durable_files import replaced_file
from sb3_belief.team import Team, TeamVecEnv
from sb3_belief.team.checkpoints import Checkpoints
from sb3_belief.zoo.config import RunConfig
from sb3_belief.zoo.endings import EndSignals, Interrupted, SignalCheck, save_somewhere, tell, write_traceback
from sb3_belief.zoo.errors import ConfigError, RunFailed, cause
from sb3_belief.zoo.run_folder import CHECKPOINTS, TEAM, RunRecord, environment_versions
from sb3_belief.zoo.seeded_evaluation import MaskableSeededEvalCallback, SeededEvalCallback
from sb3_belief.zoo.train_options import TrainOptions, TrainResult


@dataclass(frozen=True)
class RunCallbacks:
    """
    The callbacks of a run.

    :param checkpoints: Writes the checkpoints
    :param others: All others, in order
    """

    checkpoints: Checkpoints
    others: list[BaseCallback]

    @classmethod
    def make(
        cls,
        team: Team,
        config: RunConfig,
        options: TrainOptions,
        folder: Path,
        eval_env: TeamVecEnv | None,
        signals: EndSignals,
        resumed_from: Path | None = None,
        after_eval: BaseCallback | None = None,
    ) -> "RunCallbacks":
        """
        Make the callbacks of a run.

        :param team: The team that learns
        :param config: The configuration
        :param options: Options of the run, with a seed
        :param folder: Folder of the run
        :param eval_env: Environment of the evaluations; None for none
        :param signals: Signals that end the training
        :param resumed_from: The checkpoint from which the team was loaded, if the run is continued
        :param after_eval: Called after each evaluation; None for nothing
        :return: The callbacks
        :raises ConfigError: If one refuses its settings
        """
        others: list[BaseCallback] = [SignalCheck(signals)]
        try:
            others += [callback(**kwargs) for callback, kwargs in config.callbacks]
        except Exception as error:
            raise ConfigError(f"{config.origin('callback:')}: callback: refuses its settings: {cause(error)}") from error
        checkpoints = Checkpoints(
            folder / CHECKPOINTS,
            save_freq=options.save_freq if options.save_freq > 0 else None,
            save_every=options.save_every if options.save_every > 0 else None,
            resumed_from=resumed_from,
            verbose=options.verbose,
        )
        if eval_env is not None:
            # SB3 warns if only one of the two environments has worker processes, which is intended here
            warnings.filterwarnings("ignore", message="Training and eval env are not of the same type")
            assert options.seed is not None
            others.append(
                (MaskableSeededEvalCallback if team.takes_masks else SeededEvalCallback)(
                    eval_env,
                    callback_after_eval=after_eval,
                    n_eval_episodes=options.eval_episodes,
                    # SB3's callbacks count their calls: one for each step of all copies, which is n_envs joint steps
                    eval_freq=max(options.eval_freq // config.n_envs, 1),
                    log_path=str(folder),
                    best_model_save_path=str(folder),
                    verbose=options.verbose,
                    seed=options.seed,
                )
            )
        return cls(checkpoints, others)


def learn_and_save(
    team: Team,
    config: RunConfig,
    options: TrainOptions,
    folder: Path,
    record: RunRecord,
    callbacks: RunCallbacks,
    signals: EndSignals,
    counts_anew: bool,
) -> TrainResult:
    """
    Let a team learn until the run's number of joint steps, and save it. If that ends early, save the last good state.

    :param team: The team
    :param config: The configuration
    :param options: Options of the run
    :param folder: Folder of the run
    :param record: Its record, whose ``total_timesteps`` says how long the team learns
    :param callbacks: The callbacks
    :param signals: Signals that end the training
    :param counts_anew: Whether the team begins to count its steps
    :return: The folder and the team, also if a signal ended the training
    :raises RunFailed: If the training fails
    """
    error: BaseException | None = None
    remaining = record.content["total_timesteps"] - (0 if counts_anew else team.num_timesteps)
    try:
        if remaining > 0:
            team.learn(
                remaining,
                callback=[callbacks.checkpoints, *callbacks.others],
                progress_bar=options.progress,
                reset_num_timesteps=counts_anew,
            )
        signals.hold()
    except BaseException as caught:
        signals.hold()
        error = signals.cause_of(caught)
    end = _End(team, folder, callbacks.checkpoints, record)
    env = team.get_env()
    assert env is not None
    environment: dict[str, str] = {}
    if error is None:
        environment = environment_versions(config.env_id, env)
        error = end.save_finished(remaining > 0 and (options.save_freq > 0 or options.save_every > 0))
    if error is None:
        end.finish("finished", environment=environment)
        if options.verbose:
            print(f"Finished after {team.num_timesteps} joint steps. Saved: {end.saved}")
        return TrainResult(folder, team)
    end.save_last()
    # Only now, since a broken environment may say anything, and may hang
    with suppress(Exception):
        environment = environment_versions(config.env_id, env)
    goes_on = ""
    if end.can_continue:
        allowed = f" --allow-package {' '.join(options.extra_packages)}" if options.extra_packages else ""
        goes_on = f" To continue: sb3-belief train --resume {folder}{allowed}"
    saved = f"Saved: {end.saved}, which is the state at {end.timesteps} joint steps." if end.saved else "Nothing was saved."
    if isinstance(error, KeyboardInterrupt):
        # Someone may raise it without a signal
        by = error if isinstance(error, Interrupted) else Interrupted(signal.SIGINT)
        end.finish("interrupted", signal=by.signal_name, environment=environment)
        print(f"Interrupted by {by.signal_name} after {team.num_timesteps} joint steps. {saved}{goes_on}")
        return TrainResult(folder, team, by.exit_status)
    trace = write_traceback(folder, error)
    end.finish("failed", error=cause(error), environment=environment)
    reason = cause(error)
    raise RunFailed(
        f"The training failed after {team.num_timesteps} joint steps: {reason}{'' if reason.endswith('.') else '.'} {saved}"
        f"{f' Traceback: {trace}.' if trace else ''}{goes_on}"
    ) from error


class _End:
    """
    What is saved of a run at its end.

    :param team: The team
    :param folder: Folder of the run
    :param checkpoints: The callback that keeps the last good state
    :param record: Record of the run
    """

    def __init__(self, team: Team, folder: Path, checkpoints: Checkpoints, record: RunRecord):
        self._team, self._folder, self._checkpoints, self._record = team, folder, checkpoints, record
        #: Where the team is, and the joint steps that it had made
        self.saved: Path | None = None
        self.timesteps = 0
        #: Whether there is a checkpoint from which the run can be continued
        self.can_continue = False

    def save_finished(self, with_checkpoint: bool) -> BaseException | None:
        """
        Save the team as it is.

        :param with_checkpoint: Whether to write a checkpoint, too, for training further
        :return: What was raised if the team could not be saved
        """
        try:
            self.saved = save_somewhere(self._folder / TEAM, self._team.save)
        except Exception as error:
            return error
        self.timesteps = self._team.num_timesteps
        if self.saved is None:
            return OSError("the team could not be saved anywhere")
        if with_checkpoint:
            self._warn_if_full(self._checkpoints.save_now)
        return None

    def save_last(self) -> None:
        """Save the last good state as the run's team and as its newest checkpoint."""
        last = self._checkpoints.last

        def write(path: Path) -> None:
            with replaced_file(path) as file:
                if last.content is not None:
                    file.write(last.content)
                else:
                    assert last.path is not None
                    with open(last.path, "rb") as checkpoint:
                        shutil.copyfileobj(checkpoint, file)

        # Before the first rollout there is none, and nothing has been learned
        self.timesteps = self._team.num_timesteps if last.steps < 0 else last.steps
        try:
            self.saved = save_somewhere(self._folder / TEAM, self._team.save if last.steps < 0 else write)
        except Exception as error:
            tell(f"The team could not be saved: {cause(error)}")
        self.can_continue = self._warn_if_full(self._checkpoints.save_last) is not None

    def finish(self, status: str, **content: Any) -> None:
        """
        Record how the run ended.

        :param status: As ``RunRecord.finish`` takes it
        :param content: Results to add
        """
        if self.saved is not None and self.saved.parent != self._folder:
            content["saved"] = os.fspath(self.saved)
        try:
            self._record.finish(status, timesteps=self.timesteps, **content)
        except OSError as error:
            tell(f"{self._record.path} could not be written ({error}): the run is {status}.")

    @staticmethod
    def _warn_if_full(save: Callable[[], Path | None]) -> Path | None:
        try:
            return save()
        except OSError as error:
            tell(f"The last checkpoint could not be written ({error}).")
            return None
