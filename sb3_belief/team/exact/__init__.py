"""The exact state of a team: all that decides how its training goes on, so that a resumed run equals an undisturbed one."""

from sb3_belief.team.exact.agent_state import AgentState, read_agent_state, write_agent_state
from sb3_belief.team.exact.team_state import ExactState, callback_states, restore_callbacks

__all__ = [
    "AgentState",
    "ExactState",
    "callback_states",
    "read_agent_state",
    "restore_callbacks",
    "write_agent_state",
]
