"""Reads a graph file and checks every key, setting, class and edge, before anything starts."""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING as NONE
from dataclasses import fields, is_dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from runner.contract import Part, Refused, Stage
from runner.graph.document import Document, Keys, read_document, suggest
from runner.graph.graph import (
    SUPERVISOR,
    ClassName,
    Edge,
    Graph,
    GraphKeys,
    Limits,
    Node,
    command_port,
    keys_of,
)
from runner.graph.packaged import locate
from runner.graph.placement import check_listen, read_layout
from runner.graph.ports import InputPort, StageType, inspect_stage, port_name, refuse_construction, refuse_shared
from runner.graph.references import load_class, load_migrations, load_tolerances

T = TypeVar("T")
K = TypeVar("K")
MISSING = "???"
"""Stands in a graph file where the user must give a value with ``--set``."""
REFERENCE = re.compile(r"\$\{([^}]*)\}")
"""Stands there for the value of another setting: ``${stage.key}``."""
RESERVED = (SUPERVISOR, "recorder", "viewer", "gateway", "journal", "log", "lost")
"""Names that no stage may have: other processes, and topics of recordings."""
RESTARTS = 3
"""Restarts of one process before the graph ends. None for devices: what they drive has moved on meanwhile."""


class StageEntry(Limits, frozen=True, kw_only=True):
    """One stage of the graph."""

    stage: ClassName
    config: Annotated[dict[str, Any], Meta(description="Settings of the stage, as its Config declares them")] = {}  # noqa: RUF012  msgspec copies it
    inputs: Annotated[dict[str, str | Edge], Meta(description="Input port -> stage.port")] = {}  # noqa: RUF012
    replicas: Annotated[
        Annotated[int, Meta(ge=1)] | Literal["auto"],
        Meta(description="Processes that share the parts; auto: one a core"),
    ] = 1
    restarts: Annotated[
        Annotated[int, Meta(ge=0)] | None, Meta(description="Crashes of a process before the graph ends")
    ] = None
    host: Annotated[
        str | dict[str, Annotated[int, Meta(ge=1)]] | None,
        Meta(description="Where it runs, or how many replicas run on which host; without it on the first host"),
    ] = None


class GraphEntry(GraphKeys, frozen=True, kw_only=True):
    """A graph of stages: what runs, with which settings, and what flows where."""

    stages: dict[str, StageEntry]
    hosts: Annotated[
        dict[str, str] | None, Meta(description="Machine -> ADDRESS[:PORT]; the first is the head and needs a port")
    ] = None
    keys: Annotated[str | None, Meta(description="Folder that `runner keys init` made; turns TLS on")] = None
    router: Annotated[
        str | None, Meta(description="Where all processes meet: the head's name, or ADDRESS:PORT of another router")
    ] = None


def load_graph(path: Path, assignments: tuple[str, ...] = ()) -> Graph:
    """Reads and checks a graph file with its ``--set`` assignments; raises Refused with one line a mistake."""
    document = read_document(path)
    for assignment in assignments:
        document.set(assignment)
    graph = _build(document)
    load_tolerances(graph.tolerances, document.place("tolerances"))
    load_migrations(graph.migrations, document.place("migrations"))
    return graph


def node_from_entry(name: str, entry: dict[str, Any]) -> Node:
    """Reads back what :func:`node_entry` wrote, without the rest of the graph and so without importing it."""
    document = Document(name, Path.cwd(), {"stages": {name: _stated(entry)}})
    read = _read_entry(document, name)
    kind = _load(document, name, read)
    _absolute_paths(document, {name: read}, {name: kind})
    return _node(document, name, read, kind)


def graph_from_json(text: str, label: str = "graph") -> Graph:
    """Reads back what :func:`graph_to_json` wrote, for this machine alone; ``label`` names it in errors."""
    values = {key: value for key, value in json.loads(text).items() if key not in ("hosts", "keys", "router", "listen")}
    if isinstance(values.get("stages"), dict):
        values["stages"] = {name: _stated(entry) for name, entry in values["stages"].items()}
    return _build(Document(label, Path.cwd(), values))


