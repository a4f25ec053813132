"""Brings recorded messages up to date as they are read: what has become of them, a graph's table says.

Recordings keep their bytes. What a table holds: :class:`runner.contract.Migration`.
"""

import sys
from collections import ChainMap
from collections.abc import Mapping
from typing import Any

import msgspec

from runner.contract import Fields, Message, Migration, Migrations
from runner.graph.references import load_migrations, modules_of
from runner.message.codec import Envelope, decode

UNNAMED = "MIGRATIONS"
"""The tables of a graph that names none."""


def migrations_of(graph: Mapping[str, Any]) -> Migrations:
    """The table that a recorded graph names; raises Refused where it is none.

    Of a graph that names none, as all do that were recorded before graphs could, the tables called ``MIGRATIONS`` in
    the modules of its stages count, as far as those are imported: who reads messages as their classes has done so.
    """
    if (reference := graph.get("migrations")) is not None:
        return load_migrations(reference, f"migrations of graph {graph.get('name')!r}")
    modules = (sys.modules[name] for name in modules_of(graph) if name in sys.modules)
    return ChainMap(*(vars(module).get(UNNAMED, {}) for module in modules))


def migrated(sealed: Envelope, migrations: Migrations) -> Envelope:
    """A recorded message as its class is today; itself where nothing has become of it."""
    if (sealed.type, sealed.version) not in migrations:
        return sealed
    fields, version = msgspec.msgpack.decode(sealed.body), sealed.version
    while (migration := migrations.get((sealed.type, version))) is not None:
        fields, version = _next(fields, migration), version + 1
    return msgspec.structs.replace(sealed, version=version, body=msgspec.Raw(msgspec.msgpack.encode(fields)))


def _next(fields: Fields, migration: Migration) -> Fields:
    """The fields of the next version, in their old order."""
    for path, name in migration.renamed.items():
        fields = _edited(fields, path.split("."), name)
    for path in migration.retired:
        fields = _edited(fields, path.split("."), None)
    return migration.change(fields) if migration.change else fields


def without_gained_fields(recorded: Envelope, replayed: Envelope, kind: type[Message]) -> Envelope:
    """A replayed message without the fields that its class, ``kind``, and the structs inside have gained since: of
    those the recording says nothing."""
    if recorded.type != replayed.type:
        return replayed
    old, new = msgspec.msgpack.decode(recorded.body), msgspec.msgpack.decode(replayed.body)
    shared = _shared(old, new, decode(kind, replayed.body))
    return msgspec.structs.replace(replayed, body=msgspec.Raw(msgspec.msgpack.encode(shared)))


def _edited(value: Any, path: list[str], name: str | None) -> Any:
    """A copy in which the field at the end of a path has another name, or is gone where that is None."""
    if isinstance(value, list):
        return [_edited(item, path, name) for item in value]
    if not isinstance(value, dict):
        return value
    if len(path) > 1:
        return {key: _edited(inner, path[1:], name) if key == path[0] else inner for key, inner in value.items()}
    return {name if key == path[0] else key: inner for key, inner in value.items() if key != path[0] or name}


def _shared(old: Any, new: Any, value: Any) -> Any:
    """What is new, of structs the fields that what is old has, in their order. ``value`` is what is new with its types:
    they tell structs from dicts. Of a struct that leaves defaults out, what is old has had every field."""
    match value, old, new:
        case msgspec.Struct(), dict(), dict():
            shared = {key: _shared(old[key], new[key], getattr(value, key, None)) for key in old if key in new}
            return {**shared, **new, **shared} if value.__struct_config__.omit_defaults else shared
        case dict(), dict(), dict():
            pairs = zip(new.items(), value.values(), strict=True)
            return {key: _shared(old.get(key), inner, typed) for (key, inner), typed in pairs}
        case list() | tuple(), list(), list() if len(old) == len(new):
            return [_shared(*three) for three in zip(old, new, value, strict=True)]
        case _:
            return new
