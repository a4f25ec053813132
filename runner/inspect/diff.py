"""Compares two recordings message by message: where they differ first, and how every field of every topic differs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from runner.inspect.compare import Difference, envelope_differences
from runner.inspect.info import table
from runner.inspect.summary import Summary
from runner.message.ids import MessageId
from runner.recording.provenance import changes
from runner.recording.recording import Recording

HEADER = ("lineage", "type", "version", "causes")
"""What is compared of an envelope beside its body. Logical times of devices are the wall clock's: those of two runs
always differ."""


def diff(a: Path, b: Path) -> int:
    """Prints how two recordings differ; returns 1 where they do. Raises Refused where one is no recording, or one of a
    run that recorded no messages."""
    first, second = Recording(a), Recording(b)
    for recording in (first, second):
        recording.require_messages()
    for recording in (first, second):
        print(f"{recording.path}: {len(recording.messages)} messages, {recording.verdict}")
    for line in _origins(first, second):
        print(line)
    summary = Summary()
    found = list(_found(first, second, summary))
    equal = f"no difference: {len(first.messages)} messages are equal"
    print(f"first difference: {found[0]}" if found else equal)
    for block in (_counts(first, second), summary.lines()):
        if block:
            print("", *block, sep="\n")
    return int(bool(found))


def _found(first: Recording, second: Recording, summary: Summary) -> Iterator[str]:
    """One line per message that differs, in the order of the first recording."""
    for id in first.messages:
        if id not in second.messages:
            yield f"{id}: only in {first.path}"
            continue
        changes = list(envelope_differences(first.recorded(id), second.recorded(id), HEADER))
        if summary.add(MessageId.of(id).topic, id, changes):
            yield f"{id}: {_words(changes[0])}"
    yield from (f"{id}: only in {second.path}" for id in second.messages if id not in first.messages)


def _words(difference: Difference) -> str:
    extent = f" ({difference.extent})" if difference.extent else ""
    return f"{difference.field}: {difference.recorded} and {difference.replayed}{extent}"


def _counts(first: Recording, second: Recording) -> list[str]:
    """Topics of which one recording holds more messages than the other."""
    only_first = Counter(message.topic for id, message in first.messages.items() if id not in second.messages)
    only_second = Counter(message.topic for id, message in second.messages.items() if id not in first.messages)
    topics = sorted({*only_first, *only_second})
    rows = [(topic, str(only_first[topic]), str(only_second[topic])) for topic in topics]
    return table(("topic", "only in A", "only in B"), rows)


def _origins(first: Recording, second: Recording) -> Iterator[str]:
    """What may explain a difference."""
    for name in ("name", "seed", "settings", "revision", "runner", "fingerprint"):
        pair = first.run.get(name, ""), second.run.get(name, "")
        if pair[0] != pair[1]:
            yield f"{name}: {pair[0] or 'unknown'} and {pair[1] or 'unknown'}"
    ours, theirs = (recording.aspect("packages", dict[str, str]()) for recording in (first, second))
    yield from changes(ours, theirs, sorted({*ours, *theirs}, key=str.lower))
