"""Whether an environment reports ``is_success``, which has to be known before its first episode ends."""

import inspect
from types import CodeType
from typing import Any

from sb3_belief.vec_env.scripted_others import optional_member


def reports_success(env: Any) -> bool:
    """
    Return whether an environment reports ``is_success`` in its infos.

    It says so by an attribute ``reports_success``. If it has none, the answer is whether its code, or that of a wrapper around
    it, has the word as a key: many environments report successes only, and the ends before the first one count as well.

    :param env: The environment, with or without wrappers
    """
    said = optional_member(env, "reports_success")
    if said is not None:
        return bool(said)
    while env is not None:
        if any(_has_key(member) for kind in type(env).__mro__ for member in vars(kind).values()):
            return True
        members = getattr(env, "__dict__", {})
        env = members.get("env") or members.get("aec_env")
    return False


def _has_key(member: Any) -> bool:
    """Return whether ``is_success`` is among the constants of a function, or of one inside of it."""
    if isinstance(member, property):
        member = member.fget
    elif isinstance(member, (classmethod, staticmethod)):
        member = member.__func__
    if not inspect.isfunction(member):
        return False
    codes: list[CodeType] = [inspect.unwrap(member).__code__]
    while codes:
        for constant in codes.pop().co_consts:
            # Keys that are written together stand in a tuple
            if constant == "is_success" or (isinstance(constant, tuple) and "is_success" in constant):
                return True
            if inspect.iscode(constant):
                codes.append(constant)
    return False
