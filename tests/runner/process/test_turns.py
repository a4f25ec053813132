"""Handlers of a device that let others have their turn while they work."""

from pathlib import Path

from runner.testing import finish, read_until, run_graph, start_graph

WALK = """
name: walk
stages:
  way:
    stage: tests.runner.common.toys:Counter
    config: {count: 1}
  other:
    stage: tests.runner.common.toys:Counter
    config: {count: COUNT, period: 0.01}
  walker:
    stage: tests.runner.common.toys:Walker
    inputs: {number: way.number, goal: other.number}
"""


def test_what_arrives_meanwhile_is_worked_on_before_a_handler_goes_on(tmp_path: Path) -> None:
    run = run_graph(WALK.replace("COUNT", "1"), folder=tmp_path)
    assert (run.code, "arrived at 1 after" in run.output) == (0, True), run.output


def test_a_handler_that_waits_ends_with_its_run(tmp_path: Path) -> None:
    process = start_graph(WALK.replace("COUNT", "0"), folder=tmp_path)
    printed = read_until(process, " walks")
    process.terminate()
    run = finish(process, tmp_path, before=printed)
    assert "stands after" in run.output, run.output
    assert "COMPLETE" in run.output and "INCOMPLETE" not in run.output
