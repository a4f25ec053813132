"""Reads a stage's handlers, ports and settings from its annotations."""

import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, is_dataclass
from functools import cache, cached_property
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from runner.contract import Command, Context, Message, Part, Refused, Stage, name_of
from runner.message.classes import refuse_class


@dataclass(frozen=True, slots=True)
class InputPort:
    """What one parameter of a handler takes: one message of a lineage, or all parts of it."""

    name: str
    type: type[Message]
    kind: Literal["one", "gather"]


@dataclass(frozen=True)
class Handler:
    """A method the runner calls: a join of its inputs, or a start without any."""

    name: str
    inputs: tuple[InputPort, ...]
    context: str | None
    """Name of the parameter that receives the step's context."""
    outputs: tuple[type[Message], ...]
    """What its result's annotation announces."""
    optional: bool
    """It may return None: its annotation says so."""

    @cached_property
    def is_command(self) -> bool:
        """True for what is called from outside the graph."""
        return any(issubclass(port.type, Command) for port in self.inputs)

    @cached_property
    def driver(self) -> InputPort | None:
        """The input whose message seeds the step's random numbers: the part of a join if any, else the first."""
        return next((port for port in self.inputs if issubclass(port.type, Part)), next(iter(self.inputs), None))

    def keeps(self, port: InputPort) -> bool:
        """True for what a join with a part uses again for every part of its lineage."""
        driver = self.driver
        return driver is not None and driver.kind == "one" and issubclass(driver.type, Part) and port != driver


@dataclass(frozen=True)
class StageType:
    """What the annotations of a stage class say."""

    cls: type[Stage]
    handlers: tuple[Handler, ...]
    """Everything named ``on_*``, in the order of definition."""
    source: Handler | None
    """``source``, which only devices have."""
    outputs: dict[str, type[Message]]
    config: type[Any] | None

    @cached_property
    def inputs(self) -> dict[str, InputPort]:
        """All input ports by name."""
        return {port.name: port for handler in self.handlers for port in handler.inputs}

    @cached_property
    def commands(self) -> dict[str, type[Command]]:
        """The input ports that ``runner call`` reaches, by name."""
        return {port.name: port.type for port in self.inputs.values() if issubclass(port.type, Command)}

    @cached_property
    def takers(self) -> dict[str, Handler]:
        """The handler that takes what arrives on a port, by its name."""
        return {port.name: handler for handler in self.handlers for port in handler.inputs}


def inspect_stage(cls: type[Stage]) -> StageType:
    """Reads a stage class; raises Refused naming class, method and parameter where it breaks the contract."""
    if cls.device and cls.stateful:
        raise Refused(f"{cls.__name__}: is a device and stateful; valid: one of both, for its past lies outside")
    handlers = tuple(_handler(cls, name) for name in _handler_names(cls))
    source = _handler(cls, "source") if hasattr(cls, "source") else None
    if source is not None and not cls.device:
        raise Refused(f"{cls.__name__}.source: only a stage marked `device = True` may be a source")
    if not handlers and source is None:
        raise Refused(f"{cls.__name__}: has no handlers; a handler is a method named on_*")
    refuse_shared(cls.__name__, ((port.name, handler.name) for handler in handlers for port in handler.inputs))
    emitted = [kind for handler in (*handlers, *([source] if source else [])) for kind in handler.outputs]
    refuse_shared(cls.__name__, ((port_name(kind), f"{kind.__module__}:{kind.__qualname__}") for kind in emitted))
    for kind in (*emitted, *(port.type for handler in handlers for port in handler.inputs)):
        if reason := _why_no_message(kind):
            raise Refused(f"{cls.__name__}: {reason}")
    outputs = {port_name(kind): kind for kind in emitted}
    return StageType(cls, handlers, source, outputs, _config_type(cls))


def refuse_construction(kind: StageType) -> None:
    """Raises Refused where a graph could not construct a stage, whatever its settings are."""
    cls = kind.cls
    if missing := sorted(getattr(cls, "__abstractmethods__", ())):
        raise Refused(f"{cls.__name__}: is abstract, it has no {', '.join(missing)}")
    arguments = () if kind.config is None else (kind.config,)
    try:
        inspect.signature(cls).bind(*arguments)
    except TypeError as error:
        valid = "self, config: Config" if arguments else "self"
        raise Refused(f"{cls.__name__}.__init__: {error}; valid: def __init__({valid})") from None


def refuse_shared(place: str, ports: Iterable[tuple[str, str]]) -> None:
    """Raises Refused where two owners have a port of one name; ``ports`` are (port, owner)."""
    owners: dict[str, str] = {}
    for port, owner in ports:
        if (other := owners.setdefault(port, owner)) != owner:
            raise Refused(f"{place}: {other} and {owner} would share the port {port!r}; rename one of them")


