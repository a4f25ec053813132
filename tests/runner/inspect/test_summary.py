import numpy as np

from runner.inspect.compare import differences
from runner.inspect.summary import Summary
from tests.runner.common.toys import Answer


def answer(*samples: float, index: int = 0) -> Answer:
    return Answer(index=index, count=2, samples=np.array(samples, np.float64))


def test_counts_messages_by_field_and_keeps_the_largest_difference():
    summary = Summary()
    assert not summary.add("worker/answer", "worker.answer#0", differences(answer(1, 2), answer(1, 2)))
    assert summary.add("worker/answer", "worker.answer#1", differences(answer(1, 2), answer(1, 2.5)))
    assert summary.add("worker/answer", "worker.answer#2", differences(answer(1, 2), answer(4, 2, index=1)))
    index, samples = sorted(summary.changes, key=lambda change: change.field)
    assert (index.field, index.messages, index.largest) == ("index", 1, 1.0)
    assert (samples.field, samples.messages, samples.largest) == ("samples[]", 2, 3.0)
    assert samples.first == "worker.answer#1"
    assert summary.lines()[1].split() == ["worker/answer", "samples[]", "2", "of", "3", "3", "worker.answer#1"]


def test_indices_of_one_message_are_one_change_and_text_has_no_magnitude():
    summary = Summary()
    summary.add("a/b", "a.b#0", differences(({"x": 1.0}, {"x": 2.0}), ({"x": 1.5}, {"x": 4.5})))
    summary.add("a/c", "a.c#0", differences("left", "right"))
    numbers, text = summary.changes
    assert (numbers.field, numbers.messages, numbers.largest) == ("[]['x']", 1, 2.5)
    assert (text.largest, summary.lines()[-1].split()[-2]) == (None, "-")


def test_what_processes_found_is_merged():
    parts = [Summary(), Summary()]
    parts[0].add("a/b", "a.b#0", differences(1.0, 2.0))
    parts[1].add("a/b", "a.b#1", differences(1.0, 5.0))
    merged = Summary(change for part in parts for change in part.changes)
    assert [(change.messages, change.largest, change.first) for change in merged.changes] == [(2, 4.0, "a.b#0")]


def test_a_number_that_became_nan_is_infinitely_far():
    summary = Summary()
    summary.add("a/b", "a.b#0", differences(answer(1.0, np.nan), answer(np.nan, np.nan)))
    assert summary.changes[0].largest == np.inf
