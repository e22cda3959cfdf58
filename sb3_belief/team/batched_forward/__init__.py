"""Policies with equal networks act together: one pass for all, their weights stacked into one tensor for each layer."""

from sb3_belief.team.batched_forward.batched_forward import BatchedForward, batched_forwards

__all__ = ["BatchedForward", "batched_forwards"]
