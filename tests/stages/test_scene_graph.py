"""The scene graph stage: frames, and what it refuses."""

import msgspec
import numpy as np
import pytest

from runner.contract import Refused
from stages.messages.scene import UnknownRegion
from stages.scene_graph import SceneGraphBuilder
from tests.stages.layouts import CATALOGUE, T_BASE_TABLE, asserted, breakfast, builder


def test_poses_are_in_the_base_frame():
    layout = breakfast()
    graph = layout.graph()
    assert graph.T_base_table == pytest.approx(T_BASE_TABLE)
    for item in graph.objects:
        assert item.T_base_object == pytest.approx(T_BASE_TABLE @ layout.poses[item.name], abs=1e-9)


def test_where_the_camera_is_not_known_poses_are_in_the_tables_frame_and_say_so():
    layout = breakfast()
    estimate = msgspec.structs.replace(layout.estimate(), T_base_camera=None)
    graph = builder().on_scene_estimate(estimate)
    assert graph.T_base_camera is None
    assert (graph.frame, layout.graph().frame) == ("table", "base")
    assert graph.T_base_table == pytest.approx(np.eye(4))
    assert graph.objects[0].T_base_object == pytest.approx(layout.poses["tray"], abs=1e-9)
    assert asserted(graph) == asserted(layout.graph())


def test_an_empty_scene_has_an_empty_graph():
    estimate = msgspec.structs.replace(breakfast().estimate(), objects=())
    assert builder().on_scene_estimate(estimate).assertions == ()


def test_what_the_image_contradicts_is_not_asserted():
    estimate = breakfast().estimate()
    floating = tuple(msgspec.structs.replace(item, contradicted=item.name == "cup") for item in estimate.objects)
    graph = builder().on_scene_estimate(msgspec.structs.replace(estimate, objects=floating))
    assert "cup" not in {item.name for item in graph.objects}
    assert "clear(bowl)" in asserted(graph)


def test_the_surface_that_was_seen_is_passed_on():
    surface = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]])
    estimate = msgspec.structs.replace(breakfast().estimate(), support=surface)
    assert builder().on_scene_estimate(estimate).support is surface


def test_what_is_not_known_is_passed_on():
    region = UnknownRegion(
        box=np.array([0.0, 0.0, 9.0, 9.0]), points=50, centre_table=np.zeros(3), extent_table=np.full(3, 0.05)
    )
    estimate = msgspec.structs.replace(breakfast().estimate(), unknown=(region,))
    assert builder().on_scene_estimate(estimate).unknown == (region,)


def test_objects_that_the_catalogue_does_not_hold_are_refused():
    estimate = breakfast().estimate()
    unknown = msgspec.structs.replace(estimate.objects[0], label="teapot")
    with pytest.raises(Refused, match=r"'teapot' is not in .*catalogue.yaml; known: bowl, "):
        builder().on_scene_estimate(msgspec.structs.replace(estimate, objects=(unknown,)))


@pytest.mark.parametrize("field", ["gap", "radius"])
def test_distances_must_be_positive(field: str):
    with pytest.raises(Refused, match=f"scene_graph.{field}=0: must be a positive number of metres"):
        SceneGraphBuilder.Config(catalogue=CATALOGUE, **{field: 0})