def _stated(entry: Any) -> Any:
    """What a graph file states of a stage, without what its class says (``commands``, ``shares``) and without its
    host: what is read back runs where it is read."""
    left_out = ("host", "commands", "shares")
    return {key: value for key, value in entry.items() if key not in left_out} if isinstance(entry, dict) else entry


def _build(document: Document) -> Graph:
    """Checks a document step by step; each step reports all of its mistakes at once."""
    keys = keys_of(_read(GraphEntry, {**document.values, "stages": {}}, document, ()))
    raw = document.values.get("stages")
    if not isinstance(raw, dict) or not raw:
        raise Refused(f"{document.place('stages')}: expected a mapping of stage names to stages")
    names = list[str](raw)
    entries = _collect(lambda name: _read_entry(document, name), names)
    types = _collect(lambda name: _load(document, name, entries[name]), names)
    _resolve_settings(document, entries, types)
    nodes = _collect(lambda name: _node(document, name, entries[name], types[name]), names)
    commands = ((command_port(name, port), f"{name}.{port}") for name in names for port in types[name].commands)
    refuse_shared(f"{document.place('stages')}: commands", commands)
    layout = read_layout(document)
    check_listen(document, layout)
    graph = Graph(**keys, nodes=nodes, layout=layout)
    inputs = [(name, port) for name in names for port in nodes[name].inputs]
    _collect(lambda edge: _check_edge(document, graph, *edge), inputs)
    return graph


def _collect(check: Callable[[K], T], items: Iterable[K]) -> dict[K, T]:
    """What a check makes of every item; raises all refusals together, one line each."""
    results: dict[K, T] = {}
    problems: list[str] = []
    for item in items:
        try:
            results[item] = check(item)
        except Refused as refusal:
            problems.append(str(refusal))
    if problems:
        raise Refused("\n".join(dict.fromkeys(problems)))
    return results


def _read(kind: type[T], values: Any, document: Document, keys: Keys) -> T:
    """Converts a mapping of the file to a struct or dataclass, naming the key that does not fit."""
    if not isinstance(values, dict):
        raise Refused(f"{document.place(*keys)}: expected a mapping, got {values!r}")
    known = {field.encode_name for field in msgspec.inspect.type_info(kind).fields}  # type: ignore[union-attr]
    for key in values:
        if key not in known:
            raise Refused(f"{document.place(*keys, key)}: unknown key {key!r}{suggest(key, known)}")
    try:
        return msgspec.convert(_completed(kind, values, document, keys), kind, dec_hook=_from_yaml)
    except Refused as refusal:
        raise Refused(f"{document.place(*keys)}: {refusal}") from None
    except msgspec.ValidationError as error:
        reason, _, inner = str(error).partition(" - at `$")
        names = re.findall(r"\w+", inner)
        raise Refused(
            f"{document.place(*keys, *names)}: {_reason(reason, values, names)}{_valid(kind, names)}"
        ) from None


def _completed(kind: Any, values: dict[str, Any], document: Document, keys: Keys) -> dict[str, Any]:
    """The settings, those in a group that has a default of its own with the rest of that default.

    msgspec ignores keys that a dataclass does not have: those of the settings are checked, and here those of a group.
    """
    if not is_dataclass(kind):
        return values
    completed = dict(values)
    for one in fields(kind):
        given, default = values.get(one.name), None if one.default_factory is NONE else one.default_factory()
        if isinstance(given, dict) and is_dataclass(default):
            rest = {part.name: getattr(default, part.name) for part in fields(default)}
            for key in given:
                if key not in rest:
                    place = document.place(*keys, one.name, key)
                    raise Refused(f"{place}: unknown key {key!r}{suggest(key, rest)}")
            completed[one.name] = rest | given
    return completed


def _reason(reason: str, value: Any, names: Iterable[str]) -> str:
    """What msgspec says of the value at a place, with the value itself."""
    for name in names:
        value = value[int(name)] if isinstance(value, list) else value[name]
    if " matching regex " in reason:
        return f"{value!r} does not fit"
    return f"{reason.partition(', got')[0]}, got {value!r}" if reason.startswith("Expected") else reason


