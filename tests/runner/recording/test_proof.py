"""COMPLETE is proved: whatever is missing from a recording, or stands elsewhere, is found and named."""

import json
import pickle
import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from runner.contract import Refused, Restarted
from runner.graph.reading import load_graph
from runner.message.codec import Envelope, LogLine, Lost, Step, envelope, unpack
from runner.recording import proof as proof_module
from runner.recording.proof import Proof, in_short
from runner.recording.recording import RUN, VERDICT, Recording, payload_kind
from runner.recording.recover import recover
from tests.runner.common.recordings import TOYS, Recorded, ToyRun, record

# ------------------------------------------------------------------------------------ the rules, one by one

GRAPH: dict[str, Any] = {
    "stages": {
        "camera": {"replicas": 1, "commands": ["look"]},
        "filter": {
            "replicas": 2,
            "inputs": {"part": {"from": "camera.part"}, "frame": {"from": "camera.frame", "policy": "block"}},
            "shares": ["part"],
        },
        "view": {"inputs": {"frame": {"from": "camera.frame", "policy": "latest"}}},
    }
}
ENDS = [("camera", 0), ("filter", 0), ("filter", 1), ("view", 0), ("supervisor", 0)]


def step(process: str, number: int, consumed: str = "", emitted: str = "", left: str = "", **fields: Any) -> Step:
    """A step of ``stage/replica/incarnation``; ids are parted by blanks, and inputs named like outputs."""
    stage, replica, incarnation = process.split("/")
    consumed_ids, left_ids = (tuple((_input(id), id) for id in text.split()) for text in (consumed, left))
    made = Step(stage, int(replica), int(incarnation), number, "on", consumed_ids, tuple(emitted.split()), 0, 0, 0, 0)
    return msgspec.structs.replace(made, left=left_ids, **fields)


def _input(id: str) -> str:
    return id.partition("#")[0].rpartition(".")[2].removeprefix("camera_")


def end(process: str, number: int, left: str = "") -> Step:
    return step(process, number, left=left, outcome="ended")


def lost(process: str) -> Lost:
    stage, replica, incarnation = process.split("/")
    return Lost(stage, int(replica), int(incarnation), "killed", 0)


def ended(*but: str) -> list[Step]:
    """The end of every process that has done nothing else."""
    return [end(f"{stage}/{replica}/0", 0) for stage, replica in ENDS if f"{stage}/{replica}/0" not in but]


def prove(*records: str | Step | Lost) -> tuple[list[str], tuple[str, ...]]:
    """Findings and missing ids of a recording of these records in this order."""
    proof = Proof(GRAPH)
    for time_ns, one in enumerate(records):
        proof.enter("topic", time_ns, one)
    return list(proof.problems()), proof.missing()


ALL_WELL = [
    "camera.frame#0",
    "camera.part#0",
    "camera.part#1",
    step("camera/0/0", 0, emitted="camera.frame#0 camera.part#0 camera.part#1"),
    "filter.pose#0",
    step("filter/0/0", 0, consumed="camera.part#0 camera.frame#0", emitted="filter.pose#0"),
    "filter.pose#1",
    step("filter/1/0", 0, consumed="camera.part#1 camera.frame#0", emitted="filter.pose#1"),
    end("camera/0/0", 1),
    end("filter/0/0", 1),
    end("filter/1/0", 1),
    *ended("camera/0/0", "filter/0/0", "filter/1/0"),
]


def test_nothing_is_found_where_nothing_is_missing():
    assert prove(*ended()) == prove(*ALL_WELL) == ([], ())


def test_records_that_do_not_follow_each_other_are_named():
    proof = Proof(GRAPH)
    for time_ns, one in zip((5, 6, 6, 4, 7), ("camera.part#0", *ended()), strict=False):
        proof.enter("journal/camera", time_ns, one)
    assert next(proof.problems()) == "out of order: step 0 of filter/0/0, step 0 of filter/1/0"


