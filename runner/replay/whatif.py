"""What would have been: stages of a recording changed, all that follows from them executed again, and a verdict."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

from runner.contract import Message, Refused, Scorer
from runner.graph.document import suggest
from runner.graph.graph import Graph, node_entry
from runner.inspect.compare import envelope_differences
from runner.inspect.info import table
from runner.inspect.summary import Summary
from runner.message.codec import Envelope
from runner.message.ids import MessageId
from runner.recording.recording import Recording, kind_of, opened
from runner.replay.partial import PartialReplay
from runner.replay.replay import change
from runner.replay.tasks import HEADER, what_differs
from runner.replay.tolerances import compare_origin
from runner.terminal import listed

Effect = Literal["identical", "changed", "appeared", "vanished"]
"""What becomes of a message."""
EFFECTS: tuple[Effect, ...] = get_args(Effect)
DIFFERENT: tuple[Effect, ...] = EFFECTS[1:]


def what_if(
    path: Path,
    *,
    assignments: Sequence[str],
    swaps: Sequence[str],
    origins: Sequence[str],
    workers: int,
) -> int:
    """Executes what follows from a change again and prints what it changes.

    ``assignments`` are ``--set``'s, ``swaps`` are ``stage=module:Class``, ``origins`` stages that are executed though
    nothing about them changes. Returns 0, or 1 where a handler raised. Raises Refused where the change is impossible.
    """
    recording = Recording(path)
    recording.require_messages()
    graph = change(recording, assignments, swaps)
    changed = _changed(recording, graph)
    names = affected_by(graph, changed | _known(graph, origins, "--from"))
    _, changes = compare_origin(recording)
    frozen = ", ".join(name for name in graph.nodes if name not in names)
    what = f"executed again: {', '.join(names)}; as recorded: {frozen or 'nothing'}"
    print(*changes, f"{path}: {recording.verdict}", what, sep="\n")
    with tempfile.TemporaryDirectory() as folder:
        replay = PartialReplay(recording, graph, names, changed=changed, workers=workers, folder=Path(folder))
        replay.run()
    for line in _verdict(recording, graph, names, replay):
        print(line)
    return int(bool(replay.errors))


# ------------------------------------------------------------------------------------ the change


def _changed(recording: Recording, graph: Graph) -> set[str]:
    """The stages that are not as recorded; all where the seed is another."""
    before = change(recording)
    if before.seed != graph.seed:
        return {name for name, node in graph.nodes.items() if not node.type.cls.device}
    changed = {name for name in graph.nodes if node_entry(graph.nodes[name]) != node_entry(before.nodes[name])}
    return _known(graph, sorted(changed), "--set or --swap")


def _known(graph: Graph, names: Sequence[str], option: str) -> set[str]:
    """Refuses stages that do not exist and devices, which cannot be executed again."""
    valid = [name for name, node in graph.nodes.items() if not node.type.cls.device]
    for name in names:
        if name not in graph.nodes:
            raise Refused(f"{option} {name}: no stage {name!r}{suggest(name, valid)}")
        if name not in valid:
            raise Refused(
                f"{option} {name}: {name} is a device, and what it emitted is recorded; valid: {', '.join(valid)}"
            )
    return set(names)


def affected_by(graph: Graph, origins: Collection[str]) -> list[str]:
    """The stages that follow from some, themselves included, as far as the next devices; in the graph's order."""
    found, waiting = set[str](), list(origins)
    while waiting:
        name = waiting.pop()
        if name not in found and not graph.nodes[name].type.cls.device:
            found.add(name)
            waiting += [route.consumer for route in graph.routes(name)]
    if not found:
        raise Refused("nothing changes; valid: --from STAGE, --swap STAGE=MODULE:CLASS or --set STAGE.KEY=VALUE")
    return [name for name in graph.nodes if name in found]


# ------------------------------------------------------------------------------------ the verdict


