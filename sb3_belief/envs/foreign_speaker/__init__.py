"""Foreign speaker: a listener must find out what the symbols of a scripted speaker mean."""

from sb3_belief.envs.foreign_speaker.parallel_env import ForeignSpeaker

__all__ = ["ForeignSpeaker"]
