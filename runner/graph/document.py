"""A graph file as it was written: values, the line of each, and what ``--set`` changed."""

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from runner.contract import Refused

OWN_KEYS = ("replicas", "restarts", "heartbeat", "timeout", "startup", "memory", "host")
"""Keys of a stage beside its settings that ``--set`` reaches."""
Keys = tuple[str, ...]
"""Where a value stands: ("stages", "camera", "config", "dataset")."""


@dataclass
class Document:
    """The tree of a graph file and where each of its values came from."""

    label: str
    """Names the file in errors."""
    folder: Path
    """Paths in the file are relative to it."""
    values: dict[str, Any]
    lines: dict[Keys, int] = field(default_factory=dict[Keys, int])
    overrides: dict[Keys, str] = field(default_factory=dict[Keys, str])
    """Values from the command line, with the ``--set`` key that gave each."""

    def place(self, *keys: str) -> str:
        """``graph.yaml:12: stages.camera.config`` or, for an override, ``--set camera.dataset``."""
        for length in range(len(keys), -1, -1):
            if keys[:length] in self.overrides:
                return f"--set {self.overrides[keys[:length]]}"
            if keys[:length] in self.lines:
                return f"{self.label}:{self.lines[keys[:length]]}: {'.'.join(keys) or 'graph'}"
        return f"{self.label}: {'.'.join(keys)}"

    def folder_of(self, *keys: str) -> Path:
        """What a relative path at ``keys`` is relative to: the file's folder, or the shell's for an override."""
        return Path.cwd() if keys in self.overrides else self.folder

    def set(self, assignment: str) -> None:
        """Applies ``stage.key=value`` (or ``seed=3``): a setting of a stage, its replicas, or a key of the graph."""
        key, equals, text = assignment.partition("=")
        if not equals:
            raise Refused(f"--set {assignment}: expected key=value, for example --set camera.dataset=DIR")
        try:
            value = _with_names(read_yaml(text))
        except (ValueError, RecursionError):
            value = text
        keys = self._keys_of(key)
        _nested(self.values, keys[:-1])[keys[-1]] = value
        self.overrides[keys] = key

    def _keys_of(self, key: str) -> Keys:
        stage, dot, setting = key.partition(".")
        if not dot:
            return (key,)
        found = self.values.get("stages")
        stages = found if isinstance(found, dict) else {}
        if stage == "hosts" and stage not in stages:
            return ("hosts", setting)
        if stage not in stages:
            raise Refused(f"--set {key}: no stage {stage!r}{suggest(stage, stages)}")
        if setting in OWN_KEYS:
            return ("stages", stage, setting)
        return ("stages", stage, "config", *setting.split("."))


class _Loader(yaml.SafeLoader):
    """Raises ValueError where a value is none of its type, or a text that cannot be written as UTF-8."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            value = super().construct_object(node, deep)
        except (LookupError, AttributeError):  # from within the library, of `!!bool x` and `!!timestamp x`
            raise ValueError(f"{node.value!r} is no {node.tag.rpartition(':')[2]}") from None
        if isinstance(value, str):
            value.encode()
        return value


# As YAML 1.2 has them, and everybody else: 1e-3, 1.5e3.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def read_yaml(text: str) -> Any:
    """What YAML makes of a text; raises ValueError where that is nothing."""
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(str(error)) from None


def read_document(path: Path) -> Document:
    """Reads a YAML graph file; raises Refused with file and line where it is not a mapping of unique keys."""
    document = Document(str(path), path.parent.absolute(), {})
    try:
        loader = _Loader(path.read_text())
        root = loader.get_single_node()
        if not isinstance(root, yaml.MappingNode):
            raise Refused(f"{path}:1: expected a mapping with name and stages")
        document.values = _read_node(loader, root, document, ())
    except OSError as error:
        raise Refused(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise Refused(f"{path}: is not a text file") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        raise Refused(f"{path}{line}: not YAML: {getattr(error, 'problem', None) or error}") from None
    except RecursionError:
        raise Refused(f"{path}: not YAML: a mapping contains itself") from None
    return document


def suggest(wrong: str, valid: Iterable[str]) -> str:
    """``; did you mean 'x'? valid: x, y`` to end an error with."""
    names = sorted(valid)
    close = difflib.get_close_matches(wrong, names, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} valid: {', '.join(names) or 'none'}"


def _read_node(loader: _Loader, node: yaml.Node, document: Document, keys: Keys) -> Any:
    document.lines.setdefault(keys, node.start_mark.line + 1)
    if not isinstance(node, yaml.MappingNode):
        return _construct(loader, node, document, keys)
    values: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = str(_construct(loader, key_node, document, keys))
        if key in values:
            line = key_node.start_mark.line + 1
            raise Refused(f"{document.label}:{line}: {'.'.join((*keys, key))}: this key appears twice")
        document.lines[(*keys, key)] = key_node.start_mark.line + 1
        values[key] = _read_node(loader, value_node, document, (*keys, key))
    return values


def _construct(loader: _Loader, node: yaml.Node, document: Document, keys: Keys) -> Any:
    try:
        return loader.construct_object(node, deep=True)
    except ValueError as error:  # a date or number that is none
        place = f"{document.label}:{node.start_mark.line + 1}: {'.'.join(keys) or 'graph'}"
        raise Refused(f"{place}: {error}") from None


def _with_names(value: Any) -> Any:
    """The same with texts as keys, as those of the file are."""
    return {str(key): _with_names(inner) for key, inner in value.items()} if isinstance(value, dict) else value


def _nested(values: dict[str, Any], keys: Keys) -> dict[str, Any]:
    """The mapping at ``keys``, made where it is missing."""
    for key in keys:
        inner = values.get(key)
        values[key] = values = inner if isinstance(inner, dict) else {}
    return values
