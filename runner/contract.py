"""The contract between a stage and its runner: typed handlers in, typed messages out.

A stage is a class whose ``on_*`` methods are handlers. The runner reads ports and message types from
their annotations:

* each parameter annotated with a :class:`Message` type is an input port, named like the parameter;
* several message parameters are a **join by lineage**: the handler runs once every port has a message
  that hangs on the same root, whatever the order of arrival;
* a parameter ``list[M]`` (``M`` a :class:`Part`) is a **gather**: the handler runs once all ``count`` parts
  of a lineage are there, sorted by ``index``;
* each port belongs to one handler; a join that holds one :class:`Part` runs once for each part of its lineage;
* a parameter annotated with a :class:`Command` type is a command of the stage, called from outside the graph
  with ``runner call`` and not wired; it is the only message its handler takes;
* a handler without message parameters (``on_start``) runs once, when every stage of the graph is ready;
* every :class:`Message` type in the return annotation is an output port, named in snake case
  (``SceneEstimate`` -> ``scene_estimate``). A handler returns one message, ``None``, or an iterator of messages;
* a parameter annotated :class:`Context` receives the step's context.

Only stages marked ``device`` touch the outside (sensors, simulators, files, wall clock). A device may also
define ``source(self, ctx) -> Iterator[Message]``, which is advanced between inputs; one that has handlers too yields
None, after a moment, where there is nothing yet. A handler of a device that takes long may yield None now and then:
what has arrived for the other handlers has its turn before it goes on. Replay re-executes every other stage and
substitutes what devices emitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

import msgspec

if TYPE_CHECKING:  # whoever runs a command waits for what it imports
    import numpy as np

Level = Literal["debug", "info", "warning", "error"]


class Struct(msgspec.Struct, frozen=True, kw_only=True):
    """A record inside a message. Fields are append-only: new ones have defaults."""


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """A value that crosses a process boundary. Fields are append-only: new ones have defaults."""

    version: ClassVar[int] = 1
    starts_lineage: ClassVar[bool] = False
    """True where everything downstream hangs on this message's own id rather than on its cause's."""
    known_as: ClassVar[str] = ""
    """The name by which recordings, ports, ids and other processes know this very class (none that derives from it),
    where it is not its own: a class that is renamed keeps the one that it had."""


def name_of(kind: type[Message]) -> str:
    """The name by which everybody but the source code knows a message class."""
    return vars(kind).get("known_as") or kind.__name__


class Part(Message, frozen=True, kw_only=True):
    """One of ``count`` messages that fan out from one step and are gathered again, ordered by ``index``.

    Replicated stages share parts between replicas and receive every other message in each replica.
    """

    index: int
    count: int


class Command(Message, frozen=True, kw_only=True):
    """What a stage does when somebody outside the graph asks for it: ``runner call STAGE COMMAND field=value``.

    Named like the parameter that takes it. The supervisor publishes it as ``supervisor.STAGE_COMMAND``, so that it
    is recorded, journalled, replayed and delivered again after a restart like any other message.
    """

    answers: ClassVar[tuple[type[Message], ...]] = ()
    """What the stage emits, now or in a later step, when it has done what was asked: one of these; none where the
    step itself does it. A field ``success`` that is false makes the exit status of the call 1.
    """


class Finished(Message, frozen=True, kw_only=True):
    """Ends the graph. ``code`` becomes the exit status (0 success), ``reason`` the last line printed."""

    code: Annotated[int, msgspec.Meta(ge=0, le=255)]
    reason: str


class Restarted(Message, frozen=True, kw_only=True):
    """Emitted by the supervisor, as ``supervisor.restarted``, when it replaces a crashed process."""

    stage: str
    replica: int
    reason: str


@dataclass(frozen=True, slots=True)
class Spec:
    """What an array field must be; checked when a message is encoded and when it is decoded.

    ``shape`` holds a number where the extent is fixed and a name where it is free; equal names within
    one array must agree. ``finite`` refuses NaN and infinity.
    """

    dtype: str
    shape: tuple[int | str, ...]
    finite: bool = True


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far a field of a message may be from its recorded value where processor or libraries are others.

    A value holds where it is near enough, or where few enough of an array's elements differ at all.
    """

    absolute: float = 0.0
    """In the field's unit; infinite for what only people look at: it is not compared."""
    share: float = 0.0
    """Of an array's elements that may differ by any amount, 0 to 1."""


