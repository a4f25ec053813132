"""Commands called from outside: checks them, publishes them, and follows each until the stage has done it."""

from __future__ import annotations

import ast
import inspect
import itertools
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum, EnumType
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin

import msgspec

from runner.contract import Command, Level, Refused
from runner.graph.document import read_yaml, suggest
from runner.graph.graph import Graph, Node, command_port
from runner.graph.ports import port_name
from runner.message.codec import CodecError, LogLine, Step, array_of, shown, spec_of
from runner.message.ids import MessageId, Recent

KEPT = 100
"""Calls that may still be asked about."""
PATIENCE_SECONDS = 5.0
"""How long a question about a call waits for news."""


class Field(msgspec.Struct, frozen=True):
    """One field of a command."""

    name: str
    type: str
    default: str | None
    """None where a value must be given."""
    text: str


class CommandType(msgspec.Struct, frozen=True):
    """What a stage can be asked."""

    stage: str
    name: str
    text: str
    fields: tuple[Field, ...]
    answers: tuple[str, ...]
    """Output ports whose next message ends the call."""


class CallRequest(msgspec.Struct, frozen=True):
    """One call as it was typed."""

    stage: str
    command: str
    arguments: dict[str, str]


class CallQuestion(msgspec.Struct, frozen=True):
    """Asks how a call goes, beyond the first ``since`` log lines."""

    id: str
    since: int


class Progress(msgspec.Struct, frozen=True):
    """How a call goes."""

    lines: tuple[tuple[Level, str], ...]
    """New log lines of the stage."""
    done: bool
    refused: str = ""
    """Why the stage would not do it."""
    emitted: tuple[str, ...] = ()
    """Ids of what the step emitted."""
    answer: bytes = b""
    """The envelope of the answer, where the command has one."""


Publish = Callable[[str, Command, Callable[[str], None]], str]
"""Sends a command on an output port of the supervisor; returns its id, and says it before it sends."""


@dataclass(slots=True)
class _Call:
    stage: str
    answers: frozenset[str]
    """Output ports."""
    left: set[int]
    """Replicas that have not done it yet."""
    lines: list[tuple[Level, str]] = field(default_factory=list[tuple[Level, str]])
    step: Step | None = None
    """The step that did it; of replicas, the first."""
    answer: str = ""
    """Id of the message that ends it, once the step is known that emitted it."""
    payload: bytes = b""
    done: bool = False


