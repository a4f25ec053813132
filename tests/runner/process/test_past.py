"""What a stage knew is given back whole or not at all."""

from pathlib import Path

import pytest

from runner.contract import Refused
from runner.message.codec import Envelope, Step
from runner.process.past import past_of
from runner.recording.recording import Recording
from tests.runner.common.recordings import record_toys


def test_a_past_of_which_steps_are_not_recorded_is_refused(tmp_path: Path):
    """The disk was full before the process died."""

    def keep(record: Envelope | Step) -> Envelope | Step | None:
        written = not isinstance(record, Step) or record.stage != "gatherer" or record.number < 3
        return record if written else None

    path, _ = record_toys(tmp_path, "counter.count=5", keep=keep)
    recording = Recording(path)
    assert [step.number for step in past_of(recording, "gatherer", 1, done=3)] == [0, 1, 2]
    with pytest.raises(Refused, match=r"gatherer cannot be brought back to where it was: 3 of 5 steps are recorded in"):
        past_of(recording, "gatherer", 1, done=5)