def effects_of(
    recording: Recording,
    graph: Graph,
    names: Collection[str],
    emitted: Mapping[str, Envelope],
    unexplained: Collection[str],
) -> tuple[dict[Effect, list[str]], Summary]:
    """Compares what was emitted with what is recorded of the same stages, but for what is ``unexplained``: ids by
    effect, and which fields differ."""
    effects: dict[Effect, list[str]] = {effect: [] for effect in EFFECTS}
    summary = Summary()
    for id in recording.messages:
        if MessageId.of(id).stage not in names or id in unexplained:
            continue
        if id not in emitted:
            effects["vanished"].append(id)
            continue
        before, kind = recording.envelope(id), kind_of(graph, id)
        assert kind is not None  # It has just been emitted.
        now = what_differs(before, emitted[id], kind)
        effects["identical" if now is None else "changed"].append(id)
        found = () if now is None else envelope_differences(before, now, HEADER, kind)
        summary.add(MessageId.of(id).topic, id, found)
    effects["appeared"] += (id for id in emitted if id not in recording.messages)
    return effects, summary


def _verdict(recording: Recording, graph: Graph, names: Sequence[str], replay: PartialReplay) -> Iterator[str]:
    effects, summary = effects_of(recording, graph, names, replay.emitted, replay.unexplained)
    yield ""
    yield from _by_topic(effects)
    if effects["changed"]:
        yield ""
        yield from summary.lines()
    yield from (f"{effect}: {listed(effects[effect])}" for effect in ("appeared", "vanished") if effects[effect])
    yield from _devices(graph, names, effects)
    if lost := replay.frozen.blocked():
        yield f"devices answered what is not asked any more, left out: {listed(lost)}"
    yield from (f"FAILED {error}" for error in replay.errors)
    yield ""
    yield from _scores(recording, graph, replay)
    same = not any(effects[effect] for effect in DIFFERENT)
    counts = (f"{len(effects[effect])} {effect}" for effect in (*DIFFERENT, "identical") if effects[effect])
    yield f"{'NOTHING CHANGES' if same else 'CHANGED'}: {', '.join(counts) or 'no messages'}, of {len(names)} stages"


def _by_topic(effects: Mapping[Effect, Sequence[str]]) -> list[str]:
    counts = [Counter(MessageId.of(id).topic for id in ids) for ids in effects.values()]
    topics = sorted({topic for by_topic in counts for topic in by_topic})
    rows = [(topic, *(str(by_topic[topic] or "-") for by_topic in counts)) for topic in topics]
    return table(("topic", *effects), rows)


def _devices(graph: Graph, names: Collection[str], effects: Mapping[Effect, Sequence[str]]) -> Iterator[str]:
    """Where it ends at a device: what it would have been sent, and that its recorded answers stand."""
    for device in (node for node in graph.nodes.values() if node.type.cls.device):
        sources = {f"{edge.stage}/{edge.port}" for edge in device.inputs.values() if edge.stage in names}
        sent = {effect: [id for id in effects[effect] if MessageId.of(id).topic in sources] for effect in DIFFERENT}
        said = "; ".join(f"{effect} {listed(ids)}" for effect, ids in sent.items() if ids)
        if said:
            yield f"device {device.name} would have been sent: {said}. What it emitted stays as recorded"


# ------------------------------------------------------------------------------------ the score


def _scores(recording: Recording, graph: Graph, replay: PartialReplay) -> Iterator[str]:
    """A table of what the graph's scorer says of both; a line where there is none."""
    if graph.score is None:
        yield "no score: the graph names none; valid: --set score=module:Class"
        return
    scorer: Scorer = graph.load("score", graph.score)
    before = scorer.score(_messages(change(recording), recording.envelopes()))
    now = scorer.score(_messages(graph, _new_run(recording, replay)))
    rows = [_score_row(name, before.get(name), now.get(name)) for name in {**before, **now}]
    yield from table(("score", "recorded", "now", "change"), rows) or ["no score: the recording holds nothing to score"]


def _score_row(name: str, before: float | None, now: float | None) -> tuple[str, ...]:
    change = f"{now - before:+.4g}" if before is not None and now is not None and now != before else "-"
    return name, *("-" if value is None else f"{value:.4g}" for value in (before, now)), change


def _new_run(recording: Recording, replay: PartialReplay) -> Iterator[Envelope]:
    """Every message as it would have been: in the place of the recorded one, new ones at the end."""
    for id in filter(replay.frozen.came.__contains__, recording.messages):
        yield replay.emitted[id] if id in replay.emitted else recording.envelope(id)
    yield from (sealed for id, sealed in replay.emitted.items() if id not in recording.messages)


def _messages(graph: Graph, run: Iterator[Envelope]) -> Iterator[tuple[str, Message]]:
    messages = ((sealed.lineage, opened(graph, sealed)) for sealed in run)
    return ((lineage, message) for lineage, message in messages if message is not None)
