"""What a graph's stages need of the machine is asked of them, each in a process of its own."""

import os
import signal
from pathlib import Path

import pytest

from runner.cli.doctor import Finding, examine_graph
from runner.contract import Finished, Refused, Stage


class Plain(Stage):
    """Needs nothing that is no package."""

    def on_start(self) -> Finished:
        return Finished(code=0, reason="done")


class Served(Plain):
    @classmethod
    def examine(cls) -> str:
        return "a lamp is lit"


class Lacking(Plain):
    @classmethod
    def examine(cls) -> str:
        raise Refused("there is no lamp; type: apt-get install lamp")


class Broken(Plain):
    @classmethod
    def examine(cls) -> str:
        os.kill(os.getpid(), signal.SIGSEGV)
        return ""


def examined(folder: Path, stage: type[Stage]) -> list[Finding]:
    path = folder / "graph.yaml"
    path.write_text(f"name: one\nstages:\n  one: {{stage: '{__name__}:{stage.__name__}'}}\n")
    whole, *rest = examine_graph(path)
    assert whole.judgement == "good"
    return rest


def test_a_stage_that_needs_nothing_is_not_asked(tmp_path: Path):
    assert examined(tmp_path, Plain) == []


@pytest.mark.parametrize(
    ("stage", "judgement", "text"),
    [
        (Served, "good", "a lamp is lit"),
        (Lacking, "bad", "there is no lamp; type: apt-get install lamp"),
        (Broken, "bad", "its process ended with -11"),
    ],
)
def test_a_stage_says_what_the_machine_lacks(tmp_path: Path, stage: type[Stage], judgement: str, text: str):
    (found,) = examined(tmp_path, stage)
    assert (found.judgement, found.subject, found.text) == (judgement, "one", text)
