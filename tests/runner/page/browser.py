"""A real browser for tests of pages: Debian's chromium, without a window and without calls to the outside."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Generator
from contextlib import contextmanager

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect, sync_playwright

from runner.testing import read_until

OPTIONS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
SERIOUS = ("serious", "critical")


def read_address(process: subprocess.Popen[str]) -> tuple[str, str]:
    """What a graph with a page prints until it is ready, and where the page is: two processes say so, in any order."""
    printed = read_until(process, "page: http")
    (url,) = re.findall(r"page: (\S+)", printed)
    if "processes are ready" not in printed:
        printed += read_until(process, "processes are ready")
    return printed, url


@contextmanager
def browser() -> Generator[Browser]:
    """A browser with a profile of its own; skips the test where there is none."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("needs a browser; type: apt-get install chromium")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=list(OPTIONS))
        yield started
        started.close()


@contextmanager
def opened(
    browser: Browser, url: str, *, width: int = 1280, language: str = "en-GB", patience_ms: float = 60_000
) -> Generator[Page]:
    """A page of its own; fails where a script of it does. What is expected may take ``patience_ms``."""
    context = browser.new_context(viewport={"width": width, "height": 800}, locale=language)
    context.set_default_timeout(patience_ms)
    expect.set_options(timeout=patience_ms)
    page, errors = context.new_page(), list[str]()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    yield page
    context.close()
    assert errors == []


def faults(page: Page) -> list[str]:
    """What keeps people with a screen reader, a keyboard or weak eyes from using the page, if it is serious."""
    found = Axe().run(page).response["violations"]
    return [f"{one['id']}: {one['help']}: {one['nodes'][0]['html']}" for one in found if one["impact"] in SERIOUS]