def _valid(hint: Any, names: Iterable[str]) -> str:
    """``; valid: a, b`` where what is at a place takes one of a few words, and what the graph's keys say of it."""
    for name in names:
        hint = get_type_hints(hint, include_extras=True).get(name, hint) if isinstance(hint, type) else hint
    parts = list(_flat(hint))
    words = [str(word) for part in parts if get_origin(part) is Literal for word in get_args(part)]
    words += ["a number"] if words and (int in parts or float in parts) else []
    about = next((part.description for part in parts if isinstance(part, Meta) and part.description), None)
    valid = f"; valid: {', '.join(words)}" if words else ""
    return f"{valid} ({about})" if about else valid


def _flat(hint: Any) -> Iterator[Any]:
    yield hint
    if get_origin(hint) is not Literal:
        for argument in get_args(hint):
            yield from _flat(argument)


def _from_yaml(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"expected {kind.__name__}, got {value!r}")


def _read_entry(document: Document, name: str) -> StageEntry:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or name in RESERVED:
        raise Refused(
            f"{document.place('stages', name)}: a stage's name is lower case letters, digits and _, "
            f"and none of {', '.join(RESERVED)}"
        )
    keys = ("stages", name)
    values = document.values["stages"][name]
    inputs = values.get("inputs") if isinstance(values, dict) else None
    if not isinstance(inputs, dict):
        return _read(StageEntry, values, document, keys)
    entry = _read(StageEntry, {**values, "inputs": {}}, document, keys)
    edges = {port: _read_edge(document, (*keys, "inputs", port), edge) for port, edge in inputs.items()}
    return msgspec.structs.replace(entry, inputs=edges)


def _read_edge(document: Document, keys: Keys, value: Any) -> Edge:
    edge = Edge(value) if isinstance(value, str) else _read(Edge, value, document, keys)
    if edge.source.count(".") != 1:
        raise Refused(f"{document.place(*keys)}: {edge.source!r} is not of the form stage.port")
    return edge


def _load(document: Document, name: str, entry: StageEntry) -> StageType:
    place = document.place("stages", name, "stage")
    cls = load_class(entry.stage, place)
    if not (isinstance(cls, type) and issubclass(cls, Stage)):
        raise Refused(f"{place}: {entry.stage} is not a Stage")
    try:
        kind = inspect_stage(cls)
        refuse_construction(kind)
    except Refused as refusal:
        raise Refused(f"{place}: {refusal}") from None
    return kind


# ---------------------------------------------------------------------------------------------- settings


def _resolve_settings(document: Document, entries: Mapping[str, StageEntry], types: Mapping[str, StageType]) -> None:
    """Makes paths absolute, fills ``${stage.key}`` in and refuses what is still missing."""
    _absolute_paths(document, entries, types)
    settings = [(name, key) for name, entry in entries.items() for key in entry.config]
    defaults = {keys: value for name, kind in types.items() for keys, value in _defaults(name, kind.config)}
    _collect(lambda keys: _fill_in(document, entries, defaults, keys), settings)
    _absolute_paths(document, entries, types)


def _absolute_paths(document: Document, entries: Mapping[str, StageEntry], types: Mapping[str, StageType]) -> None:
    for name, entry in entries.items():
        paths = _path_settings(types[name].config)
        for key, value in entry.config.items():
            if key in paths and isinstance(value, str) and "${" not in value and value != MISSING:
                folder = document.folder_of("stages", name, "config", key)
                entry.config[key] = str(locate(Path(value).expanduser(), folder))


def _path_settings(config: type[Any] | None) -> set[str]:
    hints = get_type_hints(config) if config else {}
    return {name for name, hint in hints.items() if hint is Path or Path in get_args(hint)}


def _defaults(stage: str, config: type[Any] | None) -> Iterator[tuple[str, Any]]:
    """The values, by ``stage.key``, of settings that need not be written; those of groups too."""
    for one in fields(config) if config else ():
        value = one.default if one.default_factory is NONE else one.default_factory()
        if value is not NONE:
            values = {one.name: msgspec.to_builtins(value, enc_hook=str)}
            for keys in _within(values, stage):
                yield ".".join(map(str, keys)), reduce(getitem, keys[1:], values)


