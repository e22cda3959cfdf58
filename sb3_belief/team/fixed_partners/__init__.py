"""One learner among partners that act and do not learn."""

from sb3_belief.team.fixed_partners.agent_env import AgentEnv

__all__ = ["AgentEnv"]
