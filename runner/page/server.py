"""Serves the page of one run: what is told of it, what can be asked of it, and its recordings."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import threading
import time
import webbrowser
from collections.abc import AsyncGenerator, Callable, Collection, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Literal

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from runner.contract import Refused
from runner.graph.placement import Host
from runner.live.live import Live
from runner.page import viewer
from runner.page.calls import PageCalls
from runner.page.feed import Feed
from runner.page.guard import Guard, new_token
from runner.page.history import past_runs
from runner.page.past import Past, Pasts
from runner.page.pictures import jpeg
from runner.page.story import Language, Photo
from runner.page.watch import Watch
from runner.supervise.calls import CallRequest
from runner.supervise.registry import Entry, is_alive
from runner.terminal import has_display

STATIC = Path(__file__).with_name("static")
STATUS_SECONDS = 1.0
"""Between two questions how the run is, while somebody wants to know."""
BEAT_SECONDS = 5.0
"""Between two signs of life, by which a page knows that its connection is no dead one."""
KEPT_PHOTOS = 8
"""Pictures that are told of no more, and that a page may still ask for."""
CLOSE_SECONDS = 1
NICE = 5
"""The graph comes first."""


class Shown(msgspec.Struct, frozen=True):
    """What one page shows, as it says itself."""

    view: Literal["scene", "history", "engineer"] = "scene"
    language: Language = "en"


class Page:
    """What is known of one run, for all pages that show it."""

    def __init__(self, entry: Entry, live: Live) -> None:
        """To be made where the server runs."""
        self._entry = entry
        self._live = live
        self._loop = asyncio.get_running_loop()
        self._feed = Feed()
        self._shown: dict[WebSocket, Shown] = {}
        """By every open page."""
        self._photos: dict[str, bytes] = {}
        """JPEG by key."""
        self._pasts = Pasts()
        self._viewer_files: dict[str, bytes] = {}
        """Of the viewer of the robot in 3D."""
        self._files: dict[str, bytes] = {}
        """What can be downloaded, by key."""
        self._news, self._looks = asyncio.Event(), asyncio.Event()
        self._ended = threading.Event()
        self._ready = False
        self._watch = Watch(Path(entry.recording), partial(self._soon, self._news.set), self._ended.is_set)
        self._calls = PageCalls(live, partial(self._soon, self._news.set))

    @property
    def routes(self) -> list[Route | WebSocketRoute | Mount]:
        """What can be asked for, below the token."""
        return [
            WebSocketRoute("/live", self._show),
            Route("/call", self._call, methods=["POST"]),
            Route("/photo/{key}.jpg", self._photo),
            Route("/file/{key}", self._file),
            Route("/runs", self._runs),
            Route("/runs/{name}.mcap", self._download),
            Route("/runs/{name}/{language}.json", self._past),
            Route("/runs/{name}.rrd", self._drawn),
            Route("/viewer/{name}", self._viewer),
            Route("/runs/{name}/{language}/{key}.jpg", self._past_photo),
            Mount("/", StaticFiles(directory=STATIC, html=True)),
        ]

    async def keep(self) -> None:
        """Keeps what pages show true, until the run ends."""
        self._watch.start()
        try:
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(work) for work in (self._tell(), self._ask_how_it_is())]
                while await run_in_threadpool(is_alive, self._entry):
                    self._feed.put("beat", int(time.monotonic() / BEAT_SECONDS))
                    await asyncio.sleep(STATUS_SECONDS)
                for task in tasks:
                    task.cancel()
        finally:
            self._ended.set()

    # ------------------------------------------------------------------------------------------ what is shown

    async def _show(self, socket: WebSocket) -> None:
        """Sends one page what it shows, as it changes; the page says which view that is."""
        await socket.accept()
        shower = asyncio.create_task(self._send(socket))
        try:
            while True:
                self._shown[socket] = msgspec.json.decode(await socket.receive_text(), type=Shown)
                self._look()
                self._feed.wake()
                self._news.set()
        except (WebSocketDisconnect, msgspec.MsgspecError):
            pass
        finally:
            shower.cancel()
            self._shown.pop(socket, None)
            self._look()

    async def _send(self, socket: WebSocket) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            async for value in self._feed.follow(lambda: self._wanted(socket)):
                await socket.send_text(value.decode())

    def _wanted(self, socket: WebSocket) -> Collection[str]:
        if socket not in self._shown:
            return ("run", "beat")
        shown = self._shown[socket]
        more = ("status", "log", "commands") if shown.view == "engineer" else ()
        return ("run", "beat", "fault", f"calls {shown.language}", f"told {shown.language}", *more)

    @property
    def _an_engineer_looks(self) -> bool:
        return any(shown.view == "engineer" for shown in self._shown.values())

    def _look(self) -> None:
        self._watch.look(bool(self._shown))
        self._looks.set() if self._shown else self._looks.clear()

    async def _tell(self) -> None:
        """Tells all that can change in every language that a page shows, once there is news and all is read."""
        while True:
            await self._news.wait()
            self._news.clear()
            self._feed.put("fault", self._watch.fault)
            if not (self._watch.caught_up or self._watch.fault):
                continue  # soon there is news again; what has passed meanwhile is in the history
            languages: set[Language] = {shown.language for shown in self._shown.values()}
            for language in languages:
                told = await run_in_threadpool(self._watch.tell, language)
                await run_in_threadpool(self._keep_photos, told.photos)
                self._files = {file.key: file.data.tobytes() for file in told.files}
                self._feed.put(f"told {language}", told)
                self._feed.put(f"calls {language}", self._calls.told(partial(self._watch.say, language=language)))
            if self._an_engineer_looks:
                self._feed.put("log", list(self._watch.lines))
            await asyncio.sleep(0.05)

    async def _ask_how_it_is(self) -> None:
        """Asks until every process is ready, and from then on while an engineer looks."""
        while True:
            await self._looks.wait()
            if not self._ready or self._an_engineer_looks:
                with contextlib.suppress(Refused):  # it ends, or hangs
                    status = await run_in_threadpool(self._live.status)
                    waits = [process.name for process in status.processes if process.state == "starting"]
                    self._ready = status.ready
                    state = "ready" if status.ready else "starting"
                    self._feed.put("run", {"name": self._entry.run, "state": state, "waits": waits})
                    self._feed.put("status", status)
                    self._feed.put("commands", await run_in_threadpool(self._live.commands))
            await asyncio.sleep(STATUS_SECONDS)

    def _keep_photos(self, photos: Iterable[Photo]) -> None:
        """Compresses what pages will ask for, each once."""
        past = dict(list(self._photos.items())[-KEPT_PHOTOS:])
        self._photos = past | {photo.key: self._photos.get(photo.key) or jpeg(photo) for photo in photos}

    async def _photo(self, request: Request) -> Response:
        return _found(self._photos, request, "this picture is not kept any more", "image/jpeg")

    async def _file(self, request: Request) -> Response:
        return _found(self._files, request, "this file is not kept any more", "application/octet-stream")

    # ------------------------------------------------------------------------------------------ what is asked

    async def _call(self, request: Request) -> Response:
        """Calls a command, as `runner call` does; 422 with the reason, in the page's language, where it is refused."""
        try:
            asked = msgspec.json.decode(await request.body(), type=CallRequest)
            return PlainTextResponse(await run_in_threadpool(self._calls.call, asked))
        except (Refused, msgspec.MsgspecError) as refusal:
            language = "de" if request.headers.get("accept-language") == "de" else "en"
            return PlainTextResponse(self._watch.say(str(refusal), language), 422)

    async def _runs(self, _: Request) -> Response:
        found = await run_in_threadpool(past_runs, self._folder)
        return Response(msgspec.json.encode(found), media_type="application/json")

    async def _download(self, request: Request) -> Response:
        path = self._recording(request)
        return FileResponse(path, filename=path.name)

    async def _past(self, request: Request) -> Response:
        """A recording told again."""
        past = await self._retold(request, grown=False)
        return Response(past.moments, media_type="application/json")

    async def _past_photo(self, request: Request) -> Response:
        """A picture of one; where that is not kept any more, it is told again."""
        past = await self._retold(request, grown=True)
        return _found(past.photos, request, "there is no such picture", "image/jpeg")

    async def _retold(self, request: Request, *, grown: bool) -> Past:
        language = msgspec.convert(request.path_params["language"], Language)
        return await self._pasts.of(self._recording(request), language, grown=grown)

    async def _drawn(self, request: Request) -> Response:
        """A recording for the viewer of the robot in 3D; that of the run that is shown grows as it goes on."""
        pieces = viewer.drawn(self._recording(request))
        first = await anext(pieces)

        async def whole() -> AsyncGenerator[bytes]:
            async with contextlib.aclosing(pieces):
                yield first
                async for piece in pieces:
                    yield piece

        return StreamingResponse(whole(), media_type="application/octet-stream")

    async def _viewer(self, request: Request) -> Response:
        """A file of that viewer; they are large, and there once somebody has asked for one."""
        name = request.path_params["name"]
        if name not in viewer.FILES:
            return PlainTextResponse(f"{name}: no such file; valid: {', '.join(viewer.FILES)}\n", 404)
        self._viewer_files = self._viewer_files or await run_in_threadpool(viewer.viewer_files)
        headers = {"content-security-policy": viewer.policy(self._viewer_files["index.html"])}
        return Response(self._viewer_files[name], media_type=viewer.FILES[name], headers=headers)

    def _recording(self, request: Request) -> Path:
        """The recording that is asked for; it must be one of the folder."""
        name = request.path_params["name"]
        if name not in {path.stem for path in self._folder.glob("*.mcap")}:
            raise HTTPException(404, f"{name}: no such recording\n")
        return self._folder / f"{name}.mcap"

    @property
    def _folder(self) -> Path:
        return Path(self._entry.recording).parent

    def _soon(self, call: Callable[[], object]) -> None:
        """Has something done where the server runs."""
        with contextlib.suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(call)


