"""A single learner in a team whose other agents act and do not learn."""

from sb3_belief.team.fixed_partners.agent_env import AgentEnv
from sb3_belief.team.fixed_partners.observe_last import ObserveLast

__all__ = ["AgentEnv", "ObserveLast"]
