"""Planning and acting on the simulator's truth, without perception."""

import pytest

from benchmarks.robot import acting


def test_equal_objects_are_restored(capsys: pytest.CaptureFixture[str]):
    acting.main(["--suite", "twins", "302"])
    line = capsys.readouterr().out
    assert line.startswith("twins 302: restored, 2 of 2 transfers")
