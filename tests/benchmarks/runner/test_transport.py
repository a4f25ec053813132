"""The pace that all contenders keep, and the table of what was timed."""

from pathlib import Path

from benchmarks.runner.recording_stages import Pace, beats
from benchmarks.runner.starts import cold_start
from benchmarks.runner.transport import schedule
from benchmarks.runner.transport.__main__ import lines, verdicts
from benchmarks.runner.transport.schedule import SIZES, WARM_UP, Schedule


def test_every_size_is_sent_as_often_as_wanted_and_warm_up_is_left_out(monkeypatch):
    monkeypatch.setattr(schedule, "PAUSES", (0.0,) * len(SIZES))
    course, sent = Schedule(5), []
    while not course.done:
        data = course.pause()
        course.sent_ns = 1_000
        sent.append(len(data))
        course.arrived(3_000)
    assert [sent.count(size) for size in SIZES] == [WARM_UP + 5] * 4 + [WARM_UP + 1]
    assert course.microseconds[str(SIZES[0])] == [2.0] * 5


def test_the_table_shows_medians_over_rounds_and_ratios_to_bare_zenoh():
    def times(value: float) -> dict[str, list[float]]:
        return {str(size): [value] * 3 for size in SIZES}

    found = {"bare Zenoh": [times(10), times(10), times(90)], "runner": [times(13), times(12), times(80)]}
    table = list(lines(found))
    assert len(table) == 4
    assert "13 /     13 (1.30)" in table[3]
    assert list(verdicts(found)) == [f"{size:>9} bytes: 1.30 of bare Zenoh: reached (1.5)" for size in SIZES]


def test_the_table_says_where_the_runner_is_too_slow():
    def times(value: float) -> dict[str, list[float]]:
        return {str(size): [value] for size in SIZES}

    found = {"bare Zenoh": [times(10)], "runner": [times(16)], "dora-rs": [times(15)]}
    assert next(verdicts(found)) == "       64 bytes: 1.60 of bare Zenoh: MISSED (1.5), BEHIND dora-rs (1.07)"


def test_beats_come_in_number():
    assert list(beats(Pace(hertz=1000, seconds=0.01))) == list(range(10))


def test_a_cold_start_loses_nothing(tmp_path: Path):
    assert cold_start(tmp_path)
