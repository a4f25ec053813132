"""What `runner export --foxglove` writes, read back by the decoders of others."""

import io
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from runner.cli.main import main
from runner.contract import Message, Refused
from runner.message.codec import LogLine
from runner.recording.recover import recover
from runner.view import drawing as d
from runner.view.export import _Scribe, _Sink, export
from runner.view.rerun_view import RERUN
from tests.runner.common.recordings import record_toys
from tests.runner.common.toy_views import BOXES, DEPTH, FACES, IMAGE, TETRAHEDRON, ToyViews
from tests.runner.common.toys import Number

VIEW = "view=tests.runner.common.toy_views:ToyViews"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toys")
    path, _ = record_toys(folder, VIEW, more=(LogLine("worker", 1, "warning", "slow", 10**18 + 7),))
    assert main(["export", str(path), "--foxglove", str(folder / "foxglove.mcap")]) == 0
    return folder / "foxglove.mcap"


def read(path: Path, topic: str) -> list[Any]:
    with path.open("rb") as file:
        reader = make_reader(io.BytesIO(file.read()), decoder_factories=[DecoderFactory()])
        return [message for _, _, _, message in reader.iter_decoded_messages(topics=[topic])]


def vector(message: Any) -> list[float]:
    return [message.x, message.y, message.z]


def test_images_come_back_pixel_for_pixel(exported: Path):
    colour, depth = read(exported, "/camera")[-1], read(exported, "/depth")[-1]
    assert (colour.encoding, colour.width, colour.height, colour.step) == ("rgb8", 64, 48, 192)
    assert np.array_equal(np.frombuffer(colour.data, np.uint8).reshape(48, 64, 3), IMAGE)
    assert depth.encoding == "32FC1"
    assert np.array_equal(np.frombuffer(depth.data, np.float32).reshape(48, 64), DEPTH)


def test_a_camera_and_its_place(exported: Path):
    camera, place = read(exported, "/world/moving/camera")[-1], read(exported, "/tf")[-1]
    assert list(camera.K) == [60, 0, 0, 0, 60, 0, 0, 0, 1]
    assert (camera.width, camera.height, camera.frame_id) == (64, 48, "world/moving")
    assert (place.parent_frame_id, place.child_frame_id) == ("world", "world/moving")
    assert vector(place.translation) == [4, 0, 0]
    assert [*vector(place.rotation), place.rotation.w] == [0, 0, 0, 1]


def test_points_meshes_lines_and_boxes(exported: Path):
    cloud, boxes = read(exported, "/world/points")[-1], read(exported, "/camera/boxes")[-1]
    packed = np.frombuffer(cloud.data, np.dtype([("position", "<f4", 3), ("color", "u1", 4)]))
    assert np.array_equal(packed["position"], TETRAHEDRON.astype(np.float32))
    assert packed["color"].tolist() == [[255, 255, 0, 255]] * 4
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "red", "green", "blue", "alpha"]
    assert [(point.x, point.y) for point in boxes.points[0].points][::2] == [tuple(BOXES[0, :2]), tuple(BOXES[0, 2:])]
    assert boxes.texts[0].text == "number 4"
    scene = read(exported, "/scene")
    (mesh,) = scene[0].entities[0].triangles
    assert [vector(point) for point in mesh.points] == TETRAHEDRON.tolist()
    assert list(mesh.indices) == FACES.ravel().tolist()
    assert [vector(point) for point in scene[1].entities[0].lines[0].points] == TETRAHEDRON.tolist()
    assert scene[2].deletions[0].id == "world/line"


def test_log_lines_keep_their_time_level_and_speaker(exported: Path):
    (line,) = read(exported, "/log")
    assert (line.name, line.message) == ("worker.1", "slow")
    assert (line.timestamp.ToNanoseconds(), line.level) == (10**18 + 7, 3)


def test_what_foxglove_has_no_message_for_is_json(exported: Path):
    with exported.open("rb") as file:
        found = {channel.topic: message.data for _, channel, message in make_reader(file).iter_messages()}
    assert (
        found["/graph"]
        == b'{"nodes": [{"name": "a", "label": "A"}, {"name": "b", "label": "B"}], "edges": [["a", "b"]]}'
    )
    assert found["/sum"].startswith(b'{"name": "sum", "value": ')


