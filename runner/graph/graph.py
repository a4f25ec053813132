"""A graph of stages: who gets what from whom, and where it runs."""

import contextlib
import json
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, cast

import msgspec
from msgspec import Meta

from runner.contract import Command, Finished, Message, Part, Restarted, Stage
from runner.graph.placement import ALONE, Layout
from runner.graph.ports import StageType, port_name
from runner.graph.references import load_class

SUPERVISOR = "supervisor"
FINISHED = port_name(Finished)
QUEUE = 64
NUMERICAL = ("numpy",)
"""The packages that compute where a graph names none."""


ClassName = Annotated[str, Meta(pattern=r"^[A-Za-z_][\w.]*:\w+$(?!\n)", description="module:Class")]


class Edge(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where an input port gets its messages from, and what happens when they come too fast."""

    source: Annotated[str, Meta(description="stage.port")] = msgspec.field(name="from")
    policy: Annotated[
        Literal["block", "latest"],
        Meta(description="block: nothing is lost, a full queue stops the publisher; latest: only the newest is kept"),
    ] = "block"
    queue: Annotated[int, Meta(ge=1, description="Unacknowledged lineages after which the publisher waits")] = QUEUE

    @property
    def stage(self) -> str:
        """The publisher."""
        return self.source.partition(".")[0]

    @property
    def port(self) -> str:
        """Its output port."""
        return self.source.partition(".")[2]


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a process may do before it is taken for hung, or for out of bounds."""

    heartbeat: Annotated[
        float, Meta(gt=0, description="Seconds without a sign of life after which a process counts as hung")
    ] = 30.0
    """Long: code that keeps the interpreter to itself is slow, not dead."""
    timeout: Annotated[
        float, Meta(gt=0, description="Seconds a handler may compute; time held back by consumers does not count")
    ] = 300.0
    """A device's source may wait for the world as long as it likes."""
    startup: Annotated[float, Meta(gt=0, description="Seconds until a process must be ready")] = 180.0
    memory: Annotated[
        Annotated[str, Meta(pattern=r"^\d+(\.\d+)? ?[kMGT]B$(?!\n)")] | None,
        Meta(description="What a process may hold, for example 2GB"),
    ] = None

    @property
    def memory_bytes(self) -> float:
        """The limit of memory as a number; infinite where none is set."""
        if self.memory is None:
            return math.inf
        return float(self.memory[:-2]) * 1000 ** " kMGT".index(self.memory[-2])


class GraphKeys(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is said of a graph beside its stages and hosts."""

    name: Annotated[str, Meta(pattern=r"^[\w-]+$(?!\n)", description="Letters, digits, _ and -: names the recordings")]
    seed: Annotated[int, Meta(description="Root of all random numbers")] = 0
    view: Annotated[ClassName | None, Meta(description="module:Class that draws the messages")] = None
    story: Annotated[
        ClassName | None, Meta(description="module:Class that tells people on a page what happens and what they can do")
    ] = None
    page: Annotated[bool, Meta(description="Serve a page on every run, as `runner up --page` does")] = False
    listen: Annotated[
        str | None, Meta(description="Where others may listen, for example tcp/127.0.0.1:7447; only this user without")
    ] = None
    score: Annotated[ClassName | None, Meta(description="module:Class that says in numbers how well a run went")] = None
    tolerances: Annotated[
        str | None, Meta(description="module:NAME of the table of how far fields may be off on another machine")
    ] = None
    migrations: Annotated[
        str | None, Meta(description="module:NAME of the table of what has become of messages since they were recorded")
    ] = None
    numerical: Annotated[
        tuple[str, ...], Meta(description="Packages that compute: another version may round a float differently")
    ] = NUMERICAL


@dataclass(frozen=True, slots=True)
class Node:
    """One stage of a checked graph."""

    name: str
    stage: str
    """``module:Class``."""
    type: StageType
    config: Any
    inputs: dict[str, Edge]
    replicas: int
    restarts: int
    limits: Limits = field(default_factory=Limits)
    placement: tuple[str, ...] = ()
    """The host of each replica; empty where all are on the head."""

    @property
    def replicated(self) -> bool:
        """True where parts are shared between processes."""
        return self.replicas > 1

    def shares(self, port: str) -> bool:
        """True where each message of this port goes to one replica only."""
        return self.replicated and issubclass(self.type.inputs[port].type, Part)

    def keeps(self, port: str) -> bool:
        """True where a message of this port is used for several parts."""
        return self.type.takers[port].keeps(self.type.inputs[port])

    def kept(self, port: str) -> int:
        """How many messages of a port parts that are under way may still need."""
        return max(edge.queue for edge in self.inputs.values()) if self.keeps(port) else 0

    def prepare(self) -> None:
        """Has the stage fill caches that processes share which are forked from this one; says nothing of failures:
        they are those of :meth:`construct`."""
        with contextlib.suppress(Exception, SystemExit):
            self.type.cls.prepare(self.config)

    def construct(self) -> Stage:
        """A new instance with the node's settings."""
        cls = cast("Any", self.type.cls)
        return cls() if self.type.config is None else cls(self.config)


class Route(msgspec.Struct, frozen=True):
    """One edge as its publisher and the recorder know it."""

    output: str
    """Port of the publisher."""
    consumer: str
    input: str
    """Port of the consumer."""
    policy: Literal["block", "latest"]
    queue: int
    shared: bool
    """Each message goes to one of the consumer's replicas."""
    kept: int
    """Messages that the consumer may use for further steps, and needs again when it restarts: as many as lineages may
    be under way on any of its ports; 0 where it uses each once."""
    replicas: int = 1
    """Of the consumer."""

    @property
    def takers(self) -> Iterable[int]:
        """Who has to do with a message: each replica, or (-1) any of them."""
        return (-1,) if self.shared else range(self.replicas)


class Graph(GraphKeys, frozen=True, kw_only=True):
    """A checked graph."""

    nodes: dict[str, Node]
    """By name."""
    layout: Layout = ALONE

    def host_of(self, stage: str, replica: int) -> str | None:
        """The machine of a process; None where the graph names no machines."""
        if not self.layout.hosts:
            return None
        placement = self.nodes[stage].placement
        return placement[replica] if placement else self.layout.head.name

    def hosts_of_stages(self) -> dict[str, set[str]]:
        """The machines on which each stage has processes."""
        return {node.name: set(node.placement) or {self.layout.head.name} for node in self.nodes.values()}

    def here(self) -> "Graph":
        """The same graph with every process on the machine that starts it."""
        nodes = {name: replace(node, placement=()) for name, node in self.nodes.items()}
        return msgspec.structs.replace(self, layout=ALONE, nodes=nodes)

    def routes(self, stage: str) -> list[Route]:
        """Every edge that leaves a stage."""
        return [
            Route(
                edge.port, node.name, port, edge.policy, edge.queue, node.shares(port), node.kept(port), node.replicas
            )
            for node in self.nodes.values()
            for port, edge in node.inputs.items()
            if edge.stage == stage
        ]

    def destinations(self) -> dict[str, tuple[Route, ...]]:
        """Where the messages of every output port go, by ``STAGE/PORT``."""
        found: dict[str, tuple[Route, ...]] = {}
        for stage in (*self.nodes, SUPERVISOR):
            for route in self.routes(stage):
                topic = f"{stage}/{route.output}"
                found[topic] = (*found.get(topic, ()), route)
        return found

    def outputs_of(self, stage: str) -> dict[str, type[Message]]:
        """Output ports of a stage or of the supervisor; none of what is neither."""
        if stage == SUPERVISOR:
            return {port_name(Restarted): Restarted, **self.commands()}
        return self.nodes[stage].type.outputs if stage in self.nodes else {}

    def topics(self) -> dict[str, type[Message]]:
        """Every output port, as ``STAGE/PORT``; the supervisor's last."""
        stages = (*self.nodes, SUPERVISOR)
        return {f"{stage}/{port}": kind for stage in stages for port, kind in self.outputs_of(stage).items()}

    def commands(self) -> dict[str, type[Command]]:
        """What the supervisor publishes when a command is called, by output port."""
        return {
            command_port(node.name, name): kind
            for node in self.nodes.values()
            for name, kind in node.type.commands.items()
        }

    def load(self, key: str, reference: str, wanted: type[Any] | None = None) -> Any:
        """An instance of the class ``module:Class`` that a key names, given the settings of every stage by its name.

        Raises Refused where there is no such class, or one without the methods of the protocol ``wanted``.
        """
        cls = load_class(reference, f"{key} of graph {self.name!r}", wanted)
        return cls({name: node_entry(node)["config"] for name, node in self.nodes.items()})

    def processes(self) -> list[tuple[str, int]]:
        """(stage, replica) of every process."""
        return [(node.name, replica) for node in self.nodes.values() for replica in range(node.replicas)]


def command_port(stage: str, command: str) -> str:
    """The supervisor's output port from which a stage gets a command."""
    return f"{stage}_{command}"


def graph_to_json(graph: Graph) -> str:
    """The graph as it runs, every setting written out: what processes are given and recordings keep."""
    stages = {node.name: node_entry(node) for node in graph.nodes.values()}
    return json.dumps({**keys_of(graph), **graph.layout.to_entry(), "stages": stages}, indent=1)


def keys_of(graph: GraphKeys) -> dict[str, Any]:
    """What is said of a graph beside its stages and hosts, by key."""
    return {key: getattr(graph, key) for key in GraphKeys.__struct_fields__}


def node_entry(node: Node) -> dict[str, Any]:
    """One stage as a graph file would state it, with every setting, its commands and the ports that replicas share."""
    return {
        "stage": node.stage,
        "config": {} if node.config is None else msgspec.to_builtins(node.config, enc_hook=str),
        "inputs": {
            port: msgspec.to_builtins(edge) for port, edge in node.inputs.items() if port not in node.type.commands
        },
        "commands": list(node.type.commands),
        "shares": [port for port in node.inputs if node.shares(port)],
        "replicas": node.replicas,
        **({"host": dict(Counter(node.placement))} if node.placement else {}),
        "restarts": node.restarts,
        **msgspec.structs.asdict(node.limits),
    }


def mermaid(graph: Graph) -> str:
    """The graph as a Mermaid flow chart with message types on its edges."""
    lines = ["flowchart LR"]
    for node in graph.nodes.values():
        label = f"{node.name}<br/>x {node.replicas}" if node.replicated else node.name
        lines.append(f'  {node.name}[["{label}"]]' if node.type.cls.device else f'  {node.name}["{label}"]')
    for node in graph.nodes.values():
        for port, edge in node.inputs.items():
            style = "-.->" if edge.policy == "latest" else "-->"
            lines.append(f'  {edge.stage} {style}|"{node.type.inputs[port].type.__name__}"| {node.name}')
    return "\n".join(lines)
