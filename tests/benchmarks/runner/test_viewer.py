"""The viewer's benchmark: what it runs and what it counts."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.runner import viewer
from stages.devices.bop_results import HEADER


def test_counts_the_time_of_all_images_but_the_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], **_: Any) -> None:
        commands.append(command)
        rows = [
            f"{scene},0,1,0.9,1 0 0 0 1 0 0 0 1,0 0 0,{time}" for scene, time in ((1, -1), (2, 1.5), (2, 1.5), (3, 2))
        ]
        (tmp_path / "results.csv").write_text("\n".join([HEADER, *rows]) + "\n")

    monkeypatch.setattr(subprocess, "run", run)
    assert viewer.seconds(Path("data"), tmp_path, ["particle_filter.dof=3"], view=True) == 3.5
    assert "--view" in commands[0] and "particle_filter.dof=3" in commands[0]


def test_runs_with_and_without_in_turns(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    views: list[bool] = []

    def seconds(*_: Any, view: bool) -> float:
        views.append(view)
        return 10.2 if view else 10.0

    monkeypatch.setattr(viewer, "seconds", seconds)
    monkeypatch.setattr(sys, "argv", ["viewer", "data", "--rounds", "2"])
    viewer.main()
    assert views == [False, True, True, False]
    assert "ratio of medians 1.020" in capsys.readouterr().out
