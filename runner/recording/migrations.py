"""What has become of messages since they were recorded: the one place where old recordings learn new names.

Fields that a message gains need no entry: they have defaults. A field that is renamed, retired or computed otherwise
raises the ``version`` of its message by one and gets an entry in :data:`MIGRATIONS`. Recordings keep their bytes; they
are brought up to date as they are read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import msgspec

from runner.message.codec import Envelope

Fields = dict[str, Any]
"""A message as msgpack maps: structs are maps too, arrays ``[dtype, shape, bytes]``."""


@dataclass(frozen=True, slots=True)
class Migration:
    """From one version of a message to the next."""

    renamed: Mapping[str, str] = field(default_factory=dict[str, str])
    """Old names of fields and their new ones; the fields of a struct inside as ``place.name``, also in lists."""
    retired: tuple[str, ...] = ()
    """Fields that are gone."""
    change: Callable[[Fields], Fields] | None = None
    """Anything else; gets the fields after they were renamed."""

    def apply(self, fields: Fields) -> Fields:
        """The fields of the next version, in their old order."""
        for path, name in self.renamed.items():
            fields = _edited(fields, path.split("."), name)
        for path in self.retired:
            fields = _edited(fields, path.split("."), None)
        return self.change(fields) if self.change else fields


MIGRATIONS: dict[tuple[str, int], Migration] = {}
"""By the class name of a message and the version that the entry leads away from."""


def migrated(sealed: Envelope) -> Envelope:
    """A recorded message as its class is today; itself where nothing has become of it."""
    if (sealed.type, sealed.version) not in MIGRATIONS:
        return sealed
    fields, version = cast("Fields", msgspec.msgpack.decode(sealed.body)), sealed.version
    while (migration := MIGRATIONS.get((sealed.type, version))) is not None:
        fields, version = migration.apply(fields), version + 1
    return msgspec.structs.replace(sealed, version=version, body=msgspec.Raw(msgspec.msgpack.encode(fields)))


def without_gained_fields(recorded: Envelope, replayed: Envelope) -> Envelope:
    """A replayed message without the fields that its class has gained since: of those the recording says nothing."""
    if recorded.type != replayed.type:
        return replayed
    old, new = msgspec.msgpack.decode(recorded.body), msgspec.msgpack.decode(replayed.body)
    return msgspec.structs.replace(replayed, body=msgspec.Raw(msgspec.msgpack.encode(_shared(old, new))))


def _edited(value: Any, path: list[str], name: str | None) -> Any:
    """A copy in which the field at the end of a path has another name, or is gone where that is None."""
    if isinstance(value, list):
        return [_edited(item, path, name) for item in cast("list[Any]", value)]
    if not isinstance(value, dict):
        return value
    fields = cast("Fields", value)
    if len(path) > 1:
        return {key: _edited(inner, path[1:], name) if key == path[0] else inner for key, inner in fields.items()}
    return {name if key == path[0] else key: inner for key, inner in fields.items() if key != path[0] or name}


def _shared(old: Any, new: Any) -> Any:
    """What is new, as far as it has the fields of what is old, and in their order."""
    if isinstance(old, dict) and isinstance(new, dict):
        fields = cast("Fields", new)
        return {key: _shared(inner, fields[key]) for key, inner in cast("Fields", old).items() if key in fields}
    if isinstance(old, list) and isinstance(new, list) and len(cast("list[Any]", old)) == len(cast("list[Any]", new)):
        return [_shared(*pair) for pair in zip(cast("list[Any]", old), cast("list[Any]", new), strict=True)]
    return new