def _found(kept: Mapping[str, bytes], request: Request, lacking: str, media_type: str) -> Response:
    """What is kept under the key that is asked for."""
    if (data := kept.get(request.path_params["key"])) is None:
        raise HTTPException(404, f"{lacking}\n")
    return Response(data, media_type=media_type)


def _refused(_: Request, refusal: Exception) -> Response:
    """Says why something cannot be had."""
    return PlainTextResponse(str(refusal), 422)


def serve(entry: Entry, *, address: str, port: int, token: str) -> None:
    """Serves the page of a run until the run ends; prints where it is, and opens it where there is a browser.

    ``port`` 0 is any free one, ``token`` empty one by chance. Raises Refused where nobody may listen there, and where
    ``address`` is beyond this machine and no token is chosen.
    """
    token = new_token(address, token)
    os.nice(NICE)
    listener = _listen(address, port)
    port = listener.getsockname()[1]
    own = Host("page", address, port)
    names = {address, "localhost", "127.0.0.1"} if own.loopback else {address}
    hosts = frozenset(str(Host("page", name, port)) for name in names)
    url = f"http://{own}/{token}/"

    @contextlib.asynccontextmanager
    async def living(app: Starlette) -> AsyncGenerator[None]:
        page = Page(entry, live)
        app.router.routes.extend(page.routes)
        task = asyncio.create_task(page.keep())
        task.add_done_callback(lambda _: setattr(server, "should_exit", True))
        print(f"page: {url}", flush=True)
        if has_display():
            webbrowser.open(url)
        yield
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    refusals = dict.fromkeys((Refused, msgspec.ValidationError), _refused)
    app = Guard(Starlette(lifespan=living, exception_handlers=refusals), token, hosts)
    config = uvicorn.Config(
        app,
        log_level="warning",
        ws="websockets-sansio",
        ws_per_message_deflate=False,  # what is sent to every page would be compressed for each anew
        lifespan="on",
        proxy_headers=False,
        timeout_graceful_shutdown=CLOSE_SECONDS,
    )
    server = uvicorn.Server(config)
    # whoever watches the robot in 3D reads an answer without an end
    logging.getLogger("uvicorn.error").addFilter(lambda record: "graceful shutdown" not in record.getMessage())
    with Live(entry) as live:
        server.run([listener])


def _listen(address: str, port: int) -> socket.socket:
    try:
        return socket.create_server((address, port), family=socket.AF_INET6 if ":" in address else socket.AF_INET)
    except OSError as error:
        raise Refused(f"{address}:{port}: nobody can listen there: {error.strerror}") from None