def _fill_in(document: Document, entries: Mapping[str, StageEntry], defaults: Mapping[str, Any], *chain: Keys) -> Any:
    """Puts what a setting refers to in its place, and the same there first; ``chain`` leads from one to the next.

    A group of settings is filled in key by key.
    """
    name, *groups, key = chain[-1]
    values: Any = entries[name].config
    for group in groups:
        values = values[group]
    value = values[key]
    if isinstance(value, dict):
        for inner in value:
            _fill_in(document, entries, defaults, *chain, (*chain[-1], inner))
        return value
    place = document.place("stages", name, "config", *map(str, (*groups, key)))
    if value == MISSING:
        raise Refused(f"{place}: has no value yet; give it with --set {'.'.join(map(str, chain[-1]))}=...")

    def setting(match: re.Match[str]) -> Any:
        settings = (keys for name, entry in entries.items() for keys in _within(entry.config, name))
        valid = {".".join(map(str, keys)): keys for keys in settings}
        target = valid.get(match[1])
        if target in chain:
            way = " -> ".join(".".join(map(str, keys)) for keys in (*chain[chain.index(target) :], target))
            raise Refused(f"{place}: {match[0]} refers to itself: {way}")
        if target is not None:
            return _fill_in(document, entries, defaults, *chain, target)
        if match[1] not in defaults:
            raise Refused(f"{place}: no setting {match[1]!r} to fill in{suggest(match[1], {*valid, *defaults})}")
        return defaults[match[1]]

    if isinstance(value, str):
        whole = re.fullmatch(REFERENCE, value)
        values[key] = value = setting(whole) if whole else re.sub(REFERENCE, lambda match: str(setting(match)), value)
    return value


def _within(values: dict[str, Any], *keys: str) -> Iterator[Keys]:
    """Where each setting stands, those of groups too."""
    for key, value in values.items():
        yield (*keys, key)
        if isinstance(value, dict):
            yield from _within(value, *keys, key)


def _node(document: Document, name: str, entry: StageEntry, kind: StageType) -> Node:
    keys = ("stages", name)
    if entry.config and kind.config is None:
        raise Refused(f"{document.place(*keys, 'config')}: {entry.stage} has no settings")
    config = _read(kind.config, entry.config, document, (*keys, "config")) if kind.config else None
    placement = _placement(document, name, entry)
    replicas = len(os.sched_getaffinity(0)) if entry.replicas == "auto" else max(entry.replicas, len(placement))
    if reason := (entry.replicas != 1 or replicas != 1) and _why_single(kind):
        place = document.place(*keys, "replicas" if entry.replicas != 1 else "host")
        raise Refused(f"{place}: {entry.stage} {reason}; valid: 1")
    restarts = entry.restarts if entry.restarts is not None else 0 if kind.cls.device else RESTARTS
    edges = _edges(document, name, entry, kind)
    limits = msgspec.convert(entry, Limits, from_attributes=True)
    return Node(name, entry.stage, kind, config, edges, replicas, restarts, limits, placement)


def _why_single(kind: StageType) -> str:
    """Why a stage cannot have replicas; empty where it can.

    They share parts, and what answers a part has the part's number, whoever worked: so what a port sends must all
    answer parts of one port.
    """
    if kind.cls.stateful:
        return "is stateful: replicas would remember different things"
    handlers = (*kind.handlers, *([kind.source] if kind.source else []))
    if not any(issubclass(port.type, Part) and port.kind == "one" for port in kind.inputs.values()):
        return "takes no Part, which is what replicas share"
    emitters: dict[str, str] = {}
    for handler in handlers:
        for port in handler.inputs:
            if port.kind == "gather":
                return f"gathers {port.name}, and no replica would get all of them"
        for output in map(port_name, handler.outputs):
            if not handler.inputs:
                return f"emits {output} in {handler.name}, and each replica would send its own"
            if (other := emitters.setdefault(output, handler.name)) != handler.name:
                return f"emits {output} in {other} and in {handler.name}, and both answers would have one number"
    return ""


