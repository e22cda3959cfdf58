"""Reading a YAML file as data that knows in which line each of its values stands."""

from pathlib import Path
from typing import Any

import yaml

from sb3_belief.zoo.errors import ConfigError, short, unknown_setting
from sb3_belief.zoo.yaml_data import parse


class Section:
    """
    A value of a YAML file with its place. Messages about it begin with file, line and keys.

    :param value: The value as plain data
    :param file: Path of the file
    :param keys: The keys and indices that lead to it
    :param lines: Line of each value of the file, by keys
    """

    def __init__(self, value: Any, file: str, keys: tuple[Any, ...], lines: dict[tuple[Any, ...], int]) -> None:
        self.value, self.file, self.keys, self._lines = value, file, keys, lines

    @property
    def where(self) -> str:
        """File, line and keys, with which messages begin."""
        names = [str(key) for key in self.keys if isinstance(key, str)]
        # What came by an alias or a merge stands where the next known value around it does
        known = next(
            (self._lines[self.keys[:end]] for end in range(len(self.keys), 0, -1) if self.keys[:end] in self._lines), 1
        )
        return ": ".join([f"{self.file}, line {known}" if self.keys else self.file, *names])

    def error(self, text: str) -> ConfigError:
        """
        Return the error for a value that does not fit.

        :param text: What was given, what is allowed and what to do
        :return: The error to raise
        """
        return ConfigError(f"{self.where}: {text}")

    def __getitem__(self, key: Any) -> "Section":
        return Section(self.value[key], self.file, (*self.keys, key), self._lines)

    def __contains__(self, key: Any) -> bool:
        return key in self.value

    def or_empty(self) -> "Section":
        """Return the section, as an empty mapping if nothing stands after its key."""
        return Section({}, self.file, self.keys, self._lines) if self.value is None else self

    def mapping(self, what: str, allowed: tuple[str, ...] | None = None, required: tuple[str, ...] = ()) -> "Section":
        """
        Check that the value is a mapping with known keys.

        :param what: What it should be, for the message
        :param allowed: The keys that it may have; None for any
        :param required: The keys that it must have
        :return: The section itself
        :raises ConfigError: If it is not
        """
        if not isinstance(self.value, dict):
            raise self.error(f"must be {what}, not {short(self.value)}.")
        for key in self.value if allowed is not None else ():
            if key not in (allowed or ()):
                raise unknown_setting(self[key].where.removesuffix(f": {key}"), "key", key, allowed or ())
        for key in required:
            if key not in self.value:
                raise self.error(f"has no key {key!r}. It must be {what}.")
        return self

    def number(self, least: int, most: int, what: str) -> int:
        """
        Check that the value is a whole number in a range.

        :param least: The least one
        :param most: The greatest one
        :param what: What it is a number of, for the message
        :return: The number
        :raises ConfigError: If it is not
        """
        value = self.value
        if isinstance(value, float) and value.is_integer():
            # 1e6 is a whole number too
            value = int(value)
        if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
            raise self.error(f"must be a whole number of {what} from {least} to {most:,}, not {short(self.value)}.")
        return value

    def chosen(self, kind: str, allowed: Any) -> str:
        """
        Check that the value is one of some names.

        :param kind: What it should be a name of
        :param allowed: The names
        :return: The name
        :raises ConfigError: If it is not
        """
        if not isinstance(self.value, str) or self.value not in allowed:
            raise unknown_setting(self.where, kind, self.value, allowed)
        return self.value

    def items(self, what: str) -> list["Section"]:
        """
        Check that the value is a list.

        :param what: What it should be a list of, for the message
        :return: Its items
        :raises ConfigError: If it is not
        """
        if not isinstance(self.value, list):
            raise self.error(f"must be a list of {what}, not {short(self.value)}.")
        return [self[index] for index in range(len(self.value))]


def read_sections(path: Path) -> Section:
    """
    Read a YAML file as plain data with the lines of its values.

    :param path: The file
    :return: Its top level, which is a mapping
    :raises ConfigError: If the file cannot be read, or is no plain YAML data whose top level is a mapping
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: cannot be read ({reason}): name a YAML file that describes a study.") from None
    data = parse(text, str(path))
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: must map names to settings, as docs/studies.md has them, not {type(data).__name__}.")
    lines: dict[tuple[Any, ...], int] = {}
    _note_lines(yaml.compose(text, Loader=yaml.SafeLoader), (), lines)
    return Section(data, str(path), (), lines)


def _note_lines(node: Any, keys: tuple[Any, ...], lines: dict[tuple[Any, ...], int]) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*keys, key.value)
            # An alias stands for a node of another place
            lines[here] = key.start_mark.line + 1
            if value.start_mark.line >= key.start_mark.line:
                _note_lines(value, here, lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            lines[(*keys, index)] = value.start_mark.line + 1
            _note_lines(value, (*keys, index), lines)