def test_a_turned_place_frames_what_is_drawn_before_it_and_all_below_is_cleared(tmp_path: Path):
    path, scribe = tmp_path / "turned.mcap", _Scribe()
    turned = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    drawings = [
        d.Points3D("world/a/points", TETRAHEDRON),
        d.Transform("world/a", turned),
        d.Boxes2D("world/a/b", BOXES),
    ]
    with path.open("wb") as file:
        writer = Writer(file)
        sink = _Sink(writer)
        for time_ns, step in enumerate((drawings, [d.Clear("world/a")], [d.Clear("world/a")])):
            sink.put(scribe.written(step, time_ns), time_ns)
        writer.finish()
    (place,), clouds, boxes = (read(path, topic) for topic in ("/tf", "/world/a/points", "/world/a/b"))
    assert [*vector(place.rotation), place.rotation.w] == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert [cloud.frame_id for cloud in clouds] == ["world/a", "world/a"]
    assert [len(cloud.data) for cloud in clouds] == [64, 0]
    assert [len(message.points) for message in boxes] == [1, 0]


class Odd(ToyViews):
    """Draws what it may not, and one kind of drawing where another has stood."""

    def draw(self, message: Message) -> Iterator[d.Drawing]:
        if isinstance(message, Number):
            yield d.Image("grey", np.zeros((4, 4), np.uint8))
            yield d.Scalar("odd", np.float32(0.5))  # pyright: ignore
            yield d.Scalar("odd", float("nan"))
            yield d.Text("odd", "words")


def test_what_cannot_be_written_is_left_out_and_two_kinds_on_a_path_do_not_mix(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path, _ = record_toys(tmp_path, f"view={__name__}:Odd")
    assert main(["export", str(path), "--foxglove", str(tmp_path / "out.mcap")]) == 0
    assert capsys.readouterr().err.startswith("grey cannot be drawn: IndexError")
    assert read(tmp_path / "out.mcap", "/odd.Log")[0].message == "words"
    with (tmp_path / "out.mcap").open("rb") as file:
        curve = [message.data for _, _, message in make_reader(file).iter_messages(topics=["/odd"])]
    assert curve[:2] == [b'{"name": "odd", "value": 0.5}', b'{"name": "odd", "value": null}']
    assert main(["view", str(path), "--save", str(tmp_path / "out.rrd")]) == 0
    assert capsys.readouterr().err.startswith("grey cannot be drawn: IndexError")


def test_rerun_opens_it(exported: Path, tmp_path: Path):
    command = [RERUN, "mcap", "convert", str(exported), "-o", str(tmp_path / "toys.rrd")]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    command = [RERUN, "rrd", "print", str(tmp_path / "toys.rrd")]
    text = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    for path, component in (("/camera", "Image:buffer"), ("/tf", "Transform3D:"), ("/world/points", "Points3D:")):
        assert any(f" - {path} - " in line and component in line for line in text.splitlines()), path


class Deadly(ToyViews):
    """Kills whoever draws the last number."""

    def draw(self, message: Message) -> Iterator[d.Drawing]:
        if isinstance(message, Number) and message.last:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().draw(message)


def test_who_is_killed_leaves_no_file_that_looks_whole(tmp_path: Path):
    path, _ = record_toys(tmp_path, f"view={__name__}:Deadly")
    command = [sys.executable, "-m", "runner.cli", "export", str(path), "--foxglove", str(tmp_path / "out.mcap")]
    assert subprocess.run(command, check=False, timeout=60).returncode == -signal.SIGKILL
    assert not (tmp_path / "out.mcap").exists()


def test_a_full_disk_leaves_no_file(tmp_path: Path):
    path, _ = record_toys(tmp_path, VIEW)
    before, soft, hard = set(tmp_path.iterdir()), *resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        for write in (export, recover):
            with pytest.raises(Refused, match=r"out\.mcap: cannot be written: File too large"):
                write(path, tmp_path / "out.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert set(tmp_path.iterdir()) == before


def test_refuses_to_overwrite_and_a_graph_without_views(exported: Path, tmp_path: Path):
    path, _ = record_toys(tmp_path)
    with pytest.raises(Refused, match="names no views"):
        export(path, tmp_path / "new.mcap")
    assert main(["export", str(path), "--foxglove", "out.bag"]) == 2
    with pytest.raises(Refused, match="File exists"):
        export(exported.with_name("toys.mcap"), exported)
