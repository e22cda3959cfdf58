"""Several processes share a team's agents: they update them and choose their actions."""

from sb3_belief.team.parallel.sharing import Jobs, check_jobs

__all__ = ["Jobs", "check_jobs"]
