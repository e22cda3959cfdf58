"""Agents of one team learn in several processes at once."""

from sb3_belief.team.parallel.parallel_learning import ParallelLearning, check_jobs

__all__ = ["ParallelLearning", "check_jobs"]
