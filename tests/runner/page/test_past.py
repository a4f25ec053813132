"""Recordings that several pages have told again."""

from __future__ import annotations

import asyncio
import os
import shutil
import threading
from pathlib import Path

import pytest

from runner.contract import Refused
from runner.page import past
from runner.page.history import past_runs

OLD = Path(__file__).parents[1] / "weather-1.mcap"


def test_what_is_no_file_is_no_past_run(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "folder.mcap").mkdir()
    shutil.copy(OLD, tmp_path)
    assert [run.name for run in past_runs(tmp_path)] == ["weather-1"]


def test_a_recording_is_read_once_for_all_who_wait_and_the_newest_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, all_wait = list[str](), threading.Event()

    def reading(recording: Path, language: str) -> past.Past:
        all_wait.wait()
        read.append(recording.stem)
        if not recording.stat().st_size:
            raise Refused("there is nothing yet")
        return past.Past(b"[]", {}, recording.stat().st_size)

    async def wanted() -> None:
        pasts, (first, *others) = past.Pasts(), [tmp_path / f"{number}" for number in range(past.KEPT + 1)]
        first.touch()
        asking = [asyncio.create_task(pasts.of(first, "en")) for _ in range(3)]
        await asyncio.sleep(0)
        all_wait.set()
        assert [str(one) for one in await asyncio.gather(*asking, return_exceptions=True)] == [
            "there is nothing yet"
        ] * 3
        assert read == ["0"]
        first.write_text("something")
        kept = await pasts.of(first, "en")
        assert await pasts.of(first, "en") is kept
        first.write_text("something more")
        assert await pasts.of(first, "en", grown=True) is kept
        assert await pasts.of(first, "en") is not kept
        assert read == ["0"] * 3
        for other in others:
            other.write_text("something")
            await pasts.of(other, "en")
        await pasts.of(first, "en")
        assert read == ["0", "0", "0", "1", "2", "3", "4", "0"]

    monkeypatch.setattr(past, "retold", reading)
    asyncio.run(wanted())
