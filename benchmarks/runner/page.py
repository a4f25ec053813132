"""How soon a page shows, and what it costs: `python -m benchmarks.page [--rounds 3]`.

Runs a graph with a camera of five pictures a second and one stage a core that computes all the time, and prints

* the time from opening the page's address to its first paint and to its first picture, in a browser without a cache;
* how far each later picture is behind the camera: from when it was taken to when the browser has painted it. All this
  twice: with a core that the browser has for itself, as on a tablet beside the table, while the graph and the page's
  server share all others; and where the graph fills every core and the browser waits for its turn as everybody does;
* what the graph computes a second and the processor time that it has for it, and what the page's server and the open
  pages take of a core: without a page process, with one that nobody has open, with one open page and with ten. Open
  pages are connections that take everything and every picture: what browsers draw would be drawn on other machines, as
  would what these take. Every round measures each once, in turns; shares are medians of what each round has beside its
  own measurement without a page.

Needs chromium.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import tempfile
import time
from collections.abc import AsyncGenerator, Collection, Generator
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from queue import Queue
from statistics import median
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
from playwright.sync_api import sync_playwright
from websockets.asyncio.client import connect

from benchmarks.runner.live import running
from runner.live.live import Live
from runner.page.start import page_beside
from stages.geometry.arrays import Floats

SECONDS = 10.0
"""Of each measurement."""
SETTLE_SECONDS = 3.0
"""Until what has just been started or opened is at rest."""
OPTIONS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
GRINDER = "grinder"
LATE_MS = 300
"""That a picture may be behind."""
COUNTS = (None, 0, 1, 10)
"""Open pages; None without a page process."""
NOTES = """
    window.first = 0;
    window.delays = [];
    document.addEventListener("load", ({target}) => {
      const [, key] = /photo\\/(\\d+)\\.jpg/.exec(target.src ?? "") ?? [];
      if (!key) return;
      const taken = key / 1e6 - performance.timeOrigin;
      requestAnimationFrame(() => {
        if (window.first && taken > window.first) window.delays.push(performance.now() - taken);
        window.first ||= performance.now();
      });
    }, true);
"""
"""When the first picture was painted, and the milliseconds by which each is late that was taken from then on."""


@contextlib.contextmanager
def on(cores: Collection[int]) -> Generator[None]:
    """Has what is started meanwhile run on these cores only."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextlib.contextmanager
def filling(cores: Collection[int]) -> Generator[Live]:
    """A graph that fills these cores, looked at from them: a camera, and a stage a core that computes all the time."""
    stages = {
        "camera": {"stage": "benchmarks.runner.page_stages:Photographer", "config": {"hertz": 5, "seconds": 3600}}
    }
    stages |= {f"{GRINDER}{core}": {"stage": "benchmarks.runner.page_stages:Grinder"} for core in cores}
    story = "benchmarks.runner.page_stages:PictureStory"
    with tempfile.TemporaryDirectory() as folder, on(cores), running(Path(folder), "page", stages, story=story) as live:
        yield live


@contextlib.contextmanager
def served(live: Live) -> Generator[tuple[psutil.Process, str]]:
    """A page process on a run, and its address."""
    said = Queue[str]()
    with page_beside(live.entry.run, said.put) as page:
        yield psutil.Process(page.pid), said.get(timeout=60).split()[1]