def test_a_message_that_no_step_emitted_is_named_unless_its_publisher_was_lost_after_it():
    found, missing = prove("camera.frame#0", *ended())
    assert (found, missing) == (["no step emitted camera.frame#0"], ())
    rest = ended("camera/0/0")
    assert prove("camera.frame#0", lost("camera/0/0"), *rest) == ([], ())
    assert prove(lost("camera/0/0"), "camera.frame#0", *rest)[0] == ["no step emitted camera.frame#0"]


def test_what_a_step_emitted_or_consumed_is_missing_where_it_is_not_recorded():
    emits = step("camera/0/0", 0, emitted="camera.frame#0 camera.frame#1")
    rest = [end("camera/0/0", 1), *ended("camera/0/0", "filter/0/0", "filter/1/0")]
    takes = [end(f"filter/{replica}/0", 0, left="camera.frame#0") for replica in (0, 1)]
    assert prove("camera.frame#0", emits, *takes, *rest) == ([], ("camera.frame#1",))
    consumes = step("view/0/0", 0, consumed="camera.frame#3")
    assert prove(consumes, end("view/0/0", 1), *ended("view/0/0"))[1] == tuple(f"camera.frame#{n}" for n in range(4))


def test_steps_may_come_before_the_messages_that_they_name():
    assert prove(*[one for one in ALL_WELL if not isinstance(one, str)], *filter(_is_id, ALL_WELL)) == ([], ())


def _is_id(one: str | Step) -> bool:
    return isinstance(one, str)


def test_every_message_is_consumed_or_left_at_each_end_of_its_edges():
    frame = ["camera.frame#0", step("camera/0/0", 0, emitted="camera.frame#0"), end("camera/0/0", 1)]
    rest = ended("camera/0/0", "filter/0/0", "filter/1/0")
    left = [end("filter/0/0", 0, left="camera.frame#0"), end("filter/1/0", 0, left="camera.frame#0")]
    assert prove(*frame, *left, *rest) == ([], ())
    found, _ = prove(*frame, left[0], end("filter/1/0", 0), *rest)
    assert found == ["filter[1].frame neither consumed nor left camera.frame#0"]


def test_a_part_goes_to_one_of_the_replicas():
    parts = [step("camera/0/0", 0, emitted="camera.part#0 camera.part#1"), end("camera/0/0", 1)]
    rest = ended("camera/0/0", "filter/1/0")
    takes = [step("filter/1/0", 0, consumed="camera.part#0"), end("filter/1/0", 1)]
    found, _ = prove("camera.part#0", "camera.part#1", *parts, *takes, *rest)
    assert found == ["filter.part neither consumed nor left camera.part#1"]


def test_what_is_done_twice_is_named():
    sent = ["camera.frame#0", step("camera/0/0", 0, emitted="camera.frame#0"), end("camera/0/0", 1)]
    rest = [end("filter/1/0", 0, left="camera.frame#0"), *ended("camera/0/0", "filter/0/0", "filter/1/0")]
    once, again = (step("filter/0/0", number, consumed="camera.frame#0") for number in (0, 1))
    found, _ = prove(*sent, once, again, end("filter/0/0", 2), *rest)
    assert found == ["step 1 of filter/0/0 has done camera.frame#0 again"]
    stopped = msgspec.structs.replace(once, outcome="stopped")
    successor = [msgspec.structs.replace(once, incarnation=1), end("filter/0/1", 1)]
    assert prove(*sent, stopped, lost("filter/0/0"), *successor, *rest)[0] == []


def test_what_is_joined_may_be_part_of_several_steps():
    emitted = "camera.frame#0 camera.part#0 camera.part#1"
    sent = [*emitted.split(), step("camera/0/0", 0, emitted=emitted), end("camera/0/0", 1)]
    parts = [step("filter/0/0", number, consumed=f"camera.part#{number} camera.frame#0") for number in (0, 1)]
    rest = [end("filter/1/0", 0, left="camera.frame#0"), *ended("camera/0/0", "filter/0/0", "filter/1/0")]
    assert prove(*sent, *parts, end("filter/0/0", 2), *rest)[0] == []


