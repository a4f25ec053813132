"""How many draws of a suite were rejected, of all that were made."""

from benchmarks.robot.suites import rejections


def test_rejections_are_counted_over_all_scenes() -> None:
    said = [
        "goal scene laid out: tray, cup; 8 of 9 draws rejected: no room in sight 7, fell or slid 1",
        "start scene laid out: tray, cup",
        "goal scene laid out: mug; 1 of 2 draws rejected: fell or slid 1",
    ]
    assert rejections(said) == "9 of 12 draws rejected, 75%: no room in sight 7, fell or slid 2"
    assert rejections(said[1:2]) == "0 of 1 draws rejected, 0%"
