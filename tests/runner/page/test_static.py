"""The page in a real browser, with a test as its server: what comes, goes, fails and stays away."""

from __future__ import annotations

import datetime as dt
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
from playwright.sync_api import Browser, Page, Route, WebSocketRoute, expect

from runner.page import story as s
from runner.page.feed import shape
from tests.runner.common.waiting import wait_until
from tests.runner.page.browser import browser, opened

STATIC = Path(s.__file__).with_name("static")
URL = "http://page.test/token/"
STOP = s.Action("lamp", "off", "Stop", {}, kind="stop")
RUN = {"graph": "lamp", "started": 0, "seconds": 9, "bytes": 9, "verdict": "COMPLETE", "running": False}


class Server:
    """Answers a page, and keeps what it called."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.calls = list[Any]()
        self.asked = list[str]()
        """Paths, as they were sent."""
        self.refusal = ""
        """Of every call."""
        self.unreachable = ""
        """A path, for which nobody listens."""
        self.silent = ""
        """A path, to which nobody answers."""
        self.sockets = list[WebSocketRoute]()
        page.route("**/*", self._answer)
        page.route_web_socket(re.compile("/live$"), self._connect)

    def open(self, view: str = "") -> None:
        """Has it loaded, and connected."""
        self.page.goto(f"{URL}{view}")
        expect(self.page.get_by_role("link", name="Scene")).to_be_visible()

    def put(self, name: str, value: object) -> None:
        self.sockets[-1].send(json.dumps({"name": name, "value": value}))

    def tell(self, text: str, *cards: s.Card, actions: tuple[s.Action, ...] = (STOP,)) -> None:
        """Tells it of cards, and waits until it shows that."""
        told = s.Told(s.Doing(text), cards_title="Lamps", cards=cards, actions=actions)
        self.put("told en", msgspec.to_builtins(told, enc_hook=shape))
        expect(self.page.locator(".what")).to_have_text(text)

    def called(self, *commands: str) -> list[Any]:
        """The arguments of its calls, of these commands. A call comes another way than what is shown: perhaps later."""
        wait_until(lambda: len(self.calls) >= len(commands) or self.page.wait_for_timeout(20))
        assert [one["command"] for one in self.calls] == [*commands]
        return [one["arguments"] for one in self.calls]

    def _connect(self, socket: WebSocketRoute) -> None:
        self.sockets.append(socket)

    def _answer(self, route: Route) -> None:
        path = urlsplit(route.request.url).path.removeprefix("/token/") or "index.html"
        self.asked.append(path)
        if path == "call":
            self.calls.append(route.request.post_data_json)
        if path == self.unreachable:
            route.abort()
        elif path == self.silent:
            pass
        elif path == "call":
            route.fulfill(status=422 if self.refusal else 200, body=self.refusal or "id")
        elif path == "runs":
            route.fulfill(json=[{"name": "50%", **RUN}])
        elif path.startswith("runs/"):
            route.fulfill(json=[])
        else:
            route.fulfill(path=STATIC / path)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser() as started:
        yield started


@pytest.fixture
def server(chromium: Browser) -> Iterator[Server]:
    with opened(chromium, "about:blank") as page:
        yield Server(page)


def lamp(name: str, *parts: str) -> s.Card:
    """A card: a lamp that can be lit and labelled, and of which parts can be taken off."""
    light = s.Action("lamp", "light", f"Light {name}", {"name": name})
    label, dye = (
        s.Action("lamp", "change", label, {"name": name}, s.Ask("text", f"{what} {name}"))
        for label, what in (("Label", "Text on"), ("Dye", "Colour of"))
    )
    lines = tuple(
        s.Line(part, f"It has {part}.", (s.Action("lamp", "strip", f"Strip {part}", {"part": part}),)) for part in parts
    )
    return s.Card(name, name, "", None, (light,), (label, dye), lines, "Parts")


# ------------------------------------------------------------------------------------------ what comes and goes


def test_what_is_typed_stays_with_its_card_though_another_one_goes(server: Server) -> None:
    server.open()
    server.tell("three", lamp("bar"), lamp("foo"), lamp("zoo"))
    server.page.get_by_text("More foo").press("Enter")
    server.page.get_by_label("Text on foo").fill("mine")
    server.tell("two", lamp("foo"), lamp("zoo"))
    server.page.keyboard.press("Enter")
    assert server.called("change") == [{"name": "foo", "text": "mine"}]


def test_a_second_press_never_means_something_else(server: Server) -> None:
    server.open()
    server.tell("two", lamp("foo", "shade", "bulb"))
    server.page.get_by_text("Parts foo").press("Enter")
    server.page.get_by_role("button", name="Strip shade").press("Enter")
    server.tell("one", lamp("foo", "bulb"))
    server.page.keyboard.press("Enter")
    server.page.get_by_role("button", name="Stop").press("Enter")
    assert server.called("strip", "off")[0]["part"] == "shade"


def test_a_button_waits_for_its_answer_but_stop_can_always_be_pressed(server: Server) -> None:
    server.open()
    server.tell("there", lamp("foo"), lamp("bar"))
    server.silent = "call"
    light, stop = (server.page.get_by_role("button", name=name) for name in ("Light foo", "Stop"))
    light.press("Enter")
    expect(light).to_be_disabled()
    server.page.keyboard.press("Enter")
    server.page.get_by_text("More foo").press("Enter")
    for asked in ("Text on foo", "Colour of foo"):
        server.page.get_by_label(asked).fill("red")
        server.page.keyboard.press("Enter")
    expect(server.page.get_by_role("button", name="Light bar")).to_be_enabled()
    stop.press("Enter")
    stop.press("Enter")
    server.tell("pressed", lamp("foo"))
    server.called("light", "change", "change", "off", "off")


def test_stop_can_be_pressed_while_all_else_waits_for_the_program(server: Server) -> None:
    server.open()
    server.put("run", {"name": "lamp", "state": "starting", "waits": ["lamp"]})
    server.page.get_by_text("it waits for lamp").wait_for()
    told = s.Told(s.Doing("starts"), cards_title="Lamps", cards=(lamp("foo"),), actions=(STOP,))
    server.put("told en", msgspec.to_builtins(told, enc_hook=shape))
    expect(server.page.get_by_role("button", name="Light foo")).to_be_disabled()
    server.page.get_by_role("button", name="Stop").press("Enter")
    server.page.keyboard.press("Escape")
    expect(server.page.get_by_text("Passed on")).to_have_count(0)
    server.called("off", "off")


# ------------------------------------------------------------------------------------------ what fails


def test_a_refusal_stands_at_its_card_until_the_next_call_or_connection(server: Server) -> None:
    server.open()
    server.tell("two", lamp("foo"), lamp("bar"))
    refused = server.page.locator(".refused")
    for name in ("foo", "bar"):
        server.refusal = f"{name} is hot"
        server.page.get_by_role("button", name=f"Light {name}").press("Enter")
        expect(refused).to_have_text(f"That does not work: {name} is hot")
        card = server.page.get_by_role("listitem").filter(has_text=f"Light {name}")
        expect(card.locator(".refused")).to_be_visible()
    server.sockets[-1].close()
    expect(refused).to_have_count(0)


@pytest.mark.parametrize("how", ["unreachable", "silent"])
def test_of_a_call_without_an_answer_nobody_knows_whether_it_arrived(server: Server, how: str) -> None:
    impatient(server.page)
    server.open()
    server.tell("there", lamp("foo"))
    setattr(server, how, "call")
    server.page.get_by_role("button", name="Light foo").press("Enter")
    give_up(server.page)
    expect(server.page.locator(".refused")).to_contain_text("it is not known whether this has reached")
    expect(server.page.get_by_role("button", name="Light foo")).to_be_enabled()


@pytest.mark.parametrize("how", ["unreachable", "silent"])
def test_what_could_not_be_read_is_said_and_can_be_tried_again(server: Server, how: str) -> None:
    impatient(server.page)
    again, unread = server.page.get_by_role("button", name="Try again"), server.page.get_by_text("No answer came.")
    setattr(server, how, "runs")
    server.open("#history")
    give_up(server.page)
    expect(unread).to_be_visible()
    setattr(server, how, "runs/50%25/en.json")
    again.press("Enter")
    server.page.get_by_role("link", name="Replay").press("Enter")
    expect(server.page.get_by_text("Reading the recording").or_(unread)).to_be_visible()
    give_up(server.page)
    expect(unread).to_be_visible()
    setattr(server, how, "")
    again.press("Enter")
    expect(server.page.get_by_text("Nothing is told of this recording.")).to_be_visible()


def test_an_address_that_nobody_encoded_is_taken_as_it_is(server: Server) -> None:
    server.open("#history/50%")
    expect(server.page.get_by_text("Nothing is told of this recording.")).to_be_visible()
    assert "runs/50%25/en.json" in server.asked


def test_a_page_whose_texts_do_not_come_asks_again(server: Server) -> None:
    server.unreachable = "en.json"
    server.page.goto(URL)
    expect(server.page.get_by_text("Loading")).to_be_visible()
    wait_until(lambda: "en.json" in server.asked or server.page.wait_for_timeout(20))
    server.unreachable = ""
    expect(server.page.get_by_role("link", name="Scene")).to_be_visible()
    assert server.asked.count("en.json") > 1


def test_a_file_that_is_too_large_is_refused_before_it_is_read(server: Server, tmp_path: Path) -> None:
    server.open()
    file = tmp_path / "x"
    bring = s.Action("lamp", "bring", "Import", {}, s.Ask("file", "A file", kind="file"))
    server.tell("there", s.Card("foo", "foo", "", None, (bring,)))

    def import_file(size: int) -> None:
        file.write_bytes(b"x" * size)
        server.page.get_by_label("A file").set_input_files(file)
        server.page.get_by_role("button", name="Import").click()

    import_file(10_000_001)
    refused = "That does not work: the file has 10.0 MB; at most 10.0 MB can be imported"
    expect(server.page.locator(".refused")).to_have_text([refused])
    assert server.calls == []
    with server.page.expect_request("**/call"):
        import_file(10)
    expect(server.page.locator(".refused")).to_have_text([])


def test_why_nothing_new_is_told_is_said(server: Server) -> None:
    server.open()
    server.put("fault", "byte 4711: the file ends inside a record")
    expect(server.page.locator(".banner")).to_contain_text("shows what it knew last: byte 4711: the file ends")


def test_a_connection_without_a_word_is_a_lost_one(server: Server) -> None:
    begin = dt.datetime(2026, 1, 1)
    server.page.clock.install(time=begin)
    server.page.clock.pause_at(begin + dt.timedelta(hours=1))
    server.open()
    lost, light = server.page.get_by_text("cannot be reached"), server.page.get_by_role("button", name="Light foo")
    for text in ("there", "still there"):
        server.tell(text, lamp("foo"))
        server.page.clock.run_for(10_000)
        expect(light).to_be_enabled()
    server.page.clock.run_for(5_000)
    expect(lost).to_be_visible()
    expect(light).to_be_disabled()
    expect(server.page.get_by_role("button", name="Stop")).to_be_enabled()
    server.page.clock.run_for(1_000)
    expect(lost).to_have_count(0)
    assert len(server.sockets) == 2


def impatient(page: Page) -> None:
    """Has a page wait for answers until :func:`give_up`."""
    page.add_init_script(
        "window.waits = new EventTarget(); AbortSignal.timeout = () => { const one = new AbortController();"
        "waits.addEventListener('over', () => one.abort()); return one.signal; };"
    )


def give_up(page: Page) -> None:
    """The time is over for all that has not been answered."""
    page.evaluate("waits.dispatchEvent(new Event('over'))")
