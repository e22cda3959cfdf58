"""Centralised references of the comparison set: each uses the global state in training."""
