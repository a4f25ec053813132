"""Only the report and the simulated camera read the simulator's truth: in every graph, every stage, and every module
that these import, however deep."""

import ast
import importlib
import inspect
from collections.abc import Iterator
from itertools import accumulate
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
WORLDS = {World, BoardWorld}
TRUTH = Snapshot.__name__
SIMULATOR = {"stages.devices.simulation", "stages.devices.simulated_robot", "stages.devices.drops"}
"""Modules that hold a simulated world."""
ALL = "stages.messages.*"
GRAPHS = sorted({*ROOT.glob("*.yaml"), *ROOT.glob("graphs/*.yaml"), *ROOT.glob("stages/graphs/*.yaml")})
PACKAGES = ["geometry", "hand_eye", "perception", "planning", "robots", "story"]
"""Of the stages: their modules know no truth, whoever imports them."""


class Walk:
    """Python modules below a folder, and what they import from there; ``without`` some classes (``module:Class``)."""

    def __init__(self, root: Path, without: set[str]) -> None:
        self._root, self._without = root, without
        self._trees: dict[str, ast.Module] = {}

    def modules(self, package: str) -> list[str]:
        """All of a package and of the packages in it."""
        paths = self._root.joinpath(*package.split(".")).rglob("*.py")
        names = (".".join(path.relative_to(self._root).with_suffix("").parts) for path in paths)
        return sorted(name.removesuffix(".__init__") for name in names)

    def reading(self, *modules: str) -> dict[str, set[str]]:
        """What of the truth is named by modules or by what they import, at the top or in a function."""
        found: dict[str, set[str]] = {}
        seen, ahead = set[str](), list(modules)
        while ahead:
            module = ahead.pop()
            if module in seen or self._file(module) is None or module.startswith("stages.messages"):
                continue
            seen.add(module)
            ahead += self._imported(module)
            if read := (self._named(module) & {TRUTH}) | (self._imported(module) & {*SIMULATOR, ALL}):
                found[module] = read
        return found

    def _imported(self, module: str) -> set[str]:
        """Modules, the packages that they are in, and names in them."""
        found: set[str] = set()
        for node in ast.walk(self._tree(module)):
            if isinstance(node, ast.ImportFrom):
                assert node.module and not node.level, f"{module} imports by a relative name"
                found |= {f"{node.module}.{name.name}" for name in node.names}
            elif isinstance(node, ast.Import):
                found |= {name.name for name in node.names}
        return {package for name in found for package in accumulate(name.split("."), "{}.{}".format)}

    def _named(self, module: str) -> set[object]:
        """Names, attributes and texts; and what is imported, but beside a class that is left out, and may need it."""
        keys = ["id", "attr", "value"]
        keys += [] if any(one.startswith(f"{module}:") for one in self._without) else ["name"]
        return {getattr(node, key, None) for node in ast.walk(self._tree(module)) for key in keys}

    def _tree(self, module: str) -> ast.Module:
        if module not in self._trees:
            file = self._file(module)
            assert file is not None, module
            tree = ast.parse(file.read_text())
            tree.body = [node for node in tree.body if f"{module}:{getattr(node, 'name', '')}" not in self._without]
            self._trees[module] = tree
        return self._trees[module]

    def _file(self, module: str) -> Path | None:
        path = self._root.joinpath(*module.split("."))
        return next(filter(Path.is_file, (path.with_suffix(".py"), path / "__init__.py")), None)


WALK = Walk(ROOT, {f"{kind.__module__}:{kind.__name__}" for kind in READERS})
STAGES = [
    *(f"stages.{path.stem}" for path in sorted((ROOT / "stages").glob("*.py")) if path.stem != "__init__"),
    "benchmarks.robot.paper.stages",
]
"""Modules of stages, and of who uses them."""
KNOWING = {"stages.report", "stages.world", "stages.views"}
"""Modules for which nobody else's rule holds: all in them are readers or worlds, or draw what was recorded."""