def _placement(document: Document, name: str, entry: StageEntry) -> tuple[str, ...]:
    """The host of each replica, which a count by host or ``replicas`` says, and where both do they agree."""
    counts = {entry.host: 1} if isinstance(entry.host, str) else entry.host or {}
    hosts = document.values.get("hosts") or {}
    for host in counts:
        if host not in hosts:
            raise Refused(f"{document.place('stages', name, 'host')}: no host {host!r}{suggest(host, hosts)}")
    stated = "replicas" in document.values["stages"][name]
    if counts and stated and entry.replicas == "auto":
        place = document.place("stages", name, "replicas")
        raise Refused(f"{place}: the cores of {next(iter(counts))} are not known here; valid: a number")
    if isinstance(entry.host, str):
        return (entry.host,) * cast("int", entry.replicas)
    placement = tuple(host for host, count in counts.items() for _ in range(count))
    if placement and stated and entry.replicas != len(placement):
        place = document.place("stages", name, "replicas")
        raise Refused(f"{place}: {entry.replicas}, but host places {len(placement)}; valid: either of them alone")
    return placement


# ---------------------------------------------------------------------------------------------- edges


def _edges(document: Document, name: str, entry: StageEntry, kind: StageType) -> dict[str, Edge]:
    keys = ("stages", name, "inputs")
    wired = [port for port in kind.inputs if port not in kind.commands]
    for port in entry.inputs:
        if port not in kind.inputs:
            raise Refused(f"{document.place(*keys, port)}: {entry.stage} has no input {port!r}{suggest(port, wired)}")
        if port in kind.commands:
            raise Refused(f"{document.place(*keys, port)}: a command is not connected: runner call {name} {port}")
    missing = [port for port in wired if port not in entry.inputs]
    if missing:
        wanted = ", ".join(f"{port} ({kind.inputs[port].type.__name__})" for port in missing)
        raise Refused(f"{document.place(*keys)}: not connected: {wanted}")
    commands = {port: Edge(f"{SUPERVISOR}.{command_port(name, port)}") for port in kind.commands}
    return {**cast("dict[str, Edge]", entry.inputs), **commands}


def _check_edge(document: Document, graph: Graph, name: str, port: str) -> None:
    """Refuses an edge from nowhere and one whose ends differ in type."""
    place = document.place("stages", name, "inputs", port)
    edge, wanted = graph.nodes[name].inputs[port], graph.nodes[name].type.inputs[port]
    if edge.stage != SUPERVISOR and edge.stage not in graph.nodes:
        raise Refused(f"{place}: no stage {edge.stage!r}{suggest(edge.stage, graph.nodes)}")
    if edge.stage == name:
        raise Refused(f"{place}: {name} cannot be its own input: with its queue full it would wait for itself")
    outputs = graph.outputs_of(edge.stage)
    given = outputs.get(edge.port)
    if given is None:
        raise Refused(f"{place}: {edge.stage} has no output {edge.port!r}{suggest(edge.port, outputs)}")
    if given is not wanted.type:
        outputs = ((node.name, *output) for node in graph.nodes.values() for output in node.type.outputs.items())
        fitting = ", ".join(f"{stage}.{port}" for stage, port, kind in outputs if kind is wanted.type)
        raise Refused(
            f"{place}: expected {wanted.type.__name__}, but {edge.source} is {given.__name__}; "
            f"valid: {fitting or 'none in this graph'}"
        )
    reason = _needs_all(graph.nodes[name], wanted)
    if edge.policy == "latest" and reason:
        place = document.place("stages", name, "inputs", port, "policy")
        raise Refused(f"{place}: latest leaves messages out, but {reason}; valid: block")


def _needs_all(node: Node, port: InputPort) -> str:
    """Why a stage would wait for ever for what is left out on a port; empty where each message is taken by itself."""
    handler = node.type.takers[port.name]
    others = ", ".join(other.name for other in handler.inputs if other != port)
    if port.kind == "gather":
        return f"{port.name} gathers every part of a lineage"
    if others:
        return f"{handler.name} joins {port.name} with {others} of the same lineage"
    answers = node.replicated or any(issubclass(kind, Part) for kind in node.type.outputs.values())
    return f"{port.name} takes parts, and each is to be answered" if issubclass(port.type, Part) and answers else ""


def graph_schema() -> dict[str, Any]:
    """JSON Schema of graph files, for editors."""
    schema = msgspec.json.schema(GraphEntry)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Graph of stages", **schema}
