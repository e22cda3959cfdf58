"""Reading YAML as plain data: nothing in a file is evaluated, and no key is silently dropped."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from sb3_belief.zoo.errors import ConfigError

# No configuration comes near. A few aliases of aliases can stand for billions of values
_MOST_VALUES = 100_000


class _DataLoader(yaml.SafeLoader):
    """
    PyYAML's safe loader, with which no tag makes an object.

    In addition it refuses duplicate keys, keys that are not strings, and the octal and sexagesimal numbers of YAML 1.1
    (``010`` is 8 there, ``1:30`` is 90), and reads ``3e-4`` as a number.
    """

    def construct_number(self, node: yaml.ScalarNode) -> int | float:
        """
        Return a number that everyone reads alike.

        :param node: Plain scalar that looks like a number
        :return: The number
        """
        text = node.value.lstrip("+-")
        if ":" in text or re.fullmatch(r"0[0-9_]+", text):
            meant = "in base 60" if ":" in text else "octal"
            raise yaml.constructor.ConstructorError(
                None, None, f"{node.value!r} is {meant} in YAML 1.1: write a decimal number, or quote it", node.start_mark
            )
        is_int = node.tag == "tag:yaml.org,2002:int"
        return self.construct_yaml_int(node) if is_int else self.construct_yaml_float(node)

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


for _kind in ("int", "float"):
    _DataLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _DataLoader.construct_number)

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
        data = yaml.load(text, Loader=_DataLoader)
        _check_size(data)
        return data
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{where}{line}: {error.problem}. Allowed: plain YAML data, each key once.") from None
    # An explicit tag that does not fit its value (!!bool maybe) raises whatever PyYAML's constructor happens to raise
    except (yaml.YAMLError, ValueError, OverflowError, AttributeError, KeyError, TypeError) as error:
        raise ConfigError(f"{where}: not readable as YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ConfigError(f"{where}: nested too deeply. Allowed: plain YAML data, each key once.") from None


def _check_size(data: Any) -> None:
    """Check that data does not grow without end by aliases that repeat each other, or contain themselves."""
    stack, visited = [data], 0
    while stack:
        visited += 1
        if visited > _MOST_VALUES:
            raise ValueError(f"it stands for more than {_MOST_VALUES:,} values")
        value = stack.pop()
        stack.extend(value.values() if isinstance(value, dict) else value if isinstance(value, list) else ())


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
