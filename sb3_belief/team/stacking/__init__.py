"""Policies with equal networks act together: one pass for all, their weights stacked into one tensor for each layer."""

from sb3_belief.team.stacking.passes import Part, Together, make

__all__ = ["Part", "Together", "make"]
