"""Reading YAML as data: nothing in a file is ever evaluated, and nothing in it is silently dropped."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from sb3_belief.zoo.errors import ConfigError


class _DataLoader(yaml.SafeLoader):
    """PyYAML's safe loader (no tag makes an object), which refuses duplicate keys and reads ``3e-4`` as a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        # PyYAML keeps the last of two equal keys, so a setting further up would be lost without a word
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is not a name", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"duplicate key {key!r}", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


# YAML 1.1 wants a dot and a sign in a float's exponent form; everyone writes 3e-4 and means the number (as YAML 1.2 does)
_DataLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def parse(text: str, where: str) -> Any:
    """
    :param text: YAML
    :param where: the file or flag it comes from, for the error message
    :return: its value, built of dict, list, str, int, float, bool, None (and dates)
    :raises ConfigError: for text that is not plain YAML data
    """
    try:
        return yaml.load(text, Loader=_DataLoader)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{where}{line}: {error.problem}. Allowed: plain YAML data, each key once.") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{where}: not readable as YAML: {error}") from None


def read_file(path: Path) -> dict[str, Any]:
    """
    :param path: YAML file whose top level is a mapping
    :return: the mapping
    :raises ConfigError: if the file cannot be read or is no mapping
    """
    try:
        data = parse(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: must map environment ids (or 'default') to settings, not {type(data).__name__}.")
    return data


def parse_pairs(pairs: Iterable[str], flag: str) -> dict[str, Any]:
    """
    Read ``key:value`` pairs of the command line. A dot in the key names a nested one: ``policy_kwargs.net_arch:[64,64]``.

    :param pairs: the words that followed the flag
    :param flag: the flag's name, for the error message
    :return: nested dict
    :raises ConfigError: for a word without a colon, or a key given twice
    """
    result: dict[str, Any] = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        path = key.strip().split(".")
        if not colon or not all(path):
            raise ConfigError(f"{flag}: {pair!r} is not of the form key:value, e.g. learning_rate:3e-4.")
        inner = result
        for name in path[:-1]:
            inner = inner.setdefault(name, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"{flag}: {key!r} is given both as a value and as a mapping.")
        if path[-1] in inner:
            raise ConfigError(f"{flag}: key {key!r} is given twice.")
        inner[path[-1]] = parse(text, f"{flag} {key}")
    return result


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """
    :param base: settings
    :param over: settings that win; nested mappings are merged, everything else is replaced
    :return: a new dict
    """
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
