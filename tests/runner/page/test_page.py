"""The page of a running graph, in a real browser and by bare requests."""

from __future__ import annotations

import http.client
import json
import re
import signal
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, expect
from websockets.sync.client import connect

from runner.contract import Refused
from runner.page.guard import new_token
from runner.page.watch import Watch
from runner.testing import finish, runner, start_graph
from tests.runner.common.waiting import wait_until
from tests.runner.page.browser import browser, faults, opened, read_address
from tests.runner.page.toys import LampStory

LAMP = Path(__file__).with_name("lamp.yaml")
VIEWS = ("scene", "history", "engineer")


class Lamp:
    """A run of the lamp and where its page is."""

    def __init__(self, folder: Path, graph: Path = LAMP) -> None:
        self.folder = folder
        self.process = start_graph(graph, folder=folder)
        self.printed, self.url = read_address(self.process)

    def finish(self) -> None:
        self.process.terminate()
        finish(self.process, self.folder, before=self.printed)


@pytest.fixture(scope="module")
def lamp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lamp]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        running = Lamp(tmp_path_factory.mktemp("lamp"))
        yield running
        running.finish()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser() as started:
        yield started


@pytest.fixture
def page(lamp: Lamp, chromium: Browser) -> Iterator[Page]:
    with opened(chromium, lamp.url) as shown:
        yield shown


# ------------------------------------------------------------------------------------------ who may see it


