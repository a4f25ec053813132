"""The camera stages: frames with noise from the step's generator, data sets to the end, clear refusals."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import stages.scene
from runner.contract import Refused
from runner.graph.ports import inspect_stage
from runner.graph.reading import load_graph
from runner.message import codec
from runner.recording.writer import RecordingWriter
from runner.testing import run_stage
from stages.camera import DatasetCamera, RealSenseCamera, RecordedCamera, SimulatedCamera
from stages.messages import Frame, Snapshot
from tests.runner.common.recordings import manifest, put
from tests.stages.planning.scenes import ROBOT

BUILT_IN = Path(stages.scene.__file__).parent / "catalogue.yaml"
DATA = Path(__file__).parents[3] / "shared" / "data"
# A recording keeps its file open as long as it lives.
lives_on = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the data sets in ../shared/data are absent")


def snapshot() -> Snapshot:
    T = np.eye(4)
    T[:3, 3] = 0.7, 0.0, ROBOT.table.height + 0.05
    return Snapshot(
        names=("soup_can",),
        T_base_objects=T[None],
        joint_names=tuple(ROBOT.posture),
        joint_positions=np.array(list(ROBOT.posture.values())),
        time=1.5,
        purpose="goal",
    )


def test_simulated_frames_differ_by_the_noise_alone() -> None:
    camera = SimulatedCamera(SimulatedCamera.Config(catalogue=BUILT_IN))
    first, again, other = (run_stage(camera, [snapshot()], seed=seed)[0] for seed in (1, 1, 2))
    camera.close()
    np.testing.assert_array_equal(first.depth, again.depth)
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert (first.depth != other.depth).any()
    assert [frame.index for frame in (first, again, other)] == [0, 1, 2]
    assert (first.name, first.total, first.n_objects) == ("goal", 0, None)
    assert first.robot_mask is not None and first.T_base_camera is not None
    assert 0.9 < (first.depth > 0).mean() < 1.0


def test_simulated_frame_without_noise_is_complete() -> None:
    camera = SimulatedCamera(SimulatedCamera.Config(catalogue=BUILT_IN, noise=False))
    (frame,) = run_stage(camera, [snapshot()])
    camera.close()
    assert (frame.depth > 0).all()
    assert frame.name == "goal"


@needs_data
def test_data_set_camera_gives_each_target_image_once() -> None:
    camera = DatasetCamera(DatasetCamera.Config(dataset=DATA / "ycb-real"))
    frames = run_stage(camera)
    assert [(frame.index, frame.total, frame.scene_id) for frame in frames] == [(i, 5, i + 1) for i in range(5)]
    assert [frame.n_objects for frame in frames] == [5, 3, 3, 1, 1]
    assert all(frame.T_base_camera is None and frame.robot_mask is None for frame in frames)


@needs_data
def test_data_set_camera_stops_at_its_limit() -> None:
    camera = DatasetCamera(DatasetCamera.Config(dataset=DATA / "ycb-real", limit=2))
    assert [frame.total for frame in run_stage(camera)] == [2, 2]


@needs_data
def test_a_stride_keeps_pixels_and_where_they_look() -> None:
    whole, thinned = (
        run_stage(DatasetCamera(DatasetCamera.Config(dataset=DATA / "ycb-real", stride=stride)), limit=1)[0]
        for stride in (1, 2)
    )
    assert np.array_equal(thinned.rgb, whole.rgb[::2, ::2])
    ray, same = (np.linalg.inv(frame.K) @ (*pixel, 1) for frame, pixel in ((whole, (200, 100)), (thinned, (100, 50))))
    assert np.allclose(ray, same)


@pytest.mark.parametrize(("name", "value"), [("limit", -1), ("stride", 0)])
def test_limits_that_mean_nothing_are_refused(name: str, value: int) -> None:
    with pytest.raises(Refused, match=rf"camera\.{name} = {value}"):
        DatasetCamera.Config(dataset=Path(), **{name: value})


@pytest.mark.skipif(importlib.util.find_spec("pyrealsense2") is not None, reason="pyrealsense2 is installed")
def test_realsense_without_its_library_says_what_to_install() -> None:
    with pytest.raises(Refused, match=r"pip install 'scene-programming\[realsense\]'"):
        RealSenseCamera(RealSenseCamera.Config())


def test_realsense_settings_are_checked() -> None:
    with pytest.raises(Refused, match=r"camera\.fps = 0: must be at least 1"):
        RealSenseCamera.Config(fps=0)
    with pytest.raises(Refused, match=r"camera\.T_base_camera has 3 numbers; a pose is 16, row by row"):
        RealSenseCamera.Config(T_base_camera=(1.0, 0.0, 0.0))
    with pytest.raises(Refused, match=r"camera\.T_base_camera: .* is no pose"):
        RealSenseCamera.Config(T_base_camera=(2.0, *np.eye(4).ravel()[1:].tolist()))
    with pytest.raises(Refused, match=r"camera\.T_base_camera: the camera is 800 m away; metres are expected"):
        RealSenseCamera.Config(T_base_camera=tuple((np.eye(4) + np.diag([800.0], 3)).ravel().tolist()))


def record(folder: Path, frames: list[Frame]) -> Path:
    """A recording of a graph whose one stage is a camera that gave ``frames``."""
    (folder / "graph.yaml").write_text(
        "name: look\nseed: 0\nstages:\n  camera: {stage: 'stages.camera:DatasetCamera', config: {dataset: x}}\n"
    )
    path = folder / "look.mcap"
    writer = RecordingWriter(manifest(load_graph(folder / "graph.yaml", ()), path), print)
    for number, frame in enumerate(frames):
        id = f"camera.frame#{number}"
        sealed = codec.envelope(frame, id=id, lineage=id, time_ns=number, causes=())
        put(writer, sealed)
    writer.close()
    return path


def frame(name: str) -> Frame:
    return Frame(
        rgb=np.full((4, 6, 3), 7, np.uint8),
        depth=np.ones((4, 6), np.float32),
        K=np.eye(3),
        T_base_camera=None,
        robot_mask=None,
        name=name,
        index=0,
        total=0,
    )


@lives_on
def test_recorded_camera_gives_the_frames_again_counted_anew(tmp_path: Path) -> None:
    path = record(tmp_path, [frame("goal"), frame("start")])
    camera = RecordedCamera(RecordedCamera.Config(recording=path))
    frames = run_stage(camera)
    assert [(f.name, f.index, f.total) for f in frames] == [("goal", 0, 2), ("start", 1, 2)]
    np.testing.assert_array_equal(frames[1].rgb, frame("start").rgb)


@lives_on
def test_recording_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"look\.mcap: holds no message of type Frame; there are none at all"):
        RecordedCamera(RecordedCamera.Config(recording=record(tmp_path, [])))


def test_missing_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"song\.mcap"):
        RecordedCamera(RecordedCamera.Config(recording=tmp_path / "song.mcap"))


@pytest.mark.parametrize("stage", [SimulatedCamera, DatasetCamera, RecordedCamera, RealSenseCamera])
def test_cameras_are_devices_that_give_frames(stage: type) -> None:
    assert stage.device
    assert inspect_stage(stage).outputs == {"frame": Frame}
