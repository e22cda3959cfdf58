"""A single learner in a team whose other agents act and do not learn."""

from sb3_belief.team.fixed_partners.agent_env import AgentEnv

__all__ = ["AgentEnv"]
