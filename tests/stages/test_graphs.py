"""The graphs that come with the package: settings that hold for all of their stages."""

import subprocess
import sys
from pathlib import Path

import pytest

from runner.contract import Refused
from runner.graph.reading import load_graph

ROOT = Path(__file__).parents[2]
NEEDED = {
    "bag.yaml": ("camera.bag=data",),
    "bop.yaml": ("camera.dataset=data", "detector.detections=boxes.json", "results.path=out.csv"),
    "photos.yaml": ("camera.dataset=data", "results.path=out.csv"),
    "reference.yaml": ("camera.dataset=data",),
}
GRAPHS = [ROOT / "graph.yaml", *sorted((ROOT / "graphs").glob("*.yaml"))]
KNOWING = [graph for graph in GRAPHS if "catalogue:" in graph.read_text()]
SEARCHING = [graph for graph in GRAPHS if "stages.hypotheses:Hypotheses" in graph.read_text()]


@pytest.mark.parametrize("path", SEARCHING, ids=lambda path: path.name)
def test_the_number_of_objects_may_be_found(path: Path) -> None:
    graph = load_graph(path, ("hypotheses.n_objects=auto", *_needed(path)))
    assert graph.nodes["hypotheses"].config.n_objects == "auto"


@pytest.mark.parametrize("path", KNOWING, ids=lambda path: path.name)
def test_a_catalogue_is_beside_the_graph_in_every_stage(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    home = tmp_path / "home"
    (home / "ours").mkdir(parents=True)
    (home / "ours" / "objects.yaml").touch()
    text = path.read_text().replace("stages/scene/catalogue.yaml", "ours/objects.yaml")
    (home / path.name).write_text(text.replace('"${camera.dataset}/models"', "ours/objects.yaml"))
    graph = load_graph(home / path.name, _needed(path))
    found = {name: node.config.catalogue for name, node in graph.nodes.items() if hasattr(node.config, "catalogue")}
    assert set(found.values()) == {home / "ours" / "objects.yaml"}


@pytest.mark.parametrize(
    ("name", "stage"),
    [
        *((name, "world") for name in ("graph.yaml", "graphs/ur5e.yaml", "graphs/interactive.yaml")),
        *((name, "particle_filter") for name in ("graphs/arm.yaml", "graphs/ros2.yaml", "graphs/bag.yaml")),
        ("graphs/photos.yaml", "detector"),
    ],
)
def test_one_setting_changes_the_catalogue_of_every_stage(name: str, stage: str) -> None:
    graph = load_graph(ROOT / name, (f"{stage}.catalogue=/ours.yaml", *_needed(ROOT / name)))
    found = {node.config.catalogue for node in graph.nodes.values() if hasattr(node.config, "catalogue")}
    assert found == {Path("/ours.yaml")}


def test_recorded_boxes_are_those_of_the_pixels_that_the_camera_gives() -> None:
    path = ROOT / "graphs/bop.yaml"
    assert load_graph(path, ("camera.stride=4", *_needed(path))).nodes["detector"].config.stride == 4


@pytest.mark.parametrize("name", ["arm", "ros2"])
@pytest.mark.parametrize(("frame", "found"), [("map", "map"), ("null", None)])
def test_scenes_are_published_in_the_frame_in_which_the_camera_is(name: str, frame: str, found: str | None) -> None:
    graph = load_graph(ROOT / f"graphs/{name}.yaml", (f"camera.topics.base_frame={frame}",))
    assert (graph.nodes["camera"].config.topics.base_frame, graph.nodes["ros2"].config.frames.base) == (found, found)


def test_a_setting_within_a_group_is_filled_in() -> None:
    arm, wrong = ROOT / "graphs/arm.yaml", "ros2.frames.base=${camera.topics.bas_frame}"
    assert load_graph(arm, ("camera.topics.base_frame=map",)).nodes["ros2"].config.frames.base == "map"
    with pytest.raises(
        Refused, match=r"^--set ros2.frames.base: no setting .*; did you mean 'camera.topics.base_frame'"
    ):
        load_graph(arm, (wrong,))
    with pytest.raises(Refused, match=r"^--set camera.topics.info: has no value yet; give it with --set camera.topics"):
        load_graph(arm, ("camera.topics.info=???",))


def test_who_only_reads_a_graph_does_not_wait_for_torch() -> None:
    code = "import sys; from tests.stages import test_graphs as t; [t.load_graph(g, t._needed(g)) for g in t.GRAPHS]"
    command = (sys.executable, "-c", f"{code}; assert 'torch' not in sys.modules")
    subprocess.run(command, cwd=ROOT, check=True)


def _needed(path: Path) -> tuple[str, ...]:
    return NEEDED.get(path.name, ())
