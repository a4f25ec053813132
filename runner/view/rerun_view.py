"""Shows a recording, finished or still growing, in a Rerun viewer, a file or a picture.

A running graph is shown from the recording it writes: however slow the viewer is, the graph never waits for it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Callable, Generator
from pathlib import Path
from urllib.parse import quote

import rerun as rr
import rerun_cli
from mcap.records import Metadata

from runner.contract import Refused
from runner.message.codec import CodecError, Envelope, unpack
from runner.process.children import bound
from runner.recording.container import Container, Entry, Growing, is_being_written, open_file, recordings_in
from runner.recording.recording import RUN, Recording, payload_kind
from runner.terminal import has_display
from runner.view.canvas import Canvas

RERUN = str(Path(rerun_cli.__file__).with_name("rerun"))
"""The viewer itself: ``python -m rerun`` would stay between it and the signals that end it."""
MEMORY = "2GB"
"""Cap of a viewer; beyond it the oldest drawings go."""
WINDOW = (1280, 800)
"""Size of the window of a picture, in points of two pixels."""
PACKAGES = "xvfb mesa-vulkan-drivers libxkbcommon-x11-0 libxcursor1 libxi6 libxrandr2"
SCREENSHOT_SECONDS = 120
STDOUT = Path("-")


# ------------------------------------------------------------------------------------ recordings


def view_recording(path: Path, *, at: str | None = None, save: Path | None = None, png: Path | None = None) -> None:
    """Opens a viewer on a recording, or writes it as a Rerun file or a picture of its last state.

    ``at`` is the message that is the last to be shown; raises Refused where it is not recorded.
    """
    recording = Recording(path)
    if at is not None:
        recording.require(at)
    with tempfile.TemporaryDirectory() as folder:
        rrd = save or Path(folder) / f"{path.stem}.rrd"
        save_rrd(recording, rrd, at)
        if png is not None:
            screenshot(rrd, png)
        if save is None and png is None:
            _wait(_start_viewer(_free_port(), str(rrd)))


def save_rrd(recording: Recording, target: Path, at: str | None = None) -> None:
    """Draws a recording, whole or until a message, into a Rerun file, ``-`` for stdout."""
    stream = _stream(recording.path)
    canvas = Canvas(recording.run["graph"], recording.path, stream)
    _write(stream, target)
    for sealed in recording.envelopes():
        canvas.draw(sealed)
        if sealed.id == at:
            break
    stream.flush()
    stream.disconnect()


def _stream(path: Path) -> rr.RecordingStream:
    return rr.RecordingStream("scene programming", recording_id=path.stem)


def _write(stream: rr.RecordingStream, target: Path) -> None:
    if target.exists():
        raise Refused(f"{target}: cannot be written: File exists")
    try:
        stream.stdout() if target == STDOUT else stream.save(target)
    except RuntimeError as error:
        raise Refused(f"{target}: cannot be written: {error}") from None


# ------------------------------------------------------------------------------------ live


def view_live(path: Path | None = None, save: Path | None = None) -> None:
    """Shows a graph while it runs, in a viewer or a file that grows with it.

    ``path`` is its recording, by default the one in ``recordings`` being written.
    """
    path = path or newest_live(Path("recordings"))
    open_file(path).close()  # or it is refused before a viewer opens
    # The graph comes first: drawing, and the viewer that this starts, take what it leaves of the cores.
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if save is not None:
        stream = _stream(path)
        follow(path, stream, begin=lambda: _write(stream, save))
        stream.disconnect()
        return
    port = _free_port()
    viewer = _start_viewer(port, "--expect-data-soon")
    try:
        stream = _stream(path)
        stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
        follow(path, stream, stopped=lambda: viewer.poll() is not None)
    finally:
        _wait(viewer)


def newest_live(folder: Path) -> Path:
    """The newest recording that a running graph writes; raises Refused where there is none."""
    for path in recordings_in(folder):
        with contextlib.suppress(OSError), path.open("rb") as file:  # another user's, or gone
            if is_being_written(file):
                return path
    raise Refused(f"{folder}: no graph is running here: no recording is being written")


def follow(
    path: Path,
    stream: rr.RecordingStream,
    *,
    begin: Callable[[], None] = lambda: None,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Draws what a recording holds and goes on as it grows, until its graph has ended or ``stopped()``.

    ``begin`` is called once it is known what to draw.
    """
    canvas: Canvas | None = None
    with open_file(path) as file:
        for record in Container(Growing(file, stopped), str(path)):
            if isinstance(record, Metadata) and record.name == RUN:
                canvas = Canvas(record.metadata["graph"], path, stream)
                begin()
            elif isinstance(record, Entry) and payload_kind(record.topic) is Envelope and canvas is not None:
                with contextlib.suppress(CodecError):
                    canvas.draw(unpack(Envelope, record.message.data))
    stream.flush()


# ------------------------------------------------------------------------------------ the viewer's process


def _start_viewer(port: int, *arguments: str) -> subprocess.Popen[bytes]:
    """A window where there is a display, a page on loopback elsewhere; takes drawings on ``port``."""
    command = [RERUN, "--bind", "127.0.0.1", "--port", str(port), "--memory-limit", MEMORY, *arguments]
    if not has_display():
        web = _free_port()
        command += ["--serve-web", "--web-viewer-port", str(web), "--server-memory-limit", MEMORY]
        source = quote(f"rerun+http://127.0.0.1:{port}/proxy", safe="")
        print(f"viewer: http://127.0.0.1:{web}/?url={source} (Ctrl-C closes it)", flush=True)
    return subprocess.Popen(bound(command), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _wait(viewer: subprocess.Popen[bytes]) -> None:
    """Waits until the user closes the viewer or presses Ctrl-C."""
    try:
        with contextlib.suppress(KeyboardInterrupt):
            viewer.wait()
    finally:
        viewer.terminate()
        viewer.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# ------------------------------------------------------------------------------------ pictures


def screenshot(rrd: Path, png: Path) -> None:
    """Renders the last state of a Rerun file without a display; raises Refused where tools are missing.

    An older picture is replaced once there is a new one.
    """
    size = "x".join(map(str, WINDOW))
    with _virtual_display(size) as display, tempfile.TemporaryDirectory() as runtime:
        rendered, part = Path(runtime) / png.name, png.with_name(f"{png.name}.part")
        command = [RERUN, "--bind", "127.0.0.1", "--port", str(_free_port())]
        command += ["--window-size", size, "--screenshot-to", str(rendered), str(rrd.absolute())]
        settings = {"WGPU_BACKEND": "vulkan", "XDG_RUNTIME_DIR": runtime}
        environment = {**os.environ, **settings, "DISPLAY": display}
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(command, env=environment, capture_output=True, timeout=SCREENSHOT_SECONDS, check=False)
        if not rendered.exists():
            raise Refused(f"{png}: the viewer could not render; it needs: apt-get install {PACKAGES}")
        try:
            shutil.copyfile(rendered, part)
            part.replace(png)
        except OSError as error:
            raise Refused(f"{png}: cannot be written: {error.strerror}") from None
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def _virtual_display(size: str) -> Generator[str]:
    """An X server without a screen, as ``:number``."""
    if shutil.which("Xvfb") is None:
        raise Refused(f"a picture needs a virtual display: apt-get install {PACKAGES}")
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", f"{size}x24", "-nolisten", "tcp"]
    server = subprocess.Popen(bound(command), pass_fds=(writing,), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(writing)
    try:
        with os.fdopen(reading) as ready:
            yield f":{ready.readline().strip()}"
    finally:
        server.terminate()
        server.wait()
