"""Executes one step of one stage; the same code runs live and in a replay."""

import contextlib
import hashlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from runner.contract import Level, Message, Part, Stage
from runner.graph.graph import Node
from runner.graph.ports import Handler, InputPort, port_name
from runner.message import codec
from runner.message.codec import Draft, Envelope
from runner.message.ids import MessageId

Log = Callable[[str, Level], object]
"""Takes one line of a stage's log."""


LEVELS = get_args(Level)


class BrokenContract(Exception):
    """A stage that did not do what its annotations say."""


class Arrival(msgspec.Struct, frozen=True):
    """A message at an input port."""

    port: InputPort
    envelope: Envelope
    message: Message
    arrived_ns: int = 0
    """Monotonic clock."""
    travelled_ns: int = 0


def receive(port: InputPort, envelope: Envelope, *, arrived_ns: int = 0, travelled_ns: int = 0) -> Arrival:
    """Decodes what arrived at a port; raises CodecError where it is not of the port's type."""
    message = codec.open_envelope(port.type, envelope)
    return Arrival(port, envelope, message, arrived_ns, travelled_ns)


class _Emitted(msgspec.Struct):
    """What one step has emitted, as far as the next message must agree with it."""

    ports: set[str] = msgspec.field(default_factory=set[str])
    """Of a stage with replicas."""
    parts: dict[str, tuple[int, set[int]]] = msgspec.field(default_factory=dict[str, tuple[int, set[int]]])
    """Count and indices of the parts in the step's lineage, by port."""


class StepContext:
    """What a handler may know of its step (:class:`runner.contract.Context`)."""

    def __init__(self, *, time_ns: int, seed: Callable[[], int], directory: Path, log: Log):
        """``seed`` is asked when random numbers are wanted."""
        self.time_ns = time_ns
        self.directory = directory
        """Folder beside the recording."""
        self._seed = seed
        self._log = log

    @cached_property
    def rng(self) -> np.random.Generator:
        """Random numbers of this step, made when they are first asked for."""
        return np.random.default_rng(self._seed())

    def log(self, text: str, *, level: Level = "info") -> None:
        """Shows and records one line; raises BrokenContract where it is none."""
        if not isinstance(text, str):  # pyright: ignore[reportUnnecessaryIsInstance] - of whoever runs no type checker
            raise BrokenContract(f"logged a {type(text).__name__}; valid: a text")
        if level not in LEVELS:
            raise BrokenContract(f"logged at level {level!r}; valid: {', '.join(LEVELS)}")
        self._log(text, level)


