"""Only the report and the simulated camera read the simulator's truth: in every graph, every stage, every module."""

import ast
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from runner.contract import Stage
from runner.graph.ports import inspect_stage
from stages.camera import SimulatedCamera
from stages.messages import Snapshot
from stages.report import Report
from stages.world import BoardWorld, World

ROOT = Path(__file__).parents[1]
READERS = {SimulatedCamera, Report}
SIMULATOR = {"stages.devices.simulation", "stages.devices.simulated_robot", "stages.devices.drops"}
"""Modules that hold a simulated world."""
GRAPHS = sorted({*ROOT.glob("*.yaml"), *ROOT.glob("graphs/*.yaml"), *ROOT.glob("stages/graphs/*.yaml")})
MODULES = sorted(path for path in (ROOT / "stages").glob("*.py") if path.stem != "__init__")


def stage(reference: str) -> type[Stage]:
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)


def stages_of(module: Path) -> Iterator[type[Stage]]:
    loaded = importlib.import_module(f"stages.{module.stem}")
    for _, kind in inspect.getmembers(loaded, inspect.isclass):
        if issubclass(kind, Stage) and kind.__module__ == loaded.__name__:
            yield kind


def imported(module: Path) -> set[str]:
    """Modules that a file imports, at its top or in a function."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return found


@pytest.mark.parametrize("path", GRAPHS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_graph_sends_the_truth_to_anybody_else(path: Path) -> None:
    entries = yaml.safe_load(path.read_text())["stages"]
    kinds = {name: stage(entry["stage"]) for name, entry in entries.items()}
    truths = {
        f"{name}.{port}"
        for name, kind in kinds.items()
        for port, message in inspect_stage(kind).outputs.items()
        if message is Snapshot
    }
    for name, entry in entries.items():
        sources = {edge if isinstance(edge, str) else edge["from"] for edge in entry.get("inputs", {}).values()}
        assert not sources & truths or kinds[name] in READERS, f"{path.name}: {name} reads {sources & truths}"


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)
def test_no_stage_takes_the_truth_or_reaches_into_the_simulator(module: Path) -> None:
    for kind in stages_of(module):
        types = {port.type for port in inspect_stage(kind).inputs.values()}
        assert Snapshot not in types or kind in READERS, f"{kind.__name__} takes a Snapshot"
        assert not imported(module) & SIMULATOR or kind in {World, BoardWorld}, f"{kind.__name__} imports the simulator"


@pytest.mark.parametrize("folder", ["perception", "planning", "hand_eye"])
def test_what_perceives_and_plans_knows_no_truth(folder: str) -> None:
    for module in sorted((ROOT / "stages" / folder).glob("*.py")):
        assert not imported(module) & {"stages.messages.Snapshot", "stages.messages.sensing.Snapshot"}, module


def test_the_walk_meets_the_truth() -> None:
    assert len(GRAPHS) >= 5 and len(MODULES) >= 10
    assert {kind for module in MODULES for kind in stages_of(module)} >= READERS