def asked(url: str, path: str, method: str = "GET", body: str = "", **headers: str) -> tuple[int, str]:
    """Status and text of an answer; ``path`` is below the server, not below the token."""
    with closing(http.client.HTTPConnection(urlsplit(url).netloc, timeout=200)) as connection:
        connection.request(method, path, body or None, headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode(errors="replace")


def test_only_who_has_the_whole_address_sees_anything(lamp: Lamp) -> None:
    token = urlsplit(lamp.url).path
    assert asked(lamp.url, token)[0] == 200
    for path in ("/", f"{token[:-2]}/", f"/{'x' * 22}/", "/page.js", f"{token[:-1]}x/page.js"):
        assert asked(lamp.url, path) == (
            403,
            "no or another token: open the whole address that `runner up --page` has printed\n",
        )
    assert asked(lamp.url, f"{token}../../pyproject.toml")[0] in (403, 404)
    assert asked(lamp.url, f"{token}runs/..%2f..%2fsecret.mcap")[0] == 404


def test_other_pages_and_other_names_of_this_machine_are_refused(lamp: Lamp) -> None:
    path, own = urlsplit(lamp.url).path, urlsplit(lamp.url).netloc
    status, reason = asked(lamp.url, path, Host="evil.example")
    assert (status, reason.startswith("Host 'evil.example': this page is not there; valid: ")) == (403, True)
    for origin in ("http://evil.example", "null", f"http://{own}0"):
        status, reason = asked(lamp.url, f"{path}call", "POST", "{}", Origin=origin)
        assert (status, reason) == (403, f"Origin {origin!r}: another page may not speak to this one\n")
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    assert asked(lamp.url, f"{path}live", Origin="http://evil.example", **upgrade, **key)[0] == 403
    assert asked(lamp.url, "/live", Origin=f"http://{own}", **upgrade, **key)[0] == 403


def test_no_page_is_open_to_other_machines_unasked(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(new_token("127.0.0.1", "")) > 20 and new_token("::1", "") != new_token("::1", "")
    assert new_token("192.168.1.7", "a-long-enough_token") == "a-long-enough_token"
    with pytest.raises(
        Refused, match=r"--address 192\.168\.1\.7: a page beyond this machine needs a token: set RUNNER"
    ):
        new_token("192.168.1.7", "")
    with pytest.raises(Refused, match="RUNNER_PAGE_TOKEN: must be 16 or more letters"):
        new_token("192.168.1.7", "short")


def test_the_page_is_not_named_where_others_can_read(lamp: Lamp) -> None:
    token = urlsplit(lamp.url).path.strip("/").encode()
    for path in lamp.folder.rglob("*"):
        assert path.is_dir() or token not in path.read_bytes()
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has gone
            assert token not in path.read_bytes()


# ------------------------------------------------------------------------------------------ what is asked


def test_what_cannot_be_called_is_refused_in_words(lamp: Lamp) -> None:
    path = f"{urlsplit(lamp.url).path}call"

    def call(**request: object) -> tuple[int, str]:
        return asked(lamp.url, path, "POST", json.dumps(request))

    assert call(stage="lamp", command="blink", arguments={"time": "2"}) == (
        422,
        "lamp blink: no field 'time'; did you mean 'times'? valid: times",
    )
    assert call(stage="lamp", command="blink", arguments={"times": "many"})[0] == 422
    assert call(stage="lamp", command="burn", arguments={})[1].startswith("lamp has no command 'burn'")
    assert call(stage="lamp")[0] == 422
    assert asked(lamp.url, path)[0] == 404


def test_recordings_are_listed_and_can_be_downloaded(lamp: Lamp) -> None:
    path = urlsplit(lamp.url).path
    (run,) = json.loads(asked(lamp.url, f"{path}runs")[1])
    assert run["running"] and run["name"].startswith("lamp-") and run["graph"] == "lamp"
    status, _ = asked(lamp.url, f"{path}runs/{run['name']}.mcap")
    assert status == 200


# ------------------------------------------------------------------------------------------ what is shown


def test_a_person_sees_what_is_told_and_does_what_is_offered(page: Page) -> None:
    expect(page.get_by_text("has blinked 0 times")).to_be_visible()
    expect(page.get_by_role("img", name="A lamp.")).to_be_visible()
    expect(page.locator("figure img").first).to_have_js_property("naturalWidth", 64)
    expect(page.locator(".picture .name")).to_have_text(
        ["? unknown lamp", "! doubtful lamp", "? unsure lamp", "✓ sure lamp"]
    )
    page.get_by_label("How often").fill("3")
    page.keyboard.press("Enter")
    expect(page.get_by_text("has blinked 3 times")).to_be_visible()
    page.get_by_role("button", name="Dizzy").click()
    refusal = page.get_by_role("alert").filter(has_text="makes people dizzy")
    expect(refusal).to_have_text("That does not work: times=10: makes people dizzy; valid: 1 to 9")


def test_a_question_is_asked_and_marked_and_answered(page: Page) -> None:
    asked_now = page.get_by_role("alert").filter(has_text="Is it bright?")
    expect(asked_now).to_be_visible()
    expect(page.locator(".picture .name.marked")).to_have_text("? unsure lamp")
    expect(page.locator(".picture .step text")).to_have_text("1")
    asked_now.get_by_role("button", name="Very").press("Enter")
    page.goto(f"{page.url.partition('#')[0]}#engineer")
    expect(page.get_by_role("log")).to_contain_text("is dark very bright")


def test_what_is_kept_is_edited_downloaded_and_brought(page: Page, lamp: Lamp) -> None:
    page.get_by_text("Its parts").press("Enter")
    take_off = page.get_by_role("button", name="Take off")
    expect(take_off).to_have_accessible_description("It has a shade.")
    take_off.press("Enter")
    colour = page.get_by_label("Colour")
    expect(colour).to_have_accessible_description("It is red.")
    expect(colour).to_have_value("red")
    colour.select_option("light blue")
    page.get_by_role("button", name="Paint").press("Enter")
    page.get_by_text("More", exact=False).first.press("Enter")
    page.get_by_label("What to write on it").fill("mine")
    page.keyboard.press("Enter")
    with page.expect_download() as download:
        page.get_by_role("link", name="Export").press("Enter")
    assert (download.value.suggested_filename, download.value.path().read_bytes()) == ("lamp.txt", b"a lamp")
    page.get_by_label("A file").set_input_files([{"name": "x", "mimeType": "", "buffer": b"\xff\x00 a lamp"}])
    page.get_by_role("button", name="Import").press("Enter")
    assert faults(page) == []
    page.goto(f"{page.url.partition('#')[0]}#engineer")
    for note in ("is dark bare", "is dark blue", "is dark mine", "is dark /wAgYSBsYW1w"):
        expect(page.get_by_role("log").get_by_text(note)).to_be_visible()
    assert asked(lamp.url, f"{urlsplit(lamp.url).path}file/g")[0] == 404


def test_things_are_moved_by_mouse_and_by_keys(page: Page) -> None:
    thing = page.get_by_role("button", name="lamp", exact=True)
    thing.scroll_into_view_if_needed()
    box = thing.locator("path").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 0.5 * box["width"], y - 0.5 * box["height"], steps=4)  # a tenth of a metre, as it is 0.2 wide
    page.mouse.up()
    page.goto(f"{page.url.partition('#')[0]}#engineer")
    x, y = carried(page, 1)
    assert (x, y) == pytest.approx((0.6, -0.1), abs=0.02)
    page.goto(f"{page.url.partition('#')[0]}#scene")
    thing.focus()
    for key in ("ArrowLeft", "ArrowLeft", "ArrowDown", "Enter"):
        page.keyboard.press(key)
    page.goto(f"{page.url.partition('#')[0]}#engineer")
    assert carried(page, 2) == pytest.approx((x - 0.02, y + 0.04), abs=0.006)


def carried(page: Page, times: int) -> tuple[float, float]:
    """Where the lamp was carried last, once it was so often."""
    lines = page.get_by_role("log").get_by_text("carried to")
    expect(lines).to_have_count(times)
    x, y = lines.first.inner_text().split()[-2:]
    return float(x), float(y)


def test_a_page_that_stands_still_keeps_nobody_waiting(lamp: Lamp, page: Page) -> None:
    place = urlsplit(lamp.url)
    with connect(f"ws://{place.netloc}{place.path}live", max_queue=1, max_size=None, close_timeout=0.1) as still:
        still.send(json.dumps({"view": "engineer", "language": "en"}))
        for number in range(200):
            body = json.dumps({"stage": "lamp", "command": "switch", "arguments": {"note": f"{number} {'x' * 4000}"}})
            assert asked(lamp.url, f"{place.path}call", "POST", body)[0] == 200
        page.goto(f"{lamp.url}#engineer")
        expect(page.get_by_role("log")).to_contain_text("is dark 199")


def test_escape_stops_wherever_the_focus_is(page: Page) -> None:
    page.get_by_label("How often").focus()
    page.keyboard.press("Escape")
    page.goto(f"{page.url.partition('#')[0]}#engineer")
    expect(page.get_by_role("log")).to_contain_text("lamp stopped")


def test_an_engineer_sees_processes_topics_calls_and_the_log(page: Page) -> None:
    page.get_by_role("link", name="Engineer").click()
    process = page.get_by_role("region", name="Processes").get_by_role("row").filter(has_text="lamp")
    expect(process).to_contain_text("waiting")
    expect(page.get_by_role("region", name="Topics").get_by_role("row").filter(has_text="lamp/blinked")).to_be_visible()
    form = page.get_by_role("form", name="lamp switch")
    form.get_by_label("on", exact=True).check()
    form.get_by_label("colour").select_option("blue")
    form.get_by_label("note").fill("for a while")
    form.get_by_role("button", name="Call").click()
    expect(page.get_by_role("log")).to_contain_text("lamp is blue for a while")
    expect(form.get_by_role("button", name="Call")).to_be_enabled()
    form.get_by_label("on", exact=True).uncheck()
    form.get_by_role("button", name="Call").click()
    expect(page.get_by_role("log")).to_contain_text("lamp is dark")
    page.get_by_role("form", name="lamp blink").get_by_label("times").fill("1")
    page.get_by_role("form", name="lamp blink").get_by_role("button").click()
    expect(page.get_by_text("Answer").first).to_be_visible()


def test_all_of_it_is_there_in_german(lamp: Lamp, chromium: Browser) -> None:
    with opened(chromium, lamp.url, language="de-AT") as page:
        expect(page.get_by_text("-mal geblinkt")).to_be_visible()
        expect(page.get_by_role("link", name="Technik")).to_be_visible()
        assert page.evaluate("document.documentElement.lang") == "de"
        page.get_by_role("button", name="Dizzy").click()
        expect(page.get_by_text("Das geht nicht: times=10: macht schwindlig")).to_be_visible()
        page.get_by_label("Sprache").select_option("en")
        expect(page.get_by_text("That does not work: times=10: makes people dizzy")).to_be_visible()
        expect(page.get_by_text("has blinked")).to_be_visible()
        page.reload()
        expect(page.get_by_role("link", name="Engineer")).to_be_visible()


@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("view", VIEWS)
def test_every_view_can_be_used_without_eyes_mouse_or_a_large_screen(
    lamp: Lamp, chromium: Browser, view: str, width: int
) -> None:
    with opened(chromium, f"{lamp.url}#{view}", width=width) as page:
        expect(page.get_by_role("heading", level=2).first).to_be_visible()
        assert faults(page) == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_the_texts_of_both_languages_are_the_same_ones() -> None:
    static = Path(__file__).parents[3] / "runner" / "page" / "static"
    english, german = (json.loads((static / f"{language}.json").read_text()) for language in ("en", "de"))
    assert english.keys() == german.keys()
    for key, text in english.items():
        assert sorted(re.findall(r"\{\w+\}", text)) == sorted(re.findall(r"\{\w+\}", german[key])), key
    asked_for = {key for path in static.glob("*.js") for key in re.findall(r'page\.say\("(\w+)"', path.read_text())}
    assert asked_for <= english.keys()


def test_a_recording_is_told_again_from_its_beginning(lamp: Lamp, page: Page) -> None:
    blinked = re.compile(r"has blinked (\d+) times")
    (before,) = blinked.findall(page.get_by_text("has blinked").inner_text())
    for more in (1, 2):
        expect(page.get_by_role("button", name="Blink")).to_be_enabled()
        page.get_by_label("How often").fill("1")
        page.keyboard.press("Enter")
        expect(page.get_by_text("has blinked")).to_have_text(re.compile(rf"has blinked {int(before) + more} times"))
    page.get_by_role("link", name="History").click()
    page.get_by_role("link", name="Replay").click()
    then, slider = page.get_by_role("region", name="Then"), page.get_by_label("Moment")
    expect(then).to_contain_text(blinked)
    (first,) = blinked.findall(then.inner_text())
    second = f"has blinked {int(first) + 1} times"
    expect(page.get_by_role("img", name="A lamp.")).to_be_visible()
    expect(page.locator("figure img").first).to_have_js_property("naturalWidth", 64)
    page.get_by_role("button", name="Next").press("Enter")
    expect(then).to_contain_text(second)
    slider.press("ArrowLeft")
    expect(then).not_to_contain_text(second)
    expect(slider).to_have_attribute("aria-valuetext", re.compile(rf"\d s: has blinked {first} times"))
    assert faults(page) == []
    page.get_by_role("button", name="Play").press("Enter")
    expect(then).to_contain_text(f"has blinked {int(before) + 2} times")
    run = page.url.rpartition("/")[2]
    page.goto(f"{page.url.partition('#')[0]}#history/{run}/lamp.blinked#1")
    expect(then).to_contain_text(f"runner why lamp.blinked#1 {run}.mcap")
    expect(then).to_contain_text(f"runner view {run}.mcap --at lamp.blinked#1")
    (told,) = blinked.findall(then.inner_text())
    page.get_by_label("Language").select_option("de")
    expect(page.get_by_role("region", name="Damals")).to_contain_text(f"{told}-mal geblinkt")
    path = urlsplit(lamp.url).path
    assert [asked(lamp.url, f"{path}runs/{one}")[0] for one in (f"{run}/fr.json", "nothing/en.json")] == [422, 404]


def test_who_looks_at_another_recording_takes_nobodys_pictures_away(lamp: Lamp) -> None:
    path = urlsplit(lamp.url).path
    (recording,) = lamp.folder.rglob("*.mcap")
    other = recording.with_name("other.mcap")
    other.write_bytes(recording.read_bytes())
    try:
        for name in (recording.stem, other.stem):
            moments = json.loads(asked(lamp.url, f"{path}runs/{name}/en.json")[1])
            assert moments[0]["view"]["photo"] == {"key": "lamp.picture-0", "rgb": [48, 64, 3]}
        for name in (recording.stem, other.stem):
            assert asked(lamp.url, f"{path}runs/{name}/en/lamp.picture-0.jpg")[0] == 200
        assert asked(lamp.url, f"{path}runs/{other.stem}/de/lamp.picture-0.jpg")[0] == 200
        assert asked(lamp.url, f"{path}runs/{other.stem}/en/lamp.picture-1.jpg")[0] == 404
    finally:
        other.unlink()


def test_the_robot_in_3d_comes_from_the_same_address_and_calls_nobody_else(lamp: Lamp, page: Page) -> None:
    path = urlsplit(lamp.url).path
    status, html = asked(lamp.url, f"{path}viewer/index.html")
    assert status == 200 and "re_viewer_bg.wasm" in html
    assert asked(lamp.url, f"{path}viewer/other.wasm")[0] == 404
    blink = json.dumps({"stage": "lamp", "command": "blink", "arguments": {"times": "1"}})
    assert asked(lamp.url, f"{path}call", "POST", blink)[0] == 200
    name = json.loads(asked(lamp.url, f"{path}runs")[1])[0]["name"]
    status, reason = asked(lamp.url, f"{path}runs/{name}.rrd")
    assert status == 422 and "names no views" in reason
    called = list[str]()
    page.on("requestfinished", lambda request: called.append(request.url))
    expect(page.get_by_text("has blinked")).not_to_have_text("has blinked 0 times")
    page.goto(f"{page.url.partition('#')[0]}#history/{name}")
    page.get_by_role("button", name="Robot in 3D").press("Enter")
    viewer = page.frame_locator("iframe[title='Robot in 3D']")
    expect(viewer.locator("canvas")).to_be_attached()
    assert all(url.startswith(lamp.url) or url.startswith(("data:", "blob:")) for url in called)


def test_a_story_that_fails_takes_no_button_away(
    lamp: Lamp, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording,) = lamp.folder.rglob("*.mcap")
    watch = Watch(recording, lambda: None, lambda: True)
    watch.look(True)
    watch.read()
    told = watch.tell("en")
    for name in ("tell", "say"):
        monkeypatch.delattr(LampStory, name)
    assert told.actions and watch.tell("en") == watch.tell("de") == told
    assert watch.say("times=10: makes people dizzy", "de") == "times=10: makes people dizzy"
    assert "nothing new can be told: AttributeError: 'LampStory'" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["story", "damage"])
