"""ROS 2 interfaces: definitions, RIHS01 hashes, and messages to and from CDR bytes.

Definitions are those of rosbags and of ``interfaces.yaml``. What ROS 2 derives from a service or an action
(https://design.ros2.org/articles/actions.html) is derived here in the same way, so that hashes agree with those of
genuine nodes: REP 2011, https://www.ros.org/reps/rep-2011.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from runner.contract import Refused
from stages.devices.ros2.settings import DISTRIBUTIONS, Distribution

_INTERFACES = Path(__file__).with_name("interfaces.yaml")
_Fields = list[tuple[str, Any]]
"""(name, description as rosbags has it) of each field."""
_UUID = ("goal_id", (Nodetype.NAME, "unique_identifier_msgs/msg/UUID"))
_STAMP = ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time"))
_NOTHING = ("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))
_BYTES = ("byte", "char", "octet")


class Types:
    """All interfaces of one distribution; names are ``package/msg/Name``, or with ``srv`` or ``action``."""

    def __init__(self, distribution: Distribution) -> None:
        self.distribution = distribution
        self._store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        texts = yaml.safe_load(_INTERFACES.read_text())
        self._store.register(dict(_definitions({**texts["all"], **texts[distribution]})))
        definitions: dict[str, Any] = self._store.fielddefs
        for name, (constants, fields) in list(definitions.items()):
            definitions[name] = constants, [(field, _hashable(kind)) for field, kind in fields]

    @classmethod
    @cache
    def of(cls, distribution: Distribution) -> Types:
        """The interfaces of a distribution, read once."""
        return cls(distribution)

    def __contains__(self, name: str) -> bool:
        return name in self._store.fielddefs

    def hash(self, name: str) -> str:
        """``RIHS01_`` and 64 hexadecimal digits; raises Refused where the name is not known."""
        if name not in self:
            raise Refused(f"{name}: no such ROS 2 interface here; it would have to be in {_INTERFACES}")
        return self._store.hash_rihs01(name)

    def definition(self, name: str) -> str:
        """The definition as bags keep it: its text and that of all it is made of."""
        return self._store.generate_msgdef(name, ros_version=2)[0]

    def new(self, name: str, /, **fields: Any) -> Any:
        """A message; fields that are not given are zero, nested ones may be given as dicts, arrays as sequences."""
        definition = self._store.get_msgdef(name)
        values = {field: self._value(kind, fields.pop(field, None)) for field, kind in definition.fields}
        return definition.cls(**values, **fields)

    def encode(self, message: Any) -> bytes:
        """Four bytes that say little-endian XCDR1, then the message."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def decode(self, data: bytes, name: str) -> Any:
        """The message; arrays are views of ``data``. Bytes that follow it, as some serialisers write, are ignored.

        Raises:
            ValueError: the bytes are no such message.
        """
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError(f"{name}: begins with {data[:4].hex()}; XCDR1 begins with 00 00 or 00 01")
        definition = self._store.get_msgdef(name)
        read: Any = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
        try:
            return read(memoryview(data)[4:], 0, definition.cls, self._store)[0]
        except (SerdeError, struct.error, ValueError, IndexError) as error:
            raise ValueError(f"{name}: its {len(data)} bytes cannot be read: {error}") from None

    def _value(self, kind: Any, value: Any) -> Any:
        """What a field holds for what was given; zero for None."""
        node, inner = kind
        if node is Nodetype.BASE:
            zero = {"string": "", "wstring": "", "bool": False}.get(inner[0], 0)
            return zero if value is None else value
        if node is Nodetype.NAME:
            return self.new(inner, **(value or {})) if value is None or isinstance(value, Mapping) else value
        (element, element_kind), size = inner
        values = [] if value is None else value
        if element is Nodetype.BASE and element_kind[0] not in ("string", "wstring"):
            dtype = np.dtype(np.uint8 if element_kind[0] in _BYTES else element_kind[0])
            fixed = size if node is Nodetype.ARRAY else 0
            return np.asarray(values, dtype) if value is not None else np.zeros(fixed, dtype)
        return [self._value((element, element_kind), one) for one in values]


def _hashable(kind: Any) -> Any:
    """``char`` is hashed as what it is, an uint8."""
    node, inner = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return node, (_hashable(inner[0]), inner[1])
    return (node, ("uint8", 0)) if node is Nodetype.BASE and inner[0] == "char" else kind


def _definitions(texts: Mapping[str, str]) -> Iterator[tuple[str, Any]]:
    """(name, definition as rosbags has it) of every interface and of all that it brings with it."""
    for name, text in texts.items():
        package, kind, _ = name.split("/")
        sections = [_parsed(package, section) for section in f"\n{text}".split("\n---\n")]
        if kind == "msg":
            yield name, sections[0]
        elif kind == "srv":
            yield from _service(name, *sections)
        else:
            yield from _action(name, *sections)


def _parsed(package: str, text: str) -> tuple[Any, _Fields]:
    ((constants, fields),) = get_types_from_msg(text, f"{package}/msg/Section").values()
    return constants, fields or [_NOTHING]


def _service(name: str, request: Any, response: Any) -> Iterator[tuple[str, Any]]:
    yield f"{name}_Request", request
    yield f"{name}_Response", response
    event = [
        ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")),
        *((part.lower(), (Nodetype.SEQUENCE, (_named(f"{name}_{part}"), 1))) for part in ("Request", "Response")),
    ]
    yield f"{name}_Event", ([], event)
    parts = ("Request", "Response", "Event")
    yield name, ([], [(f"{part.lower()}_message", _named(f"{name}_{part}")) for part in parts])


def _action(name: str, goal: Any, result: Any, feedback: Any) -> Iterator[tuple[str, Any]]:
    yield f"{name}_Goal", goal
    yield f"{name}_Result", result
    yield f"{name}_Feedback", feedback
    yield f"{name}_FeedbackMessage", ([], [_UUID, ("feedback", _named(f"{name}_Feedback"))])
    accepted = ("accepted", (Nodetype.BASE, ("bool", 0)))
    status = ("status", (Nodetype.BASE, ("int8", 0)))
    yield from _service(f"{name}_SendGoal", _made(_UUID, ("goal", _named(f"{name}_Goal"))), _made(accepted, _STAMP))
    yield from _service(f"{name}_GetResult", _made(_UUID), _made(status, ("result", _named(f"{name}_Result"))))
    parts = {"goal": "Goal", "result": "Result", "feedback": "Feedback", "send_goal_service": "SendGoal"}
    parts |= {"get_result_service": "GetResult", "feedback_message": "FeedbackMessage"}
    yield name, ([], [(field, _named(f"{name}_{part}")) for field, part in parts.items()])


def _named(name: str) -> Any:
    return Nodetype.NAME, name


def _made(*fields: Any) -> tuple[Any, _Fields]:
    return [], list(fields)


def matching(name: str, hash: str) -> list[Distribution]:
    """Distributions whose interface of that name has that hash."""
    return [one for one in DISTRIBUTIONS if name in Types.of(one) and Types.of(one).hash(name) == hash]
