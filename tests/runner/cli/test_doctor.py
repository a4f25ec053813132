"""What a graph's stages need of the machine is asked of them, each in a process of its own."""

import os
import signal
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from runner.cli import doctor
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


def test_what_a_container_keeps_of_files_is_memory_that_can_be_had(monkeypatch: pytest.MonkeyPatch):
    says = {"memory.max": "8000000000", "memory.current": "7600000000", "memory.stat": "inactive_file 3000000000"}
    monkeypatch.setattr(doctor, "_group_text", lambda name: says[name])
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=10**11))
    found = doctor._memory()
    assert (found.judgement, found.text) == ("good", "3.4 GB available, the control group allows 8 GB")


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
