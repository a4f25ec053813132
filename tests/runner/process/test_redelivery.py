"""Whatever a dead process took with it, and a new one has not heard, is sent again by the recorder; nothing twice."""

from typing import Any

import msgspec
import pytest

from runner.graph.graph import Route
from runner.message.codec import Envelope, Outcome, Step
from runner.message.ids import REMEMBERED
from runner.message.packet import Process
from runner.process import redelivery
from runner.process.redelivery import Redelivery

TOPIC = "counter/number"
ROUTE = Route("number", "worker", "input", "block", queue=4, shared=False, kept=0)


class Recorder:
    """A redelivery and what it has sent, as (key, payload)."""

    def __init__(self, replicas: int = 1, **changes: Any) -> None:
        self.sent: list[tuple[str, bytes]] = []
        route = msgspec.structs.replace(ROUTE, replicas=replicas, **changes)
        self.redelivery = Redelivery({TOPIC: (route,)}, lambda key, payload, _: self.sent.append((key, payload)))

    def message(self, number: int) -> tuple[str, list[tuple[str, int, str]]]:
        id = f"counter.number#{number}"
        sealed = Envelope(id, id, 0, "Number", 1, (), msgspec.Raw(b""))
        return id, list(self.redelivery.note_message(TOPIC, sealed, id.encode()))

    def step(
        self,
        *consumed: str,
        replica: int = 0,
        outcome: Outcome = "done",
        left: tuple[str, ...] = (),
        emitted: tuple[str, ...] = (),
    ) -> None:
        pairs, others = tuple(("input", id) for id in consumed), tuple(("input", id) for id in left)
        self.redelivery.note_step(
            Step("worker", replica, 0, 0, "on", pairs, emitted, 0, 0, 0, 0, outcome=outcome, left=others)
        )

    def take(self) -> list[tuple[str, str]]:
        """(replica, id) of what was sent again."""
        sent, self.sent = self.sent, []
        return [(key.split("/")[2], payload.decode()) for key, payload in sent]


def test_a_new_process_gets_what_nobody_has_done_with():
    recorder = Recorder()
    first, second, third = (recorder.message(number)[0] for number in range(3))
    recorder.step(second)
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == [("0", first), ("0", third)]


def test_what_a_process_was_in_the_midst_of_comes_first():
    """So that it gives the same ids to the same messages."""
    recorder = Recorder()
    first, second = (recorder.message(number)[0] for number in range(2))
    begun = Envelope("worker.answer#0", second, 0, "Answer", 1, (second,), msgspec.Raw(b""))
    assert list(recorder.redelivery.note_message("worker/answer", begun, b"")) == []
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == [("0", second), ("0", first)]
    recorder.step(emitted=("worker.answer#0",))
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == [("0", first), ("0", second)]


@pytest.mark.parametrize("failed", [False, True])
def test_what_a_process_was_in_the_midst_of_comes_first_whatever_port_it_came_by(failed: bool):
    """A step that failed is no end of it: it is taken again."""
    sent: list[tuple[str, bytes]] = []
    routes = {f"counter/{port}": (Route(port, "worker", port, "block", 4, False, 0),) for port in ("a", "b")}
    redelivery = Redelivery(routes, lambda key, payload, _: sent.append((key, payload)))
    for id in ("counter.a#0", "counter.b#0", "counter.a#1", "counter.b#1"):
        envelope = Envelope(id, id, 0, "Number", 1, (), msgspec.Raw(b""))
        list(redelivery.note_message(id.partition("#")[0].replace(".", "/"), envelope, id.encode()))
    answer = Envelope("worker.answer#0", "counter.b#0", 0, "Answer", 1, ("counter.b#0",), msgspec.Raw(b""))
    list(redelivery.note_message("worker/answer", answer, b""))
    if failed:
        consumed = (("b", "counter.b#0"),)
        redelivery.note_step(Step("worker", 0, 0, 0, "on_b", consumed, (answer.id,), 0, 0, 0, 0, outcome="failed"))
    redelivery.catch_up(Process("worker", 0, 1))
    assert [payload.decode() for _, payload in sent] == ["counter.b#0", "counter.a#0", "counter.a#1", "counter.b#1"]
    assert [key.rpartition("/")[2] for key, _ in sent] == ["b", "a", "a", "b"]


