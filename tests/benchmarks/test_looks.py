"""What the table of looks counts as missed and as false."""

import numpy as np

from benchmarks.looks import compared
from stages.geometry.poses import pose
from stages.messages import SceneGraph, Snapshot
from stages.messages.scene import SceneObject
from stages.scene.catalogue import BUILT_IN, Catalogue


def at(x: float) -> np.ndarray:
    return pose(np.eye(3), np.array([x, 0.0, 0.7]))


def test_what_stands_elsewhere_is_missed_and_false_and_an_offset_of_the_camera_is_neither() -> None:
    snapshot = Snapshot(
        names=("mug", "cup", "bowl"), T_base_objects=np.stack([at(0.5), at(0.7), at(0.9)]), joint_names=(),
        joint_positions=np.zeros(0), time=0.0,
    )  # fmt: skip
    seen = {"mug": 0.52, "cup": 0.8, "plate": 0.3}
    scene = SceneGraph(
        objects=tuple(SceneObject(name=name, label=name, T_base_object=at(x)) for name, x in seen.items()),
        virtual_objects=(), assertions=(), T_base_table=np.eye(4), T_base_camera=np.eye(4), K=np.eye(3),
    )  # fmt: skip
    assert compared(snapshot, scene, Catalogue.shared(BUILT_IN)) == (["cup", "bowl"], ["2 false"])
