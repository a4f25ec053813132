import asyncio
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from PIL import Image

from runner.contract import Refused
from runner.graph.reading import load_graph
from runner.message.codec import Envelope, envelope
from runner.page.viewer import drawn
from runner.recording.recording import Recording
from runner.recording.writer import RecordingWriter
from runner.testing import runner
from runner.view.rerun_view import follow, newest_live, save_rrd, screenshot, view_recording
from runner.view.views import load_views
from tests.runner.common.recordings import TOYS, manifest, put, record_toys
from tests.runner.common.toys import Number

VIEW = "view=tests.runner.common.toy_views:ToyViews"


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"), VIEW)[0]


def entities(rrd: Path) -> str:
    """What a Rerun file holds, as Rerun's own tool prints it."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-v", str(rrd)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


def test_every_kind_of_drawing_lands_in_the_file(toys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    view_recording(toys, save=tmp_path / "toys.rrd")
    assert capsys.readouterr().err == ""
    found = entities(tmp_path / "toys.rrd")
    for path in ("/camera", "/depth", "/camera/boxes", "/world/moving", "/world/points", "/graph", "/text", "/samples"):
        assert path in found


def test_a_recording_is_shown_until_a_message(toys: Path, tmp_path: Path):
    shown = {}
    for at in ("counter.number#0", "sink.finished#0"):
        view_recording(toys, at=at, save=tmp_path / f"{len(shown)}.rrd")
        shown[at] = entities(tmp_path / f"{len(shown)}.rrd")
    first, last = shown.values()
    assert "/camera" in first and "/samples" not in first and "/samples" in last
    with pytest.raises(Refused, match=r"no message 'sink\.finished#1'; the nearest: sink\.finished#0"):
        view_recording(toys, at="sink.finished#1", save=tmp_path / "none.rrd")
    assert not (tmp_path / "none.rrd").exists()


def test_what_cannot_be_drawn_is_named_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    def spoil(record: object) -> object:
        if isinstance(record, Envelope) and record.id == "counter.number#1":
            return Envelope(record.id, record.lineage, record.time_ns, "Other", 1, (), record.body)
        return record

    path, _ = record_toys(tmp_path, VIEW, keep=spoil)  # pyright: ignore
    save_rrd(Recording(path), tmp_path / "toys.rrd")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("counter.number#1 cannot be drawn: CodecError")


def test_refuses_a_graph_without_views_or_with_unknown_ones(tmp_path: Path):
    sink = f"sink.path={tmp_path / 'out.txt'}"
    with pytest.raises(Refused, match="names no views"):
        load_views(load_graph(TOYS, (sink,)))
    with pytest.raises(Refused, match="no class 'Nothing' in tests"):
        load_views(load_graph(TOYS, (sink, "view=tests.runner.common.toy_views:Nothing")))
    process = runner("up", str(TOYS), "--set", sink, "--view", "--recordings", str(tmp_path / "none"))
    assert "graph 'toys' names no views" in process.communicate(timeout=60)[0] and process.returncode == 2
    assert not (tmp_path / "none").exists()


def test_follows_a_running_graph_and_never_holds_it_up(tmp_path: Path):
    """The graph's side only ever writes a file: it is done at once, however slowly the file is drawn."""
    graph = load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}", VIEW))
    path = tmp_path / "live.mcap"
    recorder = RecordingWriter(manifest(graph, path), print)
    assert newest_live(tmp_path) == path
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    viewer = threading.Thread(target=follow, args=(path, stream))
    viewer.start()
    for value in range(5):
        own = f"counter.number#{value}"
        put(recorder, envelope(Number(value=value), id=own, lineage=own, time_ns=value, causes=()))
        time.sleep(0.1)
    recorder.close()
    viewer.join(20)
    stream.disconnect()
    assert not viewer.is_alive()
    assert "/camera/boxes" in entities(tmp_path / "live.rrd")
    (tmp_path / "unreadable.mcap").mkdir()
    with pytest.raises(Refused, match="no graph is running"):
        newest_live(tmp_path)


def test_a_page_is_sent_what_a_running_graph_adds(tmp_path: Path):
    path = tmp_path / "live.mcap"
    recorder = RecordingWriter(manifest(load_graph(TOYS, (f"sink.path={tmp_path / 'out.txt'}", VIEW)), path), print)

    def record(value: int) -> None:
        own = f"counter.number#{value}"
        put(recorder, envelope(Number(value=value), id=own, lineage=own, time_ns=value, causes=()))

    async def read() -> bytes:
        pieces, value = drawn(path), 0
        record(value)
        found = await asyncio.wait_for(anext(pieces), 60)
        while b"/camera/boxes" not in found:
            record(value := value + 1)
            found += await asyncio.wait_for(anext(pieces), 60)
        recorder.close()
        return found + b"".join([piece async for piece in pieces])

    (tmp_path / "page.rrd").write_bytes(asyncio.run(read()))
    assert "/camera/boxes" in entities(tmp_path / "page.rrd")


def test_the_viewer_listens_on_loopback_only(monkeypatch: pytest.MonkeyPatch):
    from runner.view import rerun_view as view

    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    port = view._free_port()
    viewer = view._start_viewer(port)
    try:
        _wait_until_open(port)
        listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        addresses = {entry.partition(":")[0] for entry in listening if entry.endswith(f":{port:04X}")}
        assert addresses == {"0100007F"}
    finally:
        viewer.terminate()
        viewer.wait()
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def _wait_until_open(port: int) -> None:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.2)
    raise TimeoutError(f"nothing listens on port {port}")


@pytest.mark.slow
def test_a_picture_shows_the_last_state(toys: Path, tmp_path: Path):
    png = tmp_path / "toys.png"
    view_recording(toys, png=png)
    picture = np.asarray(Image.open(png).convert("RGB"))
    assert picture.shape == (1600, 2560, 3)
    red = (picture[..., 0] > 120) & (picture[..., 1] < 100) & (picture[..., 2] < 100)
    assert red.mean() > 0.005


def test_a_picture_of_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("shutil.which", lambda _: None)
    (tmp_path / "old.png").touch()
    with pytest.raises(Refused, match="apt-get install xvfb"):
        screenshot(tmp_path / "none.rrd", tmp_path / "old.png")
    assert (tmp_path / "old.png").exists()