def entries(path: Path) -> dict[str, dict[str, dict[str, object]]]:
    return yaml.safe_load(path.read_text())["stages"]


def stage(reference: object) -> type[Stage]:
    module, _, name = str(reference).partition(":")
    return getattr(importlib.import_module(module), name)


def stages_of(module: str) -> Iterator[type[Stage]]:
    for _, kind in inspect.getmembers(importlib.import_module(module), inspect.isclass):
        if issubclass(kind, Stage) and kind.__module__ == module:
            yield kind


@pytest.mark.parametrize("path", GRAPHS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_graph_sends_the_truth_to_anybody_else(path: Path) -> None:
    kinds = {name: stage(entry["stage"]) for name, entry in entries(path).items()}
    truths = {
        f"{name}.{port}"
        for name, kind in kinds.items()
        for port, message in inspect_stage(kind).outputs.items()
        if message is Snapshot
    }
    for name, entry in entries(path).items():
        sources = {edge if isinstance(edge, str) else edge["from"] for edge in entry.get("inputs", {}).values()}
        assert not sources & truths or kinds[name] in READERS, f"{path.name}: {name} reads {sources & truths}"


@pytest.mark.parametrize("module", STAGES)
def test_no_stage_takes_the_truth_or_reaches_into_the_simulator(module: str) -> None:
    for kind in stages_of(module):
        types = {port.type for port in inspect_stage(kind).inputs.values()}
        assert Snapshot not in types or kind in READERS, f"{kind.__name__} takes a Snapshot"
    if module not in KNOWING:
        assert WALK.reading(module) == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_what_perceives_and_plans_knows_no_truth(package: str) -> None:
    modules = WALK.modules(f"stages.{package}")
    assert len(modules) > 1
    assert WALK.reading(*modules) == {}


def test_the_walk_meets_every_stage_and_the_truth() -> None:
    assert len(GRAPHS) >= 5
    used = {str(entry["stage"]).partition(":")[0] for path in GRAPHS for entry in entries(path).values()}
    assert used <= set(STAGES)
    assert {kind for module in KNOWING for kind in stages_of(module)} == {Report} | WORLDS
    assert {kind for module in STAGES for kind in stages_of(module)} > READERS
    assert "stages.perception.confidence.doubt" in WALK.modules("stages.perception")
    assert WALK.reading("stages.report") == {"stages.scene.truth": {TRUTH}}
    assert WALK.reading("stages.world")["stages.world"] == {TRUTH, "stages.devices.simulated_robot"}
    assert "stages.camera" in Walk(ROOT, set()).reading("stages.camera")


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("from stages.messages import Snapshot", TRUTH),
        ("import stages.messages as m\n\n\ndef f(x: m.Snapshot): ...", TRUTH),
        ("from stages.messages import sensing\n\nT = getattr(sensing, 'Snapshot')", TRUTH),
        ("from stages.messages import *", ALL),
        ("def f():\n    from stages.devices.simulation import Simulation", "stages.devices.simulation"),
        ("def f():\n    from stages.devices import drops", "stages.devices.drops"),
        ("from stages.messages import Frame", ""),
    ],
)
@pytest.mark.parametrize("spoilt", ["stages/planning/deep/deeper/__init__.py", "stages/planning/deep/deeper/module.py"])
def test_a_module_deep_down_that_reads_the_truth_is_found(spoilt: str, text: str, read: str, tmp_path: Path) -> None:
    files = {
        "stages/__init__.py": "",
        "stages/one.py": "from stages.planning import middle",
        "stages/planning/__init__.py": "",
        "stages/planning/middle.py": "def late():\n    import stages.planning.deep.deeper.module",
        "stages/planning/deep/__init__.py": "",
        "stages/planning/deep/deeper/__init__.py": "",
        "stages/planning/deep/deeper/module.py": "",
        spoilt: text,
    }
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    walk = Walk(tmp_path, set())
    name = spoilt.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    expected = {name: {read}} if read else {}
    assert walk.reading("stages.one") == expected
    assert walk.reading(*walk.modules("stages.planning")) == expected
