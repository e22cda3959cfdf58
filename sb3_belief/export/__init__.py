"""Trained agents as files that run without this package and without Stable-Baselines3: ONNX, and PyTorch's own format."""

from sb3_belief.export.files import FORMATS, export_model
from sb3_belief.export.graph import PolicyGraph

__all__ = ["FORMATS", "PolicyGraph", "export_model"]
