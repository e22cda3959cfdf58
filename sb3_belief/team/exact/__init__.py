"""The exact state of a team: all that decides how its training goes on, so that a resumed run equals an undisturbed one."""

from sb3_belief.team.exact.training import ExactState, ExactTraining, check_exact_load

__all__ = ["ExactState", "ExactTraining", "check_exact_load"]
