"""Policies with equal networks make their forward passes in one batch."""

from sb3_belief.team.batched_forward.batcher import BatchedForward, batched_forwards

__all__ = ["BatchedForward", "batched_forwards"]