@cache
def port_name(kind: type[Message]) -> str:
    """Snake case of a message's name: ``SceneEstimate`` -> ``scene_estimate``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name_of(kind)).lower()


def _handler_names(cls: type[Stage]) -> list[str]:
    names = (name for base in reversed(cls.__mro__) for name in vars(base) if name.startswith("on_"))
    return list(dict.fromkeys(names))


def _handler(cls: type[Stage], name: str) -> Handler:
    inputs: list[InputPort] = []
    context: str | None = None
    *parameters, (_, result) = _hints(cls, name).items()
    for parameter, annotation in parameters:
        if annotation is Context:
            context = parameter
        else:
            inputs.append(_input_port(cls, name, parameter, annotation))
    _refuse_inputs(cls, name, inputs)
    optional = NoneType in (result, *get_args(result))
    return Handler(name, tuple(inputs), context, tuple(_message_types(result)), optional)


def _hints(cls: type[Stage], name: str) -> dict[str, Any]:
    """Resolved annotations of a method's parameters, in their order, and of its result; each must have one."""
    place = f"{cls.__name__}.{name}"
    if reason := _why_no_handler(inspect.getattr_static(cls, name)):
        raise Refused(f"{place}: {reason}; valid: def {name}(self, ...), or another name")
    method: Callable[..., Any] = getattr(cls, name)
    hints = _resolved(place, method)
    _, *signature = inspect.signature(method).parameters.values()
    for one in signature:
        if one.kind not in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY):
            raise Refused(f"{place}({one.name}): is {one.kind.description}, and messages are given by name")
    parameters = (*(one.name for one in signature), "return")
    for parameter in parameters:
        if parameter not in hints:
            raise Refused(f"{cls.__name__}.{name}({parameter}): has no annotation")
    return {parameter: hints[parameter] for parameter in parameters}


def _why_no_handler(member: Any) -> str:
    """Why what a class has under the name of a handler is none; empty where it is one."""
    other = isinstance(member, staticmethod | classmethod) or not callable(member)
    if other or not (inspect.isroutine(member) or hasattr(member, "__wrapped__")):
        return f"is of type {type(member).__name__} and no method"
    if inspect.iscoroutinefunction(member) or inspect.isasyncgenfunction(member):
        return "is async, and nobody would await it"
    return ""


def _resolved(place: str, what: Callable[..., Any]) -> dict[str, Any]:
    """The annotations of a method or class."""
    try:
        return get_type_hints(what)
    except NameError as error:
        raise Refused(f"{place}: an annotation cannot be resolved: {error}") from None


def _input_port(cls: type[Stage], method: str, parameter: str, annotation: Any) -> InputPort:
    place = f"{cls.__name__}.{method}({parameter})"
    if _is_message(annotation):
        return InputPort(parameter, annotation, "one")
    if get_origin(annotation) is not list:
        raise Refused(f"{place}: {annotation} is not a Message, a list of Parts or Context")
    (item,) = get_args(annotation)
    if not (_is_message(item) and issubclass(item, Part)):
        raise Refused(f"{place}: a list gathers Parts, and {getattr(item, '__name__', item)} is not one")
    return InputPort(parameter, item, "gather")


def _refuse_inputs(cls: type[Stage], method: str, inputs: list[InputPort]) -> None:
    if method == "source" and inputs:
        raise Refused(f"{cls.__name__}.source({inputs[0].name}): a source takes no messages")
    parts = [port.name for port in inputs if issubclass(port.type, Part) and port.kind == "one"]
    gathers = [port.name for port in inputs if port.kind == "gather"]
    if len(parts) > 1 or (parts and gathers):
        names = ", ".join(parts + gathers)
        raise Refused(f"{cls.__name__}.{method}({names}): a handler takes at most one Part, or gathers lists of them")

    for port in inputs:  # nothing else hangs on a command: a join with one would wait for ever
        if issubclass(port.type, Command) and len(inputs) > 1:
            raise Refused(f"{cls.__name__}.{method}({port.name}): a command is the only message its handler takes")


@cache
def _why_no_message(kind: type[Message]) -> str:
    """Why a type cannot be sent; empty where it can. Many stages have the same types."""
    try:
        refuse_class(kind)
    except Refused as refusal:
        return str(refusal)
    return ""


def _message_types(annotation: Any) -> Iterator[type[Message]]:
    """Every Message type inside a return annotation, such as ``Iterator[A | B] | None``."""
    if _is_message(annotation):
        yield annotation
    elif get_origin(annotation) is Annotated:
        yield from _message_types(get_args(annotation)[0])
    else:
        for argument in get_args(annotation):
            yield from _message_types(argument)


def _is_message(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Message)


def _config_type(cls: type[Stage]) -> type[Any] | None:
    config: type[Any] | None = getattr(cls, "Config", None)
    if config is not None and not (is_dataclass(config) and vars(config)["__dataclass_params__"].frozen):
        raise Refused(f"{cls.__name__}.Config: must be a frozen dataclass")
    return config
