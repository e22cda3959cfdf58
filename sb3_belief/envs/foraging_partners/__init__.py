"""Foraging beside a scripted player: the picker with an order of its own, and the heuristics of the LBF papers."""

from sb3_belief.envs.foraging_partners.parallel_env import PartneredForaging

__all__ = ["PartneredForaging"]
