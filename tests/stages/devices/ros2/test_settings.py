"""Settings that would never work are refused before anything listens."""

from typing import Any

import pytest

from runner.contract import Refused
from stages.devices.ros2.settings import Care, Patience, Source


@pytest.mark.parametrize(
    ("kind", "name", "value", "says"),
    [
        (Source, "slop", -1.0, r"topics\.slop = -1: must be 0 or more"),
        (Source, "slop", float("nan"), r"topics\.slop = nan: must be 0 or more"),
        (Patience, "warn", 0.0, r"patience\.warn = 0: must be above 0"),
        (Patience, "give_up", -5.0, r"patience\.give_up = -5: must be 0 or more"),
        (Patience, "max_age", float("nan"), r"patience\.max_age = nan: must be above 0"),
        (Patience, "settle", float("inf"), r"patience\.settle = inf: must be 0 or more, below 1e\+09"),
        (Care, "stuck", float("nan"), r"care\.stuck = nan: must be above 0"),
    ],
)
def test_what_is_no_time_is_refused(kind: Any, name: str, value: float, says: str) -> None:
    with pytest.raises(Refused, match=says):
        kind(**{name: value})


def test_nothing_may_be_waited_for_or_differ() -> None:
    assert (Source(slop=0.0).slop, Patience(give_up=0.0, settle=0.0).give_up) == (0, 0)