Tolerances = Mapping[str, Tolerance]
"""By ``Type.field`` of the message or struct that declares a field; a graph names its table: ``tolerances:``."""


Fields = dict[str, Any]
"""A recorded message as msgpack maps: structs are maps too, arrays ``[dtype, shape, bytes]``."""


@dataclass(frozen=True, slots=True)
class Migration:
    """From one version of a message to the next, for recordings that are older than its class.

    Fields that a message gains need none: they have defaults. Where a field is renamed, retired or computed otherwise,
    the ``version`` of its message rises by one.
    """

    renamed: Mapping[str, str] = field(default_factory=dict[str, str])
    """Old names of fields and their new ones; the fields of a struct inside as ``place.name``, also in lists."""
    retired: tuple[str, ...] = ()
    """Fields that are gone."""
    change: Callable[[Fields], Fields] | None = None
    """Anything else; gets the fields after they were renamed."""


Migrations = Mapping[tuple[str, int], Migration]
"""By the name of a message (:func:`name_of`) and the version that the entry leads away from; a graph names its table:
``migrations:``."""


EXIT_REFUSED = 2
"""Exit status of commands and processes that end with :class:`Refused`."""


class Refused(Exception):
    """Bad input or configuration from outside: one line that names value, place and valid choices.

    The runner prints it without a traceback and does not restart the stage.
    """


class Context(Protocol):
    """What a stage may know of the step that runs."""

    @property
    def time_ns(self) -> int:
        """Logical time of the step, in nanoseconds: the newest logical time of what it consumed.

        The wall clock where it consumed nothing, and for devices.
        """
        ...

    @property
    def rng(self) -> np.random.Generator:
        """Random numbers seeded from (graph seed, stage, id of the driving message) and nothing else."""
        ...

    @property
    def directory(self) -> Path:
        """Folder beside the recording for files that devices write; it exists."""
        ...

    def log(self, text: str, *, level: Level = "info") -> None:
        """Shows one line on the terminal while the graph runs and records it."""
        ...


class Scorer(Protocol):
    """Says in numbers how well a run went; a graph names its own: ``score: module:Class``.

    Constructed with the settings of every stage, by stage.
    """

    def score(self, run: Iterable[tuple[str, Message]]) -> Mapping[str, float]:
        """``run`` has (lineage, message) of every message in order; the names of the numbers contain their units."""
        ...


class Stage:
    """Base of every stage. A nested frozen dataclass ``Config`` holds its settings and validates itself.

    ``__init__(self, config: Config)`` does all heavy set-up (models, kernels) before the graph is ready;
    handlers then take as long as their algorithm takes and no longer.
    """

    device: ClassVar[bool] = False
    """True where the stage touches the outside: replay substitutes its recorded messages."""

    stateful: ClassVar[bool] = False
    """True where what a handler does depends on earlier steps. A restarted process then executes again, silently,
    what its predecessors did, and a replay does the same. Devices cannot: their past lies outside."""

    @classmethod
    def prepare(cls, config: Any) -> None:
        """Reads and computes beforehand what every process of this stage would by itself, and keeps it in caches.

        Processes are forked from one that has called this for some stages, and share the memory; it is called once or
        again, or never. It only fills caches: no threads, no contexts, no files or devices that stay open. What it
        raises, ``__init__`` must raise too, for here nobody listens.
        """

    @classmethod
    def examine(cls) -> str:
        """Says in a line what the machine has of what the stage needs beside packages, for ``runner doctor``.

        Raises Refused with what is missing and what to type. Runs in a process of its own.
        """
        return ""

    def close(self) -> None:
        """Releases what ``__init__`` took. Called once, on every orderly shutdown."""