class Executor:
    """Runs the handlers of one stage and wraps what they return as envelopes with their ids."""

    def __init__(
        self,
        node: Node,
        stage: Stage,
        *,
        seed: int,
        directory: Path,
        log: Log,
        numbers: Mapping[str, int] | None = None,
    ):
        """``seed`` is the graph's; ``numbers`` the next sequence number of output ports already in use."""
        self._node = node
        self._stage = stage
        self._seed = seed
        self._directory = directory
        self._log = log
        self._numbers = dict(numbers or {})

    def number_on(self, numbers: Mapping[str, int]) -> None:
        """Leaves out the sequence numbers below these, by output port."""
        for port, number in numbers.items():
            self._numbers[port] = max(self._numbers.get(port, 0), number)

    def run(self, handler: Handler, arrivals: Sequence[Arrival], time_ns: int) -> Iterator[Envelope]:
        """Calls a handler as :meth:`drafts` does and yields what it emits in envelopes."""
        for draft in self.drafts(handler, arrivals, time_ns):
            if draft is not None:
                yield draft.envelope

    def drafts(self, handler: Handler, arrivals: Sequence[Arrival], time_ns: int) -> Generator[Draft | None]:
        """Calls a handler and yields its messages as it emits them; None as a device does that lets others in.

        ``arrivals`` are in the order of the handler's parameters, the parts of a gather by index;
        ``time_ns`` is the step's logical time. Raises whatever the handler raises, CodecError for a message
        that breaks its class and BrokenContract for one that the annotations do not announce, or a part that is none.
        """
        driver = driver_of(handler, arrivals)
        context = self._context(handler, driver, time_ns)
        arguments = arguments_of(arrivals)
        if handler.context is not None:
            arguments[handler.context] = context
        causes = tuple(arrival.envelope.id for arrival in arrivals)
        emitted = _Emitted()
        result = getattr(self._stage, handler.name)(**arguments)
        if result is None and not handler.optional:  # whoever waits for its answer would wait for ever
            raise BrokenContract("returned None, which its annotation does not allow")
        with contextlib.closing(_messages(result)) as messages:
            for message in messages:
                if message is not None:
                    yield self._draft(message, driver, causes, context.time_ns, emitted)
                elif self._node.type.cls.device:
                    yield None
                else:
                    raise BrokenContract("yielded None, which lets others have their turn; only a device may")

    def advance(self, handler: Handler, clock: Callable[[], int]) -> Iterator[Draft | None]:
        """Yields the messages of a device's source, each a step of its own at the clock's time; None as it does."""
        context = self._context(handler, None, clock())
        arguments = {} if handler.context is None else {handler.context: context}
        for message in getattr(self._stage, handler.name)(**arguments):
            context.time_ns = clock()
            yield None if message is None else self._draft(message, None, (), context.time_ns, _Emitted())

    def _context(self, handler: Handler, driver: Envelope | None, time_ns: int) -> StepContext:
        identity = handler.name if driver is None else driver.id
        seed = partial(step_seed, self._seed, self._node.name, identity)
        return StepContext(time_ns=time_ns, seed=seed, directory=self._directory, log=self._log)

    def _draft(
        self, message: Message, driver: Envelope | None, causes: tuple[str, ...], time_ns: int, emitted: _Emitted
    ) -> Draft:
        port = self._port_of(message)
        own = str(MessageId(self._node.name, port, self._number(port, driver, emitted.ports)))
        lineage = own if driver is None or message.starts_lineage else driver.lineage
        draft = codec.draft(message, id=own, lineage=lineage, time_ns=time_ns, causes=causes)
        if isinstance(message, Part):
            _check_part(message, port, emitted.parts if lineage != own else {})
        return draft

    def _port_of(self, message: Message) -> str:
        port = port_name(type(message))
        if self._node.type.outputs.get(port) is not type(message):
            announced = ", ".join(self._node.type.outputs) or "nothing"
            raise BrokenContract(f"emitted a {type(message).__name__}; its annotations announce {announced}")
        return port

    def _number(self, port: str, driver: Envelope | None, taken: set[str]) -> int:
        """Contiguous by port; a replica takes its part's number, so that ids do not depend on who worked."""
        if self._node.replicated and driver is not None:
            if port in taken:
                raise BrokenContract(f"emitted two {port} in one step, which a replicated stage may not")
            taken.add(port)
            return MessageId.of(driver.id).sequence
        number = self._numbers.get(port, 0)
        self._numbers[port] = number + 1
        return number


def _check_part(part: Part, port: str, siblings: dict[str, tuple[int, set[int]]]) -> None:
    """Raises BrokenContract for a part that no gather could ever put among the others."""
    emitted = f"emitted {port} with index {part.index} of {part.count}"
    if part.count < 1:
        raise BrokenContract(f"{emitted}; valid: a count of 1 and more")
    if not 0 <= part.index < part.count:
        raise BrokenContract(f"{emitted}; valid: 0 to {part.count - 1}")
    count, indices = siblings.setdefault(port, (part.count, set()))
    if part.count != count:
        raise BrokenContract(f"{emitted}, after one of {count} in the same step; valid: the same count")
    if part.index in indices:
        raise BrokenContract(f"{emitted} twice in one step; valid: each index from 0 to {count - 1} once")
    indices.add(part.index)


def step_seed(seed: int, stage: str, identity: str) -> int:
    """256 bits from the graph's seed, the stage and what drives the step, and from nothing else."""
    digest = hashlib.sha256(f"{seed}\0{stage}\0{identity}".encode()).digest()
    return int.from_bytes(digest, "big")


def driver_of(handler: Handler, arrivals: Sequence[Arrival]) -> Envelope | None:
    """The message that seeds the step and hands its lineage on; None for a start."""
    name = handler.driver.name if handler.driver is not None else ""
    return next((arrival.envelope for arrival in arrivals if arrival.port.name == name), None)


def step_time(node: Node, arrivals: Sequence[Arrival], now_ns: int) -> int:
    """Logical time: the newest of what is consumed; the clock's where nothing is, and for devices."""
    if node.type.cls.device or not arrivals:
        return now_ns
    return max(arrival.envelope.time_ns for arrival in arrivals)


def arguments_of(arrivals: Iterable[Arrival]) -> dict[str, Any]:
    """The messages that a step consumes by port; a list for a gather."""
    arguments: dict[str, Any] = {}
    for arrival in arrivals:
        if arrival.port.kind == "gather":
            arguments.setdefault(arrival.port.name, []).append(arrival.message)
        else:
            arguments[arrival.port.name] = arrival.message
    return arguments


def _messages(result: Message | Iterable[Message | None] | None) -> Generator[Message | None]:
    """What a handler returned, as an iterator."""
    if isinstance(result, Message):
        yield result
    elif result is not None:
        try:
            messages = iter(result)
        except TypeError:
            given = type(result).__name__
            raise BrokenContract(f"returned {given} instead of a message or an iterator of them") from None
        yield from messages
