"""Compares two recordings message by message: where they differ first, and how every field of every topic differs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from runner.inspect.compare import Difference, differences
from runner.inspect.info import table
from runner.inspect.summary import Summary
from runner.message.codec import CodecError, Envelope, decode_untyped
from runner.message.ids import MessageId
from runner.recording.provenance import changed_packages
from runner.recording.recording import Recording

HEADER = ("lineage", "type", "version", "causes")
"""What is compared of an envelope beside its body. Logical times of devices are the wall clock's: those of two runs
always differ."""
IDENTICAL, DIFFERENT = 0, 1


def diff(a: Path, b: Path, say: Callable[[str], None] = print) -> int:
    """Says how two recordings differ; returns 1 where they do. Raises Refused where one is no recording."""
    first, second = Recording(a), Recording(b)
    for recording in (first, second):
        say(f"{recording.path}: {len(recording.messages)} messages, {recording.verdict}")
    for line in _origins(first, second):
        say(line)
    summary = Summary()
    found = list(_found(first, second, summary))
    say(f"first difference: {found[0]}" if found else _equal(first))
    for block in (_counts(first, second), summary.lines()):
        for line in ["", *block] if block else []:
            say(line)
    return DIFFERENT if found else IDENTICAL


def _found(first: Recording, second: Recording, summary: Summary) -> Iterator[str]:
    """One line per message that differs, in the order of the first recording."""
    for id in first.messages:
        if id not in second.messages:
            yield f"{id}: only in {first.path}"
            continue
        changes = list(message_differences(first.recorded(id), second.recorded(id)))
        if summary.add(MessageId.of(id).topic, id, changes):
            yield f"{id}: {_words(changes[0])}"
    yield from (f"{id}: only in {second.path}" for id in second.messages if id not in first.messages)


def message_differences(first: Envelope, second: Envelope) -> Iterator[Difference]:
    """Every header and field that differs, without the need of the message's class."""
    for name in HEADER:
        yield from differences(getattr(first, name), getattr(second, name), name)
    if bytes(first.body) == bytes(second.body):
        return
    try:
        yield from differences(decode_untyped(first.body), decode_untyped(second.body))
    except CodecError as error:
        yield Difference("body", "", "", f"cannot be read: {error}")


def _words(difference: Difference) -> str:
    extent = f" ({difference.extent})" if difference.extent else ""
    return f"{difference.field}: {difference.recorded} and {difference.replayed}{extent}"


def _equal(recording: Recording) -> str:
    return f"no difference: {len(recording.messages)} messages are equal"


def _counts(first: Recording, second: Recording) -> list[str]:
    """Topics of which one recording holds more messages than the other."""
    ids = (first.messages.keys() - second.messages.keys(), second.messages.keys() - first.messages.keys())
    counts = [Counter(MessageId.of(id).topic for id in side) for side in ids]
    rows = [(topic, *(str(count[topic]) for count in counts)) for topic in sorted({*counts[0], *counts[1]})]
    return table(("topic", "only in A", "only in B"), rows)


def _origins(first: Recording, second: Recording) -> Iterator[str]:
    """What may explain a difference."""
    for name in ("name", "seed", "settings", "revision", "runner", "fingerprint"):
        pair = first.run.get(name, ""), second.run.get(name, "")
        if pair[0] != pair[1]:
            yield f"{name}: {pair[0] or 'unknown'} and {pair[1] or 'unknown'}"
    packages = [recording.aspect("packages", dict[str, str]()) for recording in (first, second)]
    yield from changed_packages(*packages)