def shown(url: str, rounds: int) -> tuple[list[float], list[float], list[float]]:
    """Milliseconds until first paint and until the first picture, one a round, and by which each later one is late."""
    paints, firsts, delays = list[float](), list[float](), list[float]()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=list(OPTIONS))
        for _ in range(rounds):
            page = browser.new_context().new_page()
            page.add_init_script(NOTES)
            page.goto(url)
            page.wait_for_selector("figure img")
            paints.append(page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime"))
            page.wait_for_timeout(1000 * SECONDS)
            firsts.append(page.evaluate("window.first"))
            delays += page.evaluate("window.delays")
            page.context.close()
        browser.close()
    return paints, firsts, delays


@contextlib.asynccontextmanager
async def visitors(url: str, count: int) -> AsyncGenerator[None]:
    """Open pages that take everything, once they have caught up with the graph."""
    caught_up = [asyncio.Event() for _ in range(count)]
    tasks = [asyncio.create_task(_visit(url, event)) for event in caught_up]
    for event in caught_up:
        await event.wait()
    yield
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def _visit(url: str, caught_up: asyncio.Event) -> None:
    """One page: as in a browser, all its pictures come over one connection."""
    place, seen = urlsplit(url), ""
    pictures = HTTPConnection(place.netloc)
    async with connect(url.replace("http", "ws") + "live", max_size=None) as socket:
        await socket.send(json.dumps({"view": "scene", "language": "en"}))
        async for text in socket:
            told: dict[str, Any] = json.loads(text)
            view = told["value"].get("view") if told["name"] == "told en" else None
            if view and view["photo"]["key"] != seen:
                seen = view["photo"]["key"]
                await asyncio.to_thread(_fetch, pictures, f"{place.path}photo/{seen}.jpg")
                if time.time() - int(seen) * 1e-9 < 1.0:
                    caught_up.set()


def _fetch(connection: HTTPConnection, path: str) -> None:
    try:
        connection.request("GET", path)
        connection.getresponse().read()
    except (HTTPException, ConnectionError):  # the server has closed what was idle; the next picture opens it again
        connection.close()


async def cost(live: Live, page: psutil.Process | None, url: str, count: int) -> Floats:
    """Words that the graph says a second, and the shares of a core that what says them, the page's server and the open
    pages have."""
    async with visitors(url, count):
        await asyncio.sleep(SETTLE_SECONDS)
        before, began = _used(live, page), time.monotonic()
        await asyncio.sleep(SECONDS)
        return (_used(live, page) - before) / (time.monotonic() - began)


def _used(live: Live, page: psutil.Process | None) -> Floats:
    """Words, and seconds of a core, so far."""
    grinders = [process for process in live.status().processes if process.stage.startswith(GRINDER)]
    words = sum(grinder.sent["word"].messages for grinder in grinders)
    computing = sum(_seconds(psutil.Process(grinder.pid)) for grinder in grinders)
    return np.array([words, computing, _seconds(page) if page else 0.0, _seconds(psutil.Process())])


def _seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def print_delays(rounds: int) -> None:
    """First paint, and how far pictures are behind, with a core for the browser alone and without one."""
    cores = sorted(os.sched_getaffinity(0))
    for own in (cores[-1:], []):
        with filling([core for core in cores if core not in own]) as live, served(live) as (_, url), on(own or cores):
            paints, firsts, delays = shown(url, rounds)
        print(f"browser with a core of its own: {'yes' if own else 'no'}")
        late = sum(delay > LATE_MS for delay in delays)
        for name, found in (("first paint", paints), ("first picture", firsts), ("picture behind", delays)):
            print(f"  {name:<15}{median(found):6.0f} ms, slowest of {len(found)} {max(found):.0f} ms")
        print(f"  more than {LATE_MS} ms behind: {late}", flush=True)


def print_costs(rounds: int) -> None:
    """What a graph that fills every core has beside none, one and ten open pages."""
    found: dict[int | None, list[Floats]] = {count: [] for count in COUNTS}
    with filling(os.sched_getaffinity(0)) as live:
        for _ in range(rounds):
            found[None].append(asyncio.run(cost(live, None, "", 0)))
            with served(live) as (page, url):
                for count in (0, 1, 10):
                    found[count].append(asyncio.run(cost(live, page, url, count)))
    alone = np.array(found[None])[:, :2]
    for count, measured in found.items():
        said, computing, cpu, own = np.median(measured, 0)
        words, cores = np.median(np.array(measured)[:, :2] / alone, 0)
        name = "no page process" if count is None else f"{count} open pages"
        print(
            f"{name:<16}{said:8.1f} words/s ({words:6.1%}), of a core: what says them {computing:7.2%} ({cores:6.1%}), "
            f"server {cpu:6.2%}, pages {own:6.2%}"
        )


def main() -> None:
    """Prints paint, delay and cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    print_delays(options.rounds)
    print_costs(options.rounds)


if __name__ == "__main__":
    main()
