"""Reading YAML as plain data: nothing in a file is evaluated, and no key is silently dropped."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from sb3_belief.zoo.errors import ConfigError


class _DataLoader(yaml.SafeLoader):
    """
    PyYAML's safe loader, with which no tag makes an object.

    In addition it refuses duplicate keys and keys that are not strings, and reads ``3e-4`` as a number.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        # PyYAML keeps the last of two equal keys, so the first one would be lost silently
        seen: set[Any] = set()
        for key_node, _ in node.value:
            # "<<" merges another mapping, whose keys may be overridden
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is not a name", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"duplicate key {key!r}", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


# PyYAML follows YAML 1.1, in which a float in exponent form needs a dot and a sign, so that 3e-4 is a string. Users mean the
# number, as in YAML 1.2
_DataLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def parse(text: str, where: str) -> Any:
    """
    Parse YAML as plain data.

    :param text: YAML
    :param where: File or flag that it comes from, for the error message
    :return: Value made of dict, list, str, int, float, bool and None (and dates)
    :raises ConfigError: For text that is not plain YAML data
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
    Read a configuration file.

    :param path: YAML file whose top level is a mapping
    :return: The mapping
    :raises ConfigError: If the file cannot be read or is not a mapping
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
    Read the ``key:value`` pairs that follow a flag on the command line.

    A dot in a key stands for a nested mapping, as in ``policy_kwargs.net_arch:[64,64]``. Values are read as YAML.

    :param pairs: The words that follow the flag
    :param flag: Name of the flag, for the error message
    :return: Nested dict
    :raises ConfigError: For a word without a colon, or a key that is given twice
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
    Return settings with other settings merged over them.

    :param base: Settings
    :param over: Settings that take precedence. Nested mappings are merged, all other values are replaced
    :return: A new dict. Neither argument is changed
    """
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged
