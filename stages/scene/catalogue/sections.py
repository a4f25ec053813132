"""Reads YAML and JSON files into checked sections that know the line they came from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml

from runner.contract import Refused
from stages.geometry.arrays import Floats

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_REQUIRED: Any = object()


@dataclass(frozen=True)
class Section:
    """A mapping of a file. Every getter raises :class:`Refused` naming file, line, path and what is valid."""

    file: Path
    line: int
    path: str
    values: dict[str, Any]
    """Scalars, lists of values, or further sections."""
    lines: dict[str, int]

    def refuse(self, problem: str, key: str = "") -> NoReturn:
        """Ends reading with one line about ``key`` (or about the whole section)."""
        place = f"{self.path}.{key}" if self.path and key else self.path or key
        raise Refused(f"{self.file}:{self.lines.get(key, self.line)}: {place}: {problem}".replace(": : ", ": "))

    def only(self, *valid: str) -> None:
        """Refuses every key that is not in ``valid``."""
        for key in self.values:
            if key not in valid:
                self.refuse(f"unknown key; valid are {', '.join(valid)}", key)

    def value(self, key: str, default: Any = _REQUIRED) -> Any:
        """Whatever stands there."""
        if key in self.values:
            return self.values[key]
        if default is _REQUIRED:
            self.refuse(f"the key '{key}' is missing")
        return default

    def text(self, key: str, default: Any = _REQUIRED) -> str:
        """A string."""
        value = self.value(key, default)
        return value if isinstance(value, str) else self._mismatch(key, "a text")

    def choice(self, key: str, valid: tuple[str, ...], default: Any = _REQUIRED) -> str:
        """One of ``valid``."""
        value = self.value(key, default)
        return value if value in valid else self._mismatch(key, f"one of {', '.join(valid)}")

    def flag(self, key: str, default: Any = _REQUIRED) -> bool:
        """True or false."""
        value = self.value(key, default)
        return value if isinstance(value, bool) else self._mismatch(key, "true or false")

    def integer(self, key: str, default: Any = _REQUIRED, *, low: int = 0) -> int:
        """A whole number of at least ``low``."""
        value = self.value(key, default)
        valid = isinstance(value, int) and not isinstance(value, bool) and value >= low
        return value if valid else self._mismatch(key, f"a whole number from {low}")

    def number(self, key: str, default: Any = _REQUIRED, *, low: float = -math.inf) -> float:
        """A finite number above ``low``."""
        value = self.value(key, default)
        if is_number(value) and value > low:
            return float(value)
        return self._mismatch(key, "a number" if low == -math.inf else f"a number above {low:g}")

    def numbers(self, key: str, count: int | None = None, default: Any = _REQUIRED) -> Floats:
        """``count`` finite numbers (any number where None)."""
        value = self.value(key, default)
        if isinstance(value, np.ndarray):
            return value
        if isinstance(value, list) and len(value) in (len(value) if count is None else count,) and _all_numbers(value):
            return np.array(value, np.float64)
        return self._mismatch(key, f"a list of {'' if count is None else f'{count} '}numbers")

    def section(self, key: str) -> Section:
        """A nested mapping."""
        value = self.value(key)
        return value if isinstance(value, Section) else self._mismatch(key, "a mapping of keys to values")

    def items(self, key: str) -> list[Any]:
        """A list; empty where the key is missing."""
        value = self.value(key, [])
        return value if isinstance(value, list) else self._mismatch(key, "a list")

    def texts(self, key: str) -> list[str]:
        """A list of strings; empty where the key is missing."""
        values = self.items(key)
        return values if all(isinstance(value, str) for value in values) else self._mismatch(key, "a list of texts")

    def sections(self, key: str) -> Iterator[Section]:
        """A list of mappings; empty where the key is missing."""
        for item in self.items(key):
            yield item if isinstance(item, Section) else self._mismatch(key, "a list of mappings")

    def _mismatch(self, key: str, wanted: str) -> NoReturn:
        value = self.values.get(key)
        shown = "a mapping" if isinstance(value, Section) else repr(value)
        self.refuse(f"{shown} is not {wanted}", key)


def is_number(value: Any) -> bool:
    """A finite number, not true or false."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _all_numbers(values: list[Any]) -> bool:
    return all(is_number(value) for value in values)


def read_section(file: Path) -> Section:
    """The file's outermost mapping.

    Raises:
        Refused: the file is missing, is not YAML or JSON, or is not a mapping.
    """
    try:
        node = yaml.compose(file.read_text(encoding="utf-8"), Loader=_Loader)
    except (OSError, UnicodeDecodeError) as error:
        raise Refused(f"{file}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise Refused(f"{file}{line}: not valid YAML: {getattr(error, 'problem', error)}") from error
    if not isinstance(node, yaml.MappingNode):
        raise Refused(f"{file}: a mapping of keys to values is expected")
    return _convert(node, file, "")


def _convert(node: yaml.Node, file: Path, path: str) -> Any:
    if isinstance(node, yaml.MappingNode):
        return _mapping(node, file, path)
    if isinstance(node, yaml.SequenceNode):
        return [_convert(item, file, f"{path}[{index}]") for index, item in enumerate(node.value)]
    try:
        return yaml.SafeLoader("").construct_object(node)
    except (ValueError, yaml.YAMLError) as error:
        why = getattr(error, "problem", None) or error
        place = f"{file}:{node.start_mark.line + 1}: {path}"
        raise Refused(f"{place}: '{node.value}' is no value, {why}; in quotes it is a text") from error


def _mapping(node: yaml.MappingNode, file: Path, path: str) -> Section:
    line = node.start_mark.line + 1
    section = Section(file, line, path, {}, {})
    for key_node, value_node in node.value:
        key = str(key_node.value)
        if key in section.values:
            raise Refused(f"{file}:{key_node.start_mark.line + 1}: {path}: the key '{key}' stands there twice")
        section.lines[key] = key_node.start_mark.line + 1
        section.values[key] = _convert(value_node, file, f"{path}.{key}" if path else key)
    return section
