"""Starts the processes of a run, each with its task and where it belongs: the recorder, the viewer and the stages."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from runner.graph.graph import Graph, graph_to_json, node_entry
from runner.graph.placement import Network
from runner.hosts.head import Hosts
from runner.message.packet import Process
from runner.process.children import Descendants, spawn
from runner.process.fork_server import ForkServer
from runner.process.health import Watch
from runner.process.stage_process import Assignment
from runner.recording.writer import Manifest, topic
from runner.supervise.child import Child, Progress


@dataclass(frozen=True, slots=True)
class Run:
    """What is the same for all processes of a run, from its first to its last."""

    id: str
    graph: Graph
    recording: Path
    """The file that the recorder writes."""
    settings: tuple[str, ...]
    """``--set`` assignments, as typed."""
    endpoint: str
    """Where all of its processes meet."""
    gateway: str
    """Where listeners meet it."""
    network: Network | None
    """None on one machine."""
    steps_only: bool
    """Record no messages."""

    @property
    def directory(self) -> Path:
        """The run's folder, beside its recording."""
        return self.recording.with_suffix("")

    def log_of(self, process: Process) -> Path:
        """Where a process and its successors print."""
        return self.directory / "log" / f"{process.stage}-{process.replica}.txt"

    def name_of(self, process: Process) -> str:
        """A process as people know it: with the replica's number where there are several."""
        node = self.graph.nodes.get(process.stage)
        return f"{process.stage}.{process.replica}" if node is not None and node.replicated else process.stage

    def remembers(self, stage: str) -> bool:
        """Whether a successor must learn from the recording what its predecessor knew."""
        kind = self.graph.nodes[stage].type.cls
        return kind.stateful and not kind.device

    def forgets(self, stage: str) -> bool:
        """Whether a successor cannot learn it, for no messages are recorded."""
        return self.steps_only and self.remembers(stage)


class Launcher:
    """Starts single processes of one run, here or on the host that the graph names."""

    def __init__(self, run: Run, hosts: Hosts | None, forks: ForkServer, stopping: Callable[[], bool]):
        """``hosts`` are the other machines of the run, None where there are none. Once the graph is ``stopping`` no
        stage is started here any more."""
        self._run = run
        self._hosts = hosts
        self._forks = forks
        self._stopping = stopping
        self.descendants = Descendants()
        """What stages and viewer start here."""

    def recorder(self, process: Process) -> Child:
        """Starts what writes the recording."""
        run = self._run
        topics = {name: topic(kind) for name, kind in run.graph.topics().items()}
        task = Manifest(
            run.id,
            run.endpoint,
            str(run.recording),
            graph_to_json(run.graph),
            run.settings,
            topics,
            gateway=run.gateway,
            network=run.network,
            steps_only=run.steps_only,
            destinations=run.graph.destinations(),
            processes=tuple(run.graph.processes()),
        )
        log = run.log_of(process)
        handle = self._forks.start("runner.process.recorder", process.stage, task=msgspec.json.encode(task), log=log)
        return Child(process, handle, log)

    def viewer(self) -> Child:
        """Starts the viewer on the recording as it grows."""
        log = self._run.directory / "log" / "viewer.txt"
        process = Process("viewer", 0)
        mark = self.descendants.mark(process.path)
        handle = spawn("runner.cli", "view", "--live", str(self._run.recording), task=b"", log=log, mark=mark)
        return Child(process, handle, log)

    def stage(self, process: Process, progress: Progress) -> Child:
        """Starts a process of the graph; ``progress`` is how far its stage has come before. Raises Interrupted."""
        run, task = self._run, self._assignment(process, progress)
        log = run.log_of(process)
        log_from = log.stat().st_size if log.exists() else 0
        host = run.graph.host_of(*process.place)
        if self._hosts is not None and host is not None and host != self._hosts.network.host:
            handle = self._hosts.start(host, process, task, log)
        else:
            module, mark = "runner.process.stage_process", self.descendants.mark(process.path)
            data = msgspec.json.encode(task)
            handle = self._forks.start(
                module, run.name_of(process), task=data, log=log, mark=mark, stopping=self._stopping
            )
        return Child(process, handle, log, log_from=log_from, watch=Watch(run.graph.nodes[process.stage].limits))

    def _assignment(self, process: Process, progress: Progress) -> Assignment:
        run = self._run
        node = run.graph.nodes[process.stage]
        consumed = [
            (port, source, numbers)
            for replica, (port, source, numbers) in progress.consumed()
            if replica == process.replica or (port in node.inputs and node.shares(port))
        ]
        has_past = process.incarnation > 0 and run.remembers(process.stage)
        return Assignment(
            run=run.id,
            endpoint=run.endpoint,
            directory=str(run.directory.absolute()),
            stage=process.stage,
            entry=node_entry(node),
            seed=run.graph.seed,
            routes=tuple(run.graph.routes(process.stage)),
            processes=tuple(run.graph.processes()),
            replica=process.replica,
            incarnation=process.incarnation,
            numbers=dict(progress.numbers),
            started=progress.started,
            consumed=tuple(consumed),
            gateway=run.gateway,
            network=run.network,
            past=str(run.recording.absolute()) if has_past else "",
            done=progress.done,
        )

    def close(self) -> list[str]:
        """Ends what stages and viewer have left behind here, once they have gone; returns the command lines."""
        self._forks.close()
        return self.descendants.close()
