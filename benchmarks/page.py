"""How soon a page shows, and what it costs: `python -m benchmarks.page [--rounds 3]`.

Runs a graph with a camera of five pictures a second and one stage a core that computes all the time, and prints

* the time from opening the page's address to its first paint, in a browser without a cache: median and slowest;
* how far the picture on the page is behind the camera: from when it was taken to when the browser has painted it;
* what the graph computes a second, and what the page's server takes of a core, without a page process, with one that
  nobody has open, with one open page and with ten. Open pages are connections that take everything and every picture:
  what browsers draw would be drawn on other machines. Every round measures each once, in turns.

Needs chromium.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncGenerator, Generator
from pathlib import Path
from statistics import median
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import psutil
from playwright.sync_api import sync_playwright
from websockets.asyncio.client import connect

from benchmarks.live import process, running
from runner.live.live import Live

SECONDS = 10.0
"""Of each measurement."""
SETTLE_SECONDS = 3.0
"""Until what has just been started or opened is at rest."""
OPTIONS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
COUNTS = (None, 0, 1, 10)
"""Open pages; None without a page process."""
DELAYS = """
    window.delays = [];
    document.addEventListener("load", ({target}) => {
      const taken = Number(/photo\\/(\\d+)\\.jpg/.exec(target.src ?? "")?.[1] ?? 0) / 1e6;
      const note = () => window.delays.push(performance.timeOrigin + performance.now() - taken);
      if (taken > performance.timeOrigin) requestAnimationFrame(note);
    }, true);
"""
"""Milliseconds by which each picture is late that was taken since the page was opened."""


@contextlib.contextmanager
def served(live: Live) -> Generator[tuple[psutil.Process, str]]:
    """A page process on a run, and its address."""
    command = [sys.executable, "-m", "runner.cli", "page", "--run", live.entry.run]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as page:
        try:
            assert page.stdout is not None
            yield psutil.Process(page.pid), page.stdout.readline().split()[1]
        finally:
            page.terminate()


def shown(url: str, rounds: int) -> tuple[list[float], list[float]]:
    """Milliseconds until first paint, one a round, and by which each picture of one page is late."""
    paints, delays = list[float](), list[float]()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=list(OPTIONS))
        for _ in range(rounds):
            page = browser.new_context().new_page()
            page.add_init_script(DELAYS)
            page.goto(url)
            page.wait_for_selector("figure img")
            paints.append(page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime"))
            page.wait_for_timeout(1000 * SECONDS / rounds)
            delays += page.evaluate("window.delays")
            page.context.close()
        browser.close()
    return paints, delays


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
    seen = ""
    async with connect(url.replace("http", "ws") + "live", max_size=None) as socket:
        await socket.send(json.dumps({"view": "scene", "language": "en"}))
        async for text in socket:
            told: dict[str, Any] = json.loads(text)
            view = told["value"].get("view") if told["name"] == "told en" else None
            if view and view["photo"]["key"] != seen:
                seen = view["photo"]["key"]
                await asyncio.to_thread(_fetch, f"{url}photo/{seen}.jpg")
                if time.time() - int(seen) * 1e-9 < 1.0:
                    caught_up.set()


def _fetch(url: str) -> None:
    with contextlib.suppress(HTTPError), urlopen(url) as answer:
        answer.read()


async def cost(live: Live, page: psutil.Process | None, url: str, count: int) -> tuple[float, float]:
    """Words that the graph says a second, and the share of a core that the page's server takes."""
    async with visitors(url, count):
        await asyncio.sleep(SETTLE_SECONDS)
        before, began, used = _words(live), time.monotonic(), _cpu(page)
        await asyncio.sleep(SECONDS)
        seconds = time.monotonic() - began
        return (_words(live) - before) / seconds, (_cpu(page) - used) / seconds


def _words(live: Live) -> int:
    status = live.status()
    return sum(process(status, f"grinder{k}").sent["word"].messages for k in range(os.cpu_count() or 1))


def _cpu(page: psutil.Process | None) -> float:
    if page is None:
        return 0.0
    times = page.cpu_times()
    return times.user + times.system


def main() -> None:
    """Prints paint, delay and cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    stages = {"camera": {"stage": "benchmarks.recording_stages:Camera", "config": {"hertz": 5, "seconds": 3600}}}
    stages |= {f"grinder{k}": {"stage": "benchmarks.page_stages:Grinder"} for k in range(os.cpu_count() or 1)}
    story = "benchmarks.page_stages:PictureStory"
    with tempfile.TemporaryDirectory() as folder, running(Path(folder), "page", stages, story=story) as live:
        with served(live) as (_, url):
            paints, delays = shown(url, options.rounds)
        print(f"first paint     {median(paints):6.0f} ms, slowest of {len(paints)} {max(paints):.0f} ms")
        print(f"picture behind  {median(delays):6.0f} ms, slowest of {len(delays)} {max(delays):.0f} ms", flush=True)
        found: dict[int | None, list[tuple[float, float]]] = {count: [] for count in COUNTS}
        for _ in range(options.rounds):
            found[None].append(asyncio.run(cost(live, None, "", 0)))
            with served(live) as (page, url):
                for count in (0, 1, 10):
                    found[count].append(asyncio.run(cost(live, page, url, count)))
    alone = median(words for words, _ in found[None])
    for count, measured in found.items():
        words, cpu = (median(column) for column in zip(*measured, strict=True))
        name = "no page process" if count is None else f"{count} open pages"
        print(f"{name:<16}{words:8.1f} words/s ({words / alone:6.1%}), page's server {cpu:6.2%} of a core")


if __name__ == "__main__":
    main()
