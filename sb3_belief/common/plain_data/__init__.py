"""
Objects as plain data: JSON and one block of raw bytes, which can be read without running anything of whoever wrote it.

A pickle is a program. What is here is a description instead: each node of the JSON is a value itself or an object whose key
``is`` names one of a fixed list of kinds (``decoder.py``). Classes are named by ``module:qualname`` and looked up only if the
caller allows their module.
"""

from sb3_belief.common.plain_data.decoder import decode
from sb3_belief.common.plain_data.encoder import encode
from sb3_belief.common.plain_data.kinds import NotPlainError, PlainData

__all__ = ["NotPlainError", "PlainData", "decode", "encode"]
