"""What a new process is told of those before it."""

import contextlib
import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from runner.graph.graph import Node
from runner.graph.reading import load_graph
from runner.message.codec import Step
from runner.message.packet import Process
from runner.supervise.child import Progress
from runner.supervise.launch import Launcher, Run
from tests.runner.common.runs import TOYS


def test_steps_may_be_noted_while_a_successor_is_told_of_those_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}",))
    run = Run("toys-1", graph, tmp_path / "toys-1.mcap", (), "", "", None, steps_only=False)
    launcher: Any = Launcher(run, None, cast("Any", SimpleNamespace(close=lambda: None)), lambda: False)
    progress, numbers = Progress(), itertools.count()

    def note(*_: object) -> bool:
        id = next(numbers)
        consumed, emitted = (("piece", f"splitter.piece#{id}"),), (f"worker.answer#{id}",)
        progress.note(Step("worker", 0, 0, id, "on_piece", consumed, emitted, 1, 0, 0, 0))
        return True

    note()
    monkeypatch.setattr(Node, "shares", note)
    with contextlib.closing(launcher):
        told = launcher._assignment(Process("worker", 1, 1), progress)
    assert told.consumed == (("piece", "splitter.piece", ((0, 1),)),)
    numbers_told = dict(told.numbers)
    note()
    assert told.numbers == numbers_told
