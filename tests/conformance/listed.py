"""The tests that are listed as not applicable, each with its reason."""

import re
from collections.abc import Iterable
from pathlib import Path

import yaml


def read_listed(path: Path, belief: str, suite: str) -> dict[str, str]:
    """
    :param path: A file like ``listed.yml``: pass -> suite -> pattern -> reason
    :param belief: The pass, ``"none"`` or ``"active"``
    :param suite: ``"sb3"`` or ``"contrib"``
    :return: {pattern of test ids: reason}
    :raises ValueError: for an entry without a reason
    """
    listed = ((yaml.safe_load(path.read_text()) or {}).get(belief) or {}).get(suite) or {}
    for pattern, reason in listed.items():
        if not isinstance(reason, str) or not reason.strip():
            raise ValueError(f"{path.name}: {pattern} is listed without a reason; say why it does not apply")
    return {pattern: " ".join(reason.split()) for pattern, reason in listed.items()}


def matching(pattern: str, tests: Iterable[str]) -> list[str]:
    """
    :param pattern: A test's id without its folder, ``test_run.py::test_ppo[0.1]``; ``*`` stands for anything
    :param tests: Ids of tests, alike
    :return: Those that it is about
    """
    about = re.compile(".*".join(map(re.escape, pattern.split("*"))))
    return [test for test in tests if about.fullmatch(test)]
