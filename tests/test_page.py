"""The robot on its page: a goal is shown, an object moved, the restoring stopped, by mouse and keyboard alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from runner.testing import Run, finish, runner, start_graph
from stages.messages import Answer, Question
from tests.runner.page.browser import browser, faults, opened, read_address

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_person_shows_a_scene_and_gets_it_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with paged(tmp_path, monkeypatch, "world.seed=1") as (page, run):
        teaches(page)
        listed = runner("goals").communicate(timeout=60)[0]
        assert listed.startswith("breakfast\n    6 objects: the ")
        assert "runner call demonstrator restore name=breakfast ask=true" in listed
        edits(page)
        restores_and_stops(page)
        assert "brunch" in runner("goals", "brunch", "--delete").communicate(timeout=60)[0]
        expect(page.get_by_role("heading", name="brunch")).to_have_count(0)
        tells_it_in_german(page)
    assert "COMPLETE" in run().output


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_person_is_asked_what_a_look_leaves_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The detector does not know the tea box, and nobody looks for it; of the two salt shakers the goal has one."""
    twins = ("world.suite=twins", "world.seed=28", "detector.labels=[salt_shaker]", "hypotheses.suggestions=false")
    with paged(tmp_path, monkeypatch, *twins) as (page, run):
        answers_about_the_unknown(page)
        says_which_is_meant(page)
    found = run()
    assert "COMPLETE" in found.output
    assert [one.doubt.key for one in found.messages(Question)] == ["unknown", "unknown", "which salt_shaker", "unknown"]
    assert [one.choice for one in found.messages(Answer)] == ["again", "leave", "salt_shaker_2", "leave"]
    again = runner("replay", str(found.recording), "--verify")
    assert "IDENTICAL" in again.communicate(timeout=300)[0] and again.returncode == 0


@contextmanager
def paged(folder: Path, monkeypatch: pytest.MonkeyPatch, *settings: str) -> Generator[tuple[Page, Callable[[], Run]]]:
    """A robot that waits for a person, on its page; the run, once that has been left."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    monkeypatch.setenv("XDG_DATA_HOME", str(folder))
    graph = ROOT / "graphs" / "interactive.yaml"
    process = start_graph(graph, *settings, "corrector.calibrate=false", folder=folder, options=["--page"])
    try:
        printed, url = read_address(process)
        with browser() as chromium, opened(chromium, url, patience_ms=120_000) as page:
            yield page, lambda: finish(process, folder, before=printed)
    finally:
        process.terminate()


def answers_about_the_unknown(page: Page) -> None:
    """Looks once more, then goes on without it."""
    page.get_by_label("Name of the scene").fill("shelf")
    page.keyboard.press("Enter")
    question = page.locator(".question")
    expect(question).to_contain_text("There is something here that I do not know.")
    expect(page.locator(".picture .name.marked")).to_have_text("? Unknown")
    question.get_by_role("button", name="Look again").press("Enter")
    expect(question).to_have_count(0)
    question.get_by_role("button", name="Go on without it").press("Enter")
    expect(page.locator(".notice")).to_contain_text("remembered: the salt shaker and the salt shaker 2.")


def says_which_is_meant(page: Page) -> None:
    page.locator(".cards summary").first.press("Enter")
    page.get_by_role("button", name="Leave the salt shaker 2 out").press("Enter")
    expect(page.locator(".cards")).to_contain_text("One object: the salt shaker")
    page.get_by_role("button", name="Restore").press("Enter")
    question = page.locator(".question")
    expect(question).to_contain_text("Several objects could be the salt shaker.")
    assert faults(page) == []
    question.get_by_role("button", name="Salt shaker 2").press("Enter")
    question.get_by_role("button", name="Go on without it").press("Enter")
    expect(page.locator(".notice")).to_contain_text("“shelf” is restored")


def edits(page: Page) -> None:
    page.locator(".cards summary").first.press("Enter")
    page.get_by_role("button", name="Leave the sugar box out").press("Enter")
    expect(page.locator(".cards")).to_contain_text("5 objects: ")
    turned = page.locator(".lines li").filter(has_text="The milk carton may show any side.")
    turned.get_by_label("Label or handle").select_option("half a turn")
    turned.get_by_role("button", name="Choose").press("Enter")
    expect(page.get_by_text("The milk carton shows the side opposite to the one in the picture.")).to_be_visible()
    page.get_by_text("More").first.press("Enter")
    page.get_by_label("New name").fill("brunch")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="brunch")).to_be_visible()


def teaches(page: Page) -> None:
    page.get_by_label("Name of the scene").fill("breakfast")
    page.get_by_role("button", name="Remember this scene").press("Enter")
    expect(page.locator(".doing")).to_contain_text("“breakfast” is remembered: ")
    names = page.locator(".picture .name")
    expect(names).to_have_count(6)
    assert {text.partition(" ")[2] for text in names.all_inner_texts()} == {
        *("tray", "cup", "tea box", "tuna can", "milk carton", "sugar box")
    }
    expect(page.get_by_role("region", name="What is there").get_by_role("listitem")).to_have_count(6)
    expect(page.get_by_role("img", name="What stands on, in and next to what").locator("rect")).to_have_count(7)
    page.wait_for_function("[...document.images].every((image) => image.complete && image.naturalWidth === 640)")
    assert faults(page) == []


def restores_and_stops(page: Page) -> None:
    page.get_by_role("button", name="cup", exact=True).focus()
    for key in [*["ArrowDown"] * 5, "Enter"]:
        page.keyboard.press(key)
    expect(page.get_by_text("What the robot saw before something was moved")).to_be_visible()
    page.get_by_role("button", name="Restore").click()
    expect(page.locator(".what")).to_have_text(re.compile(r"Waits for your go; left to move: \d, about 1 min"))
    expect(page.locator(".arrow")).not_to_have_count(0)
    assert faults(page) == []
    page.get_by_role("button", name="Go", exact=True).press("Enter")
    for number, name in enumerate(("milk carton", "cup"), 1):
        step = re.compile(rf"Now\s+Puts the {name} on the table\s.*Step {number} of 2", re.DOTALL)
        expect(page.get_by_role("region", name="Now")).to_contain_text(step)
    expect(page.get_by_role("button", name="Restore")).to_be_disabled()
    page.keyboard.press("Escape")
    stopped = page.get_by_text(re.compile(r"^Stopped, as you asked"))
    expect(stopped).to_be_visible()
    page.get_by_role("button", name="Restore").press("Enter")
    expect(page.get_by_role("button", name="Go", exact=True)).to_be_enabled()
    page.keyboard.press("Escape")
    expect(stopped).to_be_visible()
    expect(page.get_by_role("button", name="Restore")).to_be_enabled()


def tells_it_in_german(page: Page) -> None:
    page.get_by_label("Language").select_option("de")
    page.get_by_role("button", name="Noch einmal hinsehen").click()
    expect(page.get_by_text("Erkennt, was da ist")).to_be_visible()
    expect(page.get_by_text("Der Roboter wartet auf Sie")).to_be_visible()
    expect(page.get_by_role("region", name="Was da ist").get_by_text("Das Tablett ist auf dem Tisch.")).to_be_visible()
    page.get_by_role("link", name="Verlauf").click()
    expect(page.get_by_text("wird geschrieben")).to_be_visible()
