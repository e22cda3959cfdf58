"""Several processes share a team's agents: they update them and choose their actions."""

from sb3_belief.team.parallel.sharing import ParallelLearning, check_jobs

__all__ = ["ParallelLearning", "check_jobs"]