def test_a_command_is_for_the_stage_that_has_it():
    called = ["supervisor.camera_look#0", step("supervisor/0/0", 0, emitted="supervisor.camera_look#0")]
    rest = [end("supervisor/0/0", 1), *ended("supervisor/0/0", "camera/0/0")]
    assert prove(*called, step("camera/0/0", 0, "supervisor.camera_look#0"), end("camera/0/0", 1), *rest) == ([], ())
    found, _ = prove(*called, end("camera/0/0", 0), *rest)
    assert found == ["camera.look neither consumed nor left supervisor.camera_look#0"]


def test_nobody_need_have_what_a_process_that_was_not_replaced_would_have_got():
    frame = ["camera.frame#0", step("camera/0/0", 0, emitted="camera.frame#0"), end("camera/0/0", 1)]
    rest = [end("filter/0/0", 0, left="camera.frame#0"), *ended("camera/0/0", "filter/0/0", "filter/1/0")]
    assert prove(*frame, lost("filter/1/0"), *rest) == ([], ())
    found, _ = prove(*frame, lost("filter/1/0"), end("filter/1/1", 0), *rest)
    assert found == ["filter[1].frame neither consumed nor left camera.frame#0"]


def test_missing_steps_and_ends_are_named():
    steps = [step("camera/0/0", 0), step("camera/0/0", 2), step("camera/0/0", 5)]
    found, _ = prove(*steps, *ended("camera/0/0", "view/0/0"))
    assert found == [
        "camera/0/0 has no step 1",
        "camera/0/0 has no step 3 to 4",
        "nothing says how camera/0/0 ended",
        "nothing says how view/0/0 ended",
    ]
    assert prove(lost("view/0/2"), *ended("view/0/0"))[0] == ["nothing says how view/0/0 to 1 ended"]
    assert prove(*ended(), step("view/0/0", 1))[0] == ["view/0/0 went on after its end, step 0"]


def test_numbers_of_messages_have_no_gaps_except_where_replicas_answer_parts():
    emits = [step("camera/0/0", 0, emitted="camera.depth#2"), step("filter/0/0", 0, emitted="filter.pose#2")]
    rest = [end("camera/0/0", 1), end("filter/0/0", 1), *ended("camera/0/0", "filter/0/0")]
    assert prove("camera.depth#2", "filter.pose#2", *emits, *rest) == ([], ("camera.depth#0", "camera.depth#1"))


def test_two_messages_of_one_id_are_named():
    def found(*contents: int) -> list[str]:
        proof = Proof(GRAPH)
        for time_ns, content in enumerate(contents):
            proof.enter("camera/frame", time_ns, "camera.frame#0", content)
            proof.step(step("camera/0/0", time_ns, emitted="camera.frame#0", outcome="failed"))
        return [problem for problem in proof.problems() if "two messages" in problem]

    assert found(1, 1) == []
    assert found(1, 2) == ["two messages have the id camera.frame#0"]


def test_every_topic_has_as_many_records_as_came():
    proof = Proof(GRAPH)
    for time_ns, one in enumerate(ended()):
        proof.enter("journal/all", time_ns, one)
    proof.drop("log/camera", LogLine("camera", 0, "info", "hello", 0))
    assert proof.counts == {"journal/all": 5, "log/camera": 1}
    assert list(proof.problems()) == ["log/camera has 0 of 1 records"]
    assert list(proof.problems({"journal/all": 4})) == ["journal/all has 5 of 4 records"]