class Calls:
    """All calls of one run. The supervisor tells it what it hears."""

    def __init__(self, graph: Graph, publish: Publish) -> None:
        self._graph = graph
        self._publish = publish
        self._calls = Recent[str, _Call](KEPT)
        self._answers = Recent[str, bytes](KEPT)
        self._changed = threading.Condition()
        self._closed = False

    @property
    def answer_keys(self) -> list[str]:
        """``STAGE/PORT`` of everything that answers a command."""
        return sorted({f"{kind.stage}/{answer}" for kind in self.types() for answer in kind.answers})

    def types(self) -> list[CommandType]:
        """Every command of the graph."""
        return [
            _command_type(node, name, kind)
            for node in self._graph.nodes.values()
            for name, kind in node.type.commands.items()
        ]

    def call(self, request: CallRequest) -> str:
        """Publishes a command and returns its id; raises Refused naming the valid ones where it breaks its type."""
        kind = _find(self._graph, request)
        command = read_command(f"{request.stage} {request.command}", kind, request.arguments)
        replicas = set(range(self._graph.nodes[request.stage].replicas))
        call = _Call(request.stage, frozenset(map(port_name, kind.answers)), replicas)
        port = command_port(request.stage, request.command)
        try:
            return self._publish(port, command, lambda id: self._remember(id, call))
        except CodecError as error:  # what no message can hold, as an integer of 100 digits
            raise Refused(f"{request.stage} {request.command}: {error}") from None

    def progress(self, question: CallQuestion) -> Progress:
        """Waits for news of a call, but not for long."""
        with self._changed:
            call = self._calls.get(question.id)
            if call is None:
                raise Refused(f"{question.id}: no such call; the newest {KEPT} are remembered")
            self._changed.wait_for(
                lambda: self._closed or call.done or len(call.lines) > question.since, PATIENCE_SECONDS
            )
            lines = tuple(call.lines[question.since :])
            if self._closed and not (call.done or lines):
                raise Refused("the graph ended before it was done")
            error, emitted = (call.step.error, call.step.emitted) if call.step else ("", ())
            return Progress(lines, call.done, error.removeprefix("Refused: "), emitted, call.payload)

    def note_log(self, line: LogLine) -> None:
        """Takes a log line; it belongs to every call of its stage that is under way."""
        with self._changed:
            for call in self._calls.values():
                if call.stage == line.stage and not call.done and line.level != "debug":
                    call.lines.append((line.level, line.text))
            self._changed.notify_all()

    def note_answer(self, id: str, payload: bytes) -> None:
        """Takes a message that may answer a call, before or after the step that emitted it."""
        with self._changed:
            self._answers[id] = payload
            for call in self._calls.values():
                if call.answer == id:
                    self._conclude(call)
            self._changed.notify_all()

    def note_step(self, step: Step) -> None:
        """Takes a step: the one of a command, or a later one that answers it; one that failed is taken again."""
        with self._changed:
            consumed = {id for _, id in step.consumed}
            for id, call in self._calls.items():
                if call.stage == step.stage and not call.done:
                    if step.outcome == "done":
                        self._advance(id in consumed, call, step)
                    elif step.outcome == "failed" and id in consumed:
                        call.lines.append(("error", step.error))
            self._changed.notify_all()

    def close(self) -> None:
        """Lets everybody who waits know that the graph ends."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _remember(self, id: str, call: _Call) -> None:
        with self._changed:
            self._calls[id] = call

    def _advance(self, own: bool, call: _Call, step: Step) -> None:
        if own:
            call.step = call.step or step
            call.left.discard(step.replica)
        if call.step is None or call.left:
            return
        answers = (id for id in step.emitted if MessageId.of(id).port in call.answers)
        call.answer = call.answer or next(answers, "")
        self._conclude(call)

    def _conclude(self, call: _Call) -> None:
        call.payload = self._answers.get(call.answer, b"")
        call.done = not call.answers or bool(call.payload) or bool(call.step and call.step.error)


# ------------------------------------------------------------------------------------------ types of commands


def read_command(place: str, kind: type[Command], arguments: Mapping[str, str]) -> Command:
    """A command from the texts of its fields; raises Refused naming field, value and what is valid."""
    infos = {info.name: info for info in msgspec.structs.fields(kind)}
    for name in arguments:
        if name not in infos:
            raise Refused(f"{place}: no field {name!r}{suggest(name, infos)}")
    missing = [name for name, info in infos.items() if info.required and name not in arguments]
    if missing:
        raise Refused(f"{place}: needs {', '.join(f'{name}=...' for name in missing)}")
    return kind(**{name: _value(place, name, infos[name].type, text) for name, text in arguments.items()})


def _find(graph: Graph, request: CallRequest) -> type[Command]:
    node = graph.nodes.get(request.stage)
    if node is None:
        raise Refused(f"no stage {request.stage!r}{suggest(request.stage, graph.nodes)}")
    kind = node.type.commands.get(request.command)
    if kind is None:
        raise Refused(
            f"{request.stage} has no command {request.command!r}{suggest(request.command, node.type.commands)}"
        )
    return kind


def _value(place: str, name: str, kind: Any, text: str) -> Any:
    """The text itself where that fits the type, else what YAML makes of it."""
    specs = [spec for part in _flat(kind) if (spec := spec_of(part)) is not None]

    def array(_: type, value: Any) -> Any:
        if len(specs) != 1:  # inside a struct, or of several kinds
            raise ValueError("an array cannot be typed here")
        return array_of(value, specs[0])

    try:
        return msgspec.convert(text, kind, strict=False, dec_hook=array)
    except msgspec.ValidationError as error:
        reason = str(error)
    try:
        return msgspec.convert(read_yaml(text), kind, dec_hook=array)
    except msgspec.ValidationError as error:
        reason = str(error)
    except ValueError:  # nothing that YAML knows
        pass
    raise Refused(f"{place}: {name}={text}: {reason.partition(' - at `')[0]}; valid: {_spelled(kind)}")


def _flat(kind: Any) -> Iterator[Any]:
    yield kind
    if get_origin(kind) is not Literal:
        for argument in get_args(kind):
            yield from _flat(argument)


def _command_type(node: Node, name: str, kind: type[Command]) -> CommandType:
    texts = _field_texts(kind)
    fields = tuple(
        Field(info.name, _spelled(info.type), _default(info), texts.get(info.name, ""))
        for info in msgspec.structs.fields(kind)
    )
    text = inspect.cleandoc(kind.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
    return CommandType(node.name, name, text, fields, tuple(map(port_name, kind.answers)))


def _default(info: msgspec.structs.FieldInfo) -> str | None:
    if info.required:
        return None
    default = info.default if info.default_factory is msgspec.NODEFAULT else info.default_factory()
    return repr(default.value if isinstance(default, Enum) else default)


def _spelled(kind: Any) -> str:
    """A type as a person would say it: the words of a choice, what is inside a container, else its name."""
    origin, arguments = get_origin(kind), get_args(kind)
    if (spec := spec_of(kind)) is not None:
        return shown(spec)
    if origin is Annotated:
        return _spelled(arguments[0])
    if origin is Literal:
        return " | ".join(map(str, arguments))
    if origin in (Union, UnionType):
        return " | ".join(map(_spelled, arguments))
    if isinstance(kind, EnumType):
        return " | ".join(str(one.value) for one in cast("type[Enum]", kind))
    inside = ", ".join("..." if argument is ... else _spelled(argument) for argument in arguments)
    name = "None" if kind is NoneType else getattr(origin or kind, "__name__", str(kind))
    return f"{name}[{inside}]" if inside else name


def _field_texts(kind: type[Command]) -> dict[str, str]:
    """The string below each field of a class, which Python itself does not keep."""
    try:
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    except (OSError, SyntaxError, ValueError):
        return {}
    body = tree.body if isinstance(tree, ast.ClassDef) else []
    return {
        one.target.id: inspect.cleandoc(two.value.value)
        for one, two in itertools.pairwise(body)
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
        if isinstance(two, ast.Expr) and isinstance(two.value, ast.Constant) and isinstance(two.value.value, str)
    }