def test_why_nothing_more_is_read_is_known(
    lamp: Lamp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    (recording,) = lamp.folder.rglob("*.mcap")
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(recording.read_bytes()[:-3])
    if how == "story":
        monkeypatch.delattr(LampStory, "__init__")
    watch = Watch(broken, lambda: None, lambda: False)
    watch.look(True)
    watch.start()
    wait_until(lambda: watch.fault)
    assert ("takes no arguments" if how == "story" else "the file ends inside a record") in watch.fault


def test_a_page_that_hears_nothing_new_is_told_that_the_server_lives(lamp: Lamp) -> None:
    place, heard = urlsplit(lamp.url), defaultdict[str, list[object]](list)
    with connect(f"ws://{place.netloc}{place.path}live", max_size=None) as socket:
        socket.send(json.dumps({"view": "scene", "language": "en"}))
        while len(heard["beat"]) < 2 or not heard["told en"]:
            said = json.loads(socket.recv(timeout=60))
            heard[said["name"]].append(said["value"])
    assert heard["fault"] == [""]


def test_what_is_kept_is_listed_in_the_terminal_too(lamp: Lamp) -> None:
    assert runner("goals").communicate(timeout=60)[0] == (
        "A lamp\n    It blinks.\n    runner call lamp blink times=10\n    runner call lamp switch note=...\n"
    )
    assert runner("goals", "--graph", str(LAMP)).communicate(timeout=60)[0].startswith("A lamp\n")
    wrong = runner("goals", "A lump")
    assert (wrong.communicate(timeout=60)[0], wrong.returncode) == (
        "A lump: is not remembered; did you mean 'A lamp'? valid: A lamp\n",
        2,
    )
    kept = runner("goals", "A lamp", "--delete")
    assert (kept.communicate(timeout=60)[0], kept.returncode) == ("A lamp: cannot be deleted\n", 2)


# ------------------------------------------------------------------------------------------ beginning and end


def test_a_page_says_that_the_run_has_ended_and_leaves_no_process(
    chromium: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    running = Lamp(tmp_path / "run")
    (page_process,) = children(running.process.pid, "page")
    with opened(chromium, running.url) as page:
        expect(page.get_by_text("has blinked")).to_be_visible()
        running.process.send_signal(signal.SIGINT)
        expect(page.get_by_text("cannot be reached")).to_be_visible()
        expect(page.get_by_role("button", name="Blink")).to_be_disabled()
    running.finish()
    wait_until(lambda: not Path(f"/proc/{page_process}").exists())


def test_where_nobody_can_tell_the_story_the_page_says_so_and_still_calls(
    chromium: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    graph = tmp_path / "lamps.yaml"
    graph.write_text(f"{LAMP.read_text()}  other: {{stage: tests.runner.page.toys:Lamp}}\n")  # the story knows one lamp
    running = Lamp(tmp_path / "run", graph)
    with opened(chromium, running.url) as page:
        expect(page.locator(".banner")).to_contain_text("cannot follow the robot's program any more")
        page.get_by_role("link", name="Engineer").click()
        form = page.get_by_role("form", name="lamp blink")
        form.get_by_label("times").fill("1")
        form.get_by_role("button").click()
        expect(page.get_by_text("Answer").first).to_be_visible()
    running.process.send_signal(signal.SIGINT)
    running.finish()


def children(pid: int, command: str) -> list[int]:
    """Processes whose parent is ``pid`` and that were started with a command of the runner."""
    found: list[int] = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and f"\0{command}\0" in (path / "cmdline").read_text():
                found.append(int(path.name))
        except OSError:
            continue
    return found
