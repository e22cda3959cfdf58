"""What happens between the agents while a team learns: the team's callback, its counters and its log."""

from typing import TYPE_CHECKING, Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, ProgressBarCallback
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_belief.team.logs import TeamLog
from sb3_belief.vec_env.team_vec_env import TeamObs, TeamStep

if TYPE_CHECKING:
    from sb3_belief.team.team import Team


def as_callback(callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
    """
    :param callback: what SB3's ``learn`` takes: None, a function, a callback or a list of them
    :param progress_bar: whether to add SB3's progress bar
    :return: one callback
    """
    if isinstance(callback, list):
        callback = CallbackList(callback)
    if not isinstance(callback, BaseCallback):
        callback = ConvertCallback(callback)
    return CallbackList([callback, ProgressBarCallback()]) if progress_bar else callback


class TeamProgress:
    """
    Observes a team's steps (see ``lockstep.Observer``).

    :param team: the team
    :param callback: its callback
    :param log: its loggers
    """

    def __init__(self, team: "Team", callback: BaseCallback, log: TeamLog):
        self._team, self._callback, self._log = team, callback, log
        self.has_callback = not (isinstance(callback, ConvertCallback) and callback.callback is None)
        callback.init_callback(team)  # type: ignore[arg-type]

    def on_training_start(self, locals_: dict[str, Any]) -> None:
        """
        :param locals_: what callbacks find in ``self.locals``
        """
        self._callback.on_training_start(locals_, globals())

    def on_rollout_start(self) -> None:
        self._callback.on_rollout_start()

    def on_step(self, actions: TeamObs, step: TeamStep) -> bool:
        obs, rewards, dones, infos = step
        self._team.num_timesteps += len(dones)
        go_on = True
        if self.has_callback:
            locals_ = {"actions": actions, "new_obs": obs, "rewards": rewards, "dones": dones, "infos": infos}
            self._callback.update_locals(locals_)
            go_on = self._callback.on_step()
        if dones.any():
            for info in infos:
                if "episode" in info:
                    self._team.ep_info_buffer.append(info["episode"])
                    if "is_success" in info:
                        self._team.ep_success_buffer.append(info["is_success"])
        return go_on

    def on_rollout_end(self) -> None:
        self._callback.on_rollout_end()

    def on_round_end(self, learning: list[str]) -> None:
        if self._log.complete(learning):
            self._log.record_means(self._team.logger)
            self._team.dump_logs()

    def on_training_end(self) -> None:
        """The last call."""
        self._callback.on_training_end()