def test_what_could_not_be_kept_is_missing():
    proof = Proof(GRAPH)
    for time_ns, one in enumerate(ended("camera/0/0")):
        proof.enter("topic", time_ns, one)
    proof.drop("camera/frame", "camera.frame#0")
    proof.drop("journal/camera", step("camera/0/0", 1, emitted="camera.frame#1"))
    assert proof.missing() == ("camera.frame#0", "camera.frame#1")
    assert "camera/0/0 has no step 0 to 1" in list(proof.problems())


def test_the_first_few_findings_and_how_many_more():
    assert in_short([]) == ""
    assert in_short("abc") == "a; b; c"
    assert in_short("abcde") == "a; b; c; and 2 more"


def test_absurd_numbers_take_no_memory():
    found, missing = prove(
        "camera.frame#999999999999999",
        step("camera/0/999999999", 999999999, consumed="camera.part#999999999999999"),
        *ended(),
    )
    assert len(missing) == proof_module.MOST_NAMED
    assert any("0 to 999999998" in line for line in found)


# ------------------------------------------------------------------------------------ bounded memory


def long_run(length: int, every: int) -> Iterator[str | Step]:
    """A camera's frames and parts, of which replicas answer every few; all in a slightly shuffled order."""
    rng = random.Random(0)
    numbers = Counter[str]()
    waiting: list[list[str | Step]] = []
    for number in range(length):
        frame, part, pose = f"camera.frame#{number}", f"camera.part#{number}", f"filter.pose#{number}"
        replica, answers = number % 2, number % every == 0
        taken = step(f"filter/{replica}/0", numbers[f"{replica}"], f"{part} {frame}", pose if answers else "")
        unused = step(f"filter/{1 - replica}/0", numbers[f"{1 - replica}"], left=frame)
        numbers.update("01")
        seen = [step("view/0/0", number // 3, consumed=frame)] if number % 3 == 0 else []
        sent = step("camera/0/0", number, emitted=f"{frame} {part}")
        waiting.append([frame, part, sent, *([pose] if answers else []), taken, unused, *seen])
        while len(waiting) > 20 or (waiting and number == length - 1):
            records = rng.choice(waiting)
            yield records.pop(rng.randrange(min(2, len(records))))
            waiting = [records for records in waiting if records]


@pytest.mark.parametrize("every", [1, 7])
def test_memory_does_not_grow_with_the_run(monkeypatch: pytest.MonkeyPatch, every: int):
    monkeypatch.setattr(proof_module, "MOST_RANGES", 64)
    proof = Proof(GRAPH)
    sizes: list[int] = []
    for time_ns, one in enumerate(long_run(12_000, every)):
        proof.enter("topic", time_ns, one)
        if time_ns % 10_000 == 0:
            sizes.append(len(pickle.dumps(proof)))
    assert max(sizes[3:]) < 1.5 * max(sizes[:3])
    numbers = {"camera": 12_000, "filter": 12_000, "view": 4_000, "supervisor": 0}
    for time_ns, (stage, replica) in enumerate(ENDS, 10**6):
        proof.enter("topic", time_ns, end(f"{stage}/{replica}/0", numbers[stage]))
    assert (list(proof.problems()), proof.missing()) == ([], ())


# ------------------------------------------------------------------------------------ a recording, changed anyhow


@dataclass(frozen=True)
class Message:
    """One record of a recording, as MCAP has it."""

    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes

    @property
    def names(self) -> set[str]:
        """What a finding may call it."""
        match unpack(payload_kind(self.topic), self.data):
            case Envelope(id=id):
                return {id, self.topic}
            case Step() | Lost() as one:
                return {f"{one.stage}/{one.replica}/{one.incarnation}", self.topic}
            case _:
                return {self.topic}


@dataclass(frozen=True)
class Meta:
    """The other kind of record: metadata."""

    name: str
    values: tuple[tuple[str, str], ...]

    @property
    def names(self) -> set[str]:
        return {self.name}


Items = list[Message | Meta]


def eventful(records: Iterator[Envelope | Step]) -> Iterator[Recorded]:
    """A run with two deaths, each between a recorded message and the step that sent it; one process was replaced."""
    newest = None
    for one in records:
        match one:
            case Step(stage="worker", replica=1, number=1):
                yield lost("worker/1/0")
                yield from a_restart()
                yield newest
                yield msgspec.structs.replace(one, incarnation=1, number=0)
            case Step(stage="worker", replica=1, number=number) if number > 1:
                yield msgspec.structs.replace(one, incarnation=1, number=number - 1)
            case Step(stage="supervisor" | "watcher", outcome="ended"):
                yield msgspec.structs.replace(one, number=1)
                yield LogLine(one.stage, 0, "info", "that was all", 0)
            case Step(stage="gatherer", outcome="ended"):
                yield msgspec.structs.replace(newest, id="gatherer.total#4")
                yield lost("gatherer/0/0")
            case _:
                newest = one if isinstance(one, Envelope) else newest
                yield one


def a_restart() -> Iterator[Recorded]:
    id, message = "supervisor.restarted#0", Restarted(stage="worker", replica=1, reason="killed")
    yield envelope(message, id=id, lineage=id, time_ns=0, causes=())
    yield step("supervisor/0/0", 0, emitted=id)
    yield LogLine("watcher", 0, "info", "noticed", 0)
    yield step("watcher/0/0", 0, consumed=id)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    graph = load_graph(TOYS, (f"sink.path={folder / 'out.txt'}", "splitter.parts=2", "counter.count=4"))
    path, verdict = record(graph, folder / "good.mcap", list(eventful(ToyRun(graph, folder).records())))
    assert str(verdict) == str(Recording(path).verdict) == "COMPLETE"
    assert write(read(path), folder / "copy.mcap") == "COMPLETE"
    return path


def read(path: Path) -> Items:
    with path.open("rb") as file:
        reader = make_reader(file)
        run, verdict = (Meta(one.name, tuple(one.metadata.items())) for one in reader.iter_metadata())
        messages = reader.iter_messages(log_time_order=False)
        times = ((c.topic, (m.log_time, m.publish_time, m.sequence, m.data)) for _, c, m in messages)
        return [run, *(Message(topic, *values) for topic, values in times), verdict]


def write(items: Items, path: Path) -> str:
    """Writes a file that is in order as MCAP, and returns what is said of it: its verdict or why it is refused."""
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        for item in items:
            if isinstance(item, Meta):
                writer.flush()
                writer.add_metadata(item.name, dict(item.values))
                continue
            if item.topic not in channels:
                channels[item.topic] = writer.register_channel(item.topic, "msgpack", 0)
            writer.add_message(channels[item.topic], item.log_time, item.data, item.publish_time, item.sequence)
        writer.finish()
    try:
        verdict = Recording(path).verdict
    except Refused as refused:
        return str(refused)
    return "COMPLETE" if verdict.complete else f"{verdict} {' '.join(verdict.missing)}"


def is_named(gone: Message | Meta, said: str) -> bool:
    return any(name in said for name in gone.names)


def test_each_record_that_is_dropped_is_named(good: Path, tmp_path: Path):
    items = read(good)
    for at, gone in enumerate(items):
        said = write(items[:at] + items[at + 1 :], tmp_path / "changed.mcap")
        assert said != "COMPLETE"
        assert is_named(gone, said), said


def test_each_record_that_is_doubled_or_changes_places_is_named(good: Path, tmp_path: Path):
    items = read(good)
    for at, one in enumerate(items):
        for changed in (items[: at + 1] + items[at:], [*items[:at], *items[at + 1 : at + 2], one, *items[at + 2 :]]):
            said = write(changed, tmp_path / "changed.mcap")
            assert (changed == items) == (said == "COMPLETE"), (at, one, said)


@pytest.mark.parametrize("mark", ["format", "counts"])
def test_without_the_marks_of_its_format_it_is_judged_no_milder(good: Path, tmp_path: Path, mark: str):
    items = [unmarked(item, mark) for item in read(good)]
    assert (write(items, tmp_path / "whole.mcap") == "COMPLETE") == (mark == "format")
    for at, gone in enumerate(items):
        said = write(items[:at] + items[at + 1 :], tmp_path / "changed.mcap")
        assert said != "COMPLETE"
        assert is_named(gone, said) or mark == "counts", said


def unmarked(item: Message | Meta, mark: str) -> Message | Meta:
    """Nor with the hash of the run, in which the mark may be."""
    kept = (one for one in item.values if one[0] not in (mark, "run")) if isinstance(item, Meta) else ()
    return replace(item, values=tuple(kept)) if isinstance(item, Meta) else item


PLACES = st.integers(0, 10_000)
CHANGES = st.lists(
    st.tuples(st.sampled_from(("drop", "cut", "end", "move", "copy", "swap")), PLACES, PLACES), min_size=1, max_size=3
)
ANYHOW = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.filter_too_much])