def test_what_a_step_that_is_not_over_has_emitted_is_known_however_long_ago_that_was():
    """It has been worked on since, and its emitter died and has emitted it once more."""
    recorder = Recorder()
    first, _ = recorder.message(0)
    recorder.step(first)
    for number in range(1, REMEMBERED + 2):
        id, _ = recorder.message(number)
        recorder.step(id)
    assert recorder.message(0) == (first, [("worker", 0, "input")])


def test_a_new_publisher_is_told_which_parts_are_still_to_be_done():
    recorder = Recorder(replicas=2, shared=True)
    first, second, third = (recorder.message(number)[0] for number in range(3))
    recorder.step(second, replica=1)
    assert list(recorder.redelivery.undone("counter")) == [("worker", "input", first), ("worker", "input", third)]
    assert list(recorder.redelivery.undone("worker")) == []


def test_what_a_dead_publisher_has_sent_is_sent_to_who_may_lack_it():
    recorder = Recorder(replicas=2)
    first, second = (recorder.message(number)[0] for number in range(2))
    recorder.step(first, replica=1)
    recorder.redelivery.lost(Process("counter", 0), [Process("worker", 0), Process("worker", 1), Process("sink", 0)])
    assert sorted(recorder.take()) == [("0", first), ("0", second), ("1", second)]


def test_parts_are_done_with_by_any_replica():
    recorder = Recorder(replicas=2, shared=True)
    first, second = (recorder.message(number)[0] for number in range(2))
    recorder.step(first, replica=1)
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == [("0", second)]


def test_what_joins_keep_is_sent_again_though_it_was_used():
    recorder = Recorder(kept=1)
    first, second = (recorder.message(number)[0] for number in range(2))
    recorder.step(first)
    recorder.step(second)
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == [("0", second)]


@pytest.mark.parametrize(("outcome", "again"), [("failed", True), ("ended", True), ("done", False)])
def test_what_was_refused_is_done_with_and_what_a_failed_step_or_an_end_leaves_is_not(outcome: Outcome, again: bool):
    recorder = Recorder()
    id, _ = recorder.message(0)
    if outcome == "failed":
        recorder.step(id, outcome=outcome)
    else:
        recorder.step(outcome=outcome, left=(id,))
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == ([("0", id)] if again else [])


def test_a_message_that_was_consumed_before_it_came_is_answered_when_it_comes():
    """Its publisher was killed before the recorder had it, and its successor sends it once more."""
    recorder = Recorder()
    recorder.step("counter.number#0")
    assert recorder.message(0) == ("counter.number#0", [("worker", 0, "input")])
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == []


def test_only_the_newest_of_what_was_consumed_before_it_came_are_remembered():
    """Most never come: their publisher and the link to it are gone."""
    recorder = Recorder()
    for number in range(REMEMBERED + 1):
        recorder.step(f"counter.number#{number}")
    assert [len(recorder.message(number)[1]) for number in (REMEMBERED, 1, 0)] == [1, 1, 0]


def test_a_message_that_comes_again_after_it_was_consumed_is_answered():
    recorder = Recorder()
    id, answered = recorder.message(0)
    assert answered == []
    assert recorder.message(0)[1] == []
    recorder.step(id)
    assert recorder.message(0)[1] == [("worker", 0, "input")]
    recorder.redelivery.catch_up(Process("worker", 0, 1))
    assert recorder.take() == []


def test_of_policy_latest_only_the_newest_is_offered_again(monkeypatch: pytest.MonkeyPatch):
    now = 100.0
    monkeypatch.setattr(redelivery.time, "monotonic", lambda: now)
    recorder = Recorder(policy="latest")
    for number in range(3):
        recorder.message(number)
    recorder.redelivery.offer_latest()
    assert recorder.take() == []
    offered: list[float] = []
    for tick in range(60):
        now = 100 + tick / 10
        recorder.redelivery.offer_latest()
        offered += [now - 100 for _, id in recorder.take() if id == "counter.number#2"]
    assert len(offered) == 3
    recorder.step("counter.number#2")
    now = 1000.0
    recorder.redelivery.offer_latest()
    assert recorder.take() == []