def changed(items: Items, changes: list[tuple[str, int, int]]) -> Items:
    items = list(items)
    for what, one, other in changes:
        if not items:
            break
        first, second = one % len(items), other % len(items)
        match what:
            case "drop":
                del items[first]
            case "cut":
                del items[min(first, second) : max(first, second)]
            case "end":
                del items[first:]
            case "move":
                items.insert(second, items.pop(first))
            case "copy":
                items.insert(second, items[first])
            case _:
                items[first], items[second] = items[second], items[first]
    return items


def topics(items: Items) -> Counter[str]:
    return Counter(map(topic_of, items))


def topic_of(item: Message | Meta) -> str:
    return item.topic if isinstance(item, Message) else item.name


def check(good: Path, folder: Path, changes: list[tuple[str, int, int]]) -> None:
    items = read(good)
    now = changed(items, changes)
    assume(now != items)
    with mock.patch.object(proof_module, "FEW", len(items)):  # a verdict shows a few findings; here all are asked for
        said = write(now, folder / "changed.mcap")
    assert said != "COMPLETE"
    gone = Counter(items) - Counter(now)
    fewer = topics(items) - topics(now)
    named = {one for one in gone if is_named(one, said)}
    if not fewer:
        assert named or any(word in said for word in ("out of order", "records", "metadata")), said
    elif {RUN, VERDICT} & fewer.keys():  # with these goes what was to be there
        assert named, said
    else:
        assert [one for one in gone if topic_of(one) in fewer and one not in named] == [], said


@given(changes=CHANGES)
@settings(ANYHOW, max_examples=100)
def test_no_change_goes_unnoticed(good: Path, tmp_path: Path, changes: list[tuple[str, int, int]]):
    check(good, tmp_path, changes)


@pytest.mark.slow
@given(changes=CHANGES)
@settings(ANYHOW, max_examples=2000)
def test_not_one_of_many_changes_goes_unnoticed(good: Path, tmp_path: Path, changes: list[tuple[str, int, int]]):
    check(good, tmp_path, changes)


def test_what_is_recovered_of_a_changed_recording_is_judged_as_that_was(good: Path, tmp_path: Path):
    items = read(good)
    for at in range(0, len(items) - 1, 7):
        path = tmp_path / f"{at}.mcap"
        write(items[: at + 1] + items[at + 2 :], path)
        before, target = recover(path)
        after = Recording(target)
        assert str(after.verdict) == str(before.verdict) != "COMPLETE"
        assert after.metadata[VERDICT]["verdict"] == "INCOMPLETE"
        assert json.loads(after.metadata[VERDICT]["counts"]) == json.loads(before.metadata[VERDICT]["counts"])
        assert after.metadata[RUN] == before.metadata[RUN]
