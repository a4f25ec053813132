"""Changed stages of recordings executed again, as a user types it."""

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from runner.cli.main import main
from runner.contract import Context, Message, Refused, Stage
from runner.graph.reading import load_graph
from runner.message.codec import Envelope, Step, decode, envelope
from runner.process.forks import clean_environment
from runner.process.inbox import Ready
from runner.process.step import Executor, receive
from runner.recording.recording import Recording
from tests.runner.common import toys as toy_stages
from tests.runner.common.recordings import ToyRun, record, record_toys
from tests.runner.common.runs import ACCOUNT, TOYS
from tests.runner.common.toys import (
    Account,
    Add,
    Answer,
    Doubler,
    Gatherer,
    Number,
    Piece,
    Splitter,
    Sum,
    Total,
    Worker,
)
from tests.runner.replay.test_replay import replay

DOUBLES = """
name: doubles
stages:
  counter: {stage: tests.runner.common.toys:Counter}
  doubler: {stage: tests.runner.common.toys:Doubler, inputs: {number: counter.number}}
"""

LATEST = f"""
name: latest
stages:
  counter: {{stage: tests.runner.common.toys:Counter}}
  doubler: {{stage: tests.runner.common.toys:Doubler, inputs: {{number: counter.number}}}}
  teller: {{stage: "{__name__}:Teller", inputs: {{double: {{from: doubler.double, policy: latest}}}}}}
"""


DIARY = f"""
name: diary
stages:
  counter: {{stage: tests.runner.common.toys:Counter, config: {{count: 2}}}}
  splitter: {{stage: tests.runner.common.toys:Splitter, inputs: {{number: counter.number}}}}
  worker: {{stage: "{__name__}:Uneven", replicas: 2, inputs: {{piece: splitter.piece, number: counter.number}}}}
  diary: {{stage: "{__name__}:Diary", inputs: {{answer: worker.answer}}}}
"""


ALBUM = f"""
name: album
stages:
  camera: {{stage: "{__name__}:Camera"}}
  weigher: {{stage: "{__name__}:Weigher", inputs: {{picture: camera.picture}}}}
"""


MEASURED = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
"""A program that runs another and says how much memory that held at most, beginning with little itself."""


class Picture(Message, frozen=True):
    """A megabyte."""

    pixels: bytes


class Camera(Stage):
    """Takes 150 pictures."""

    device = True

    def source(self) -> Iterator[Picture]:
        return (Picture(pixels=bytes(2**20)) for _ in range(150))


class Weigher(Stage):
    """Says how large pictures are."""

    def on_picture(self, picture: Picture) -> "Told":
        return Told(text=str(len(picture.pixels)))


class Told(Message, frozen=True):
    """What a teller says."""

    text: str


class Teller(Stage):
    """Says doubles in words."""

    def on_double(self, double: toy_stages.Double) -> Told:
        return Told(text=f"{double.value}")


class Uneven(Worker):
    """Needs longest for the first part, so that the others overtake it."""

    def on_piece(self, piece: Piece, number: Number, ctx: Context) -> Answer:
        time.sleep(0.3 * (piece.index == 0))
        return super().on_piece(piece, number, ctx)


class Diary(Stage):
    """Says in which order answers came."""

    stateful = True

    def __init__(self):
        self._seen: list[int] = []

    def on_answer(self, answer: Answer) -> Told:
        self._seen.append(answer.index)
        return Told(text=str(self._seen))


class Sparing(Splitter):
    """Needs one part only for the fourth number."""

    def on_number(self, number: Number) -> Iterator[Piece]:
        return iter((Piece(index=0, count=1, value=3),)) if number.value == 3 else super().on_number(number)


class Strict(Account):
    """Adds nothing."""

    def on_add(self, add: Add, ctx: Context) -> Sum:
        raise Refused("closed")


class Louder(Gatherer):
    """The same totals, twice as large."""

    def on_answers(self, answers: list[Answer], number: Number) -> Total:
        total = super().on_answers(answers, number)
        return Total(samples=2 * total.samples, last=total.last)


class Mute(Gatherer):
    """Fails on the third number."""

    def on_answers(self, answers: list[Answer], number: Number) -> Total | None:
        if number.value == 2:
            raise ValueError("no third total")
        return super().on_answers(answers, number)


class Quitting(Gatherer):
    """Leaves on the third number, as a script would."""

    def on_answers(self, answers: list[Answer], number: Number) -> Total | None:
        return sys.exit("no third total") if number.value == 2 else super().on_answers(answers, number)


class Leaving(Gatherer):
    """Its process goes while others work."""

    def on_answers(self, answers: list[Answer], number: Number) -> Total:
        threading.Timer(0.1, os._exit, (7,)).start()
        return super().on_answers(answers, number)


class Closing(Gatherer):
    """Says that it was closed."""

    def close(self) -> None:
        Path(os.environ["CLOSED"]).touch()


class Grand:
    """Scores a toy run."""

    def __init__(self, settings: dict[str, object]) -> None:
        assert "gatherer" in settings

    def score(self, run: Iterator[tuple[str, Message]]) -> dict[str, float]:
        return {"sum": sum(float(message.samples.sum()) for _, message in run if isinstance(message, Total))}


class Double(Message, frozen=True):
    """Another class of the name that is recorded."""

    text: str


class Writer(Doubler):
    """Says in words what a doubler says in numbers."""

    def on_number(self, number: Number) -> Double:
        return Double(text=f"twice {number.value}")


class Count:
    """Scores what doublers say."""

    def __init__(self, settings: dict[str, object]) -> None: ...

    def score(self, run: Iterator[tuple[str, Message]]) -> dict[str, float]:
        return dict(Counter(type(message).__module__ for _, message in run))


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_toys(tmp_path_factory.mktemp("toys"))[0]


def row(said: str, topic: str) -> list[str]:
    """The cells of a topic in the first table: identical, changed, appeared, vanished."""
    return next(line.split()[1:] for line in said.splitlines() if line.startswith(topic))


@pytest.mark.parametrize("workers", ["1", "2", "3"])
def test_without_a_change_nothing_changes_however_many_work(toys: Path, workers: str):
    code, said = replay(toys, "--from", "splitter", "--workers", workers)
    assert code == 0, said
    assert "executed again: splitter, worker, gatherer; as recorded: counter, sink, watcher" in said
    assert row(said, "worker/answer") == ["20", "-", "-", "-"]
    assert said.splitlines()[-1] == "NOTHING CHANGES: 45 identical, of 3 stages"


def test_parts_that_overtake_each_other_are_taken_one_by_one_as_recorded(tmp_path: Path):
    file = tmp_path / "diary.yaml"
    file.write_text(DIARY)
    graph = load_graph(file)
    path, _ = record(graph, tmp_path / "diary.mcap", ToyRun(graph, tmp_path).records())
    code, said = replay(path, "--from", "splitter", "--workers", "2")
    assert code == 0, said
    assert said.splitlines()[-1] == "NOTHING CHANGES: 24 identical, of 3 stages"


class Hasty(ToyRun):
    """Two doubles of five are replaced before their consumer has time."""

    def _delivered(self, sealed: Envelope) -> Iterator[Envelope | Step]:
        return iter(()) if sealed.id in ("doubler.double#1", "doubler.double#2") else super()._delivered(sealed)


def test_what_was_replaced_by_newer_ones_stays_so_between_stages_that_are_executed(tmp_path: Path):
    file = tmp_path / "latest.yaml"
    file.write_text(LATEST)
    graph = load_graph(file)
    path, _ = record(graph, tmp_path / "latest.mcap", Hasty(graph, tmp_path).records())
    code, said = replay(path, "--from", "doubler")
    assert code == 0, said
    assert "executed again: doubler, teller; as recorded: counter" in said
    assert said.splitlines()[-1] == "NOTHING CHANGES: 8 identical, of 2 stages"


class Ended(ToyRun):
    """The graph ends while the fourth number is split: one of two parts is not worked on, and the fifth number left."""

    def _worked_on(self, process: tuple[str, int], ready: Ready) -> Iterator[Envelope | Step]:
        ids = {arrival.envelope.id for arrival in ready.arrivals}
        left = ids & {"counter.number#4", "splitter.piece#13"}
        return iter(()) if left else super()._worked_on(process, ready)

    def _emitted(
        self, process: tuple[str, int], handler: str, consumed: tuple[tuple[str, str], ...], out: list[Envelope]
    ) -> Iterator[Envelope | Step]:
        stopped = (process[0], *consumed) == ("splitter", ("number", "counter.number#3"))
        for one in super()._emitted(process, handler, consumed, out[:2] if stopped else out):
            yield msgspec.structs.replace(one, outcome="stopped") if stopped and isinstance(one, Step) else one


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ended")
    graph = load_graph(TOYS, (f"sink.path={folder / 'out.txt'}",))
    path, verdict = record(graph, folder / "ended.mcap", Ended(graph, folder).records())
    assert verdict.complete, verdict
    return path


@pytest.mark.parametrize("workers", ["1", "2"])
def test_what_was_stopped_and_left_when_the_graph_ended_stays_so(ended: Path, workers: str):
    code, said = replay(ended, "--from", "splitter", "--workers", workers)
    assert code == 0, said
    assert said.splitlines()[-1] == "NOTHING CHANGES: 30 identical, of 3 stages"
    _, said = replay(ended, "--set", "seed=8", "--workers", workers)
    assert (row(said, "worker/answer"), row(said, "gatherer/total")) == (["-", "13", "-", "-"], ["-", "3", "-", "-"])
    assert "appeared: " not in said


def test_what_was_left_for_want_of_a_part_is_taken_where_it_is_wanted_no_more(ended: Path):
    _, said = replay(ended, "--swap", "splitter=tests.runner.replay.test_whatif:Sparing")
    assert row(said, "gatherer/total") == ["3", "-", "1", "-"]
    assert "appeared: gatherer.total#3" in said


def called(folder: Path, *amounts: int) -> Path:
    """A recording of an account that was told to add these."""
    graph = load_graph(ACCOUNT, ("counter.count=0",))
    executor = Executor(graph.nodes["account"], Account(), seed=0, directory=folder, log=lambda *_: None)
    (handler,) = (one for one in graph.nodes["account"].type.handlers if one.name == "on_add")
    records: list[Envelope | Step] = []
    for number, amount in enumerate(amounts):
        id = f"supervisor.account_add#{number}"
        add = envelope(Add(amount=amount), id=id, lineage=id, time_ns=number, causes=())
        out, error = list[Envelope](), ""
        try:
            out += executor.run(handler, [receive(handler.inputs[0], add)], number)
        except Refused as refusal:
            error = f"Refused: {refusal}"
        sent, taken = (Step(name, 0, 0, number, "", (), (), number, 0, 0, 0) for name in ("supervisor", "account"))
        ids = tuple(sealed.id for sealed in out)
        taken = msgspec.structs.replace(
            taken, handler="on_add", consumed=(("add", id),), emitted=ids, outcome="done", error=error
        )
        records += [add, msgspec.structs.replace(sent, emitted=(id,)), *out, taken]
    return record(graph, folder / "account.mcap", records)[0]


def test_a_command_that_was_refused_then_as_well_is_no_failure(tmp_path: Path):
    code, said = replay(called(tmp_path, 3, 0, 4), "--from", "account")
    assert (code, said.splitlines()[-1]) == (0, "NOTHING CHANGES: 2 identical, of 1 stages"), said
    assert "FAILED" not in said
    code, said = replay(tmp_path / "account.mcap", "--swap", "account=tests.runner.replay.test_whatif:Strict")
    assert code == 1
    assert "FAILED account.on_add of supervisor.account_add#0: Refused: closed" in said


def test_fewer_parts_gather_to_other_totals(toys: Path):
    code, said = replay(toys, "--set", "splitter.parts=3")
    assert code == 0, said
    assert row(said, "splitter/piece") == ["-", "15", "-", "5"]
    assert row(said, "worker/answer") == ["-", "15", "-", "5"]
    assert row(said, "gatherer/total") == ["-", "5", "-", "-"]
    assert "vanished: splitter.piece#15, splitter.piece#16" in said
    assert "device sink would have been sent: changed gatherer.total#0, gatherer.total#1" in said
    assert "What it emitted stays as recorded" in said


def test_more_parts_appear_with_the_ids_that_a_run_would_give(toys: Path, tmp_path: Path):
    _, said = replay(toys, "--set", "splitter.parts=5")
    assert row(said, "splitter/piece") == ["-", "20", "5", "-"]
    live = Recording(record_toys(tmp_path, "splitter.parts=5")[0])
    assert "appeared: splitter.piece#20, " in said
    assert sum(id.startswith("splitter.piece#") for id in live.messages) == 25


def test_a_swapped_class_changes_its_messages_by_how_much_and_the_score(toys: Path):
    swap = "gatherer=tests.runner.replay.test_whatif:Louder"
    code, said = replay(toys, "--swap", swap, "--set", "score=tests.runner.replay.test_whatif:Grand")
    assert code == 0, said
    assert "executed again: gatherer; as recorded: " in said
    assert row(said, "gatherer/total") == ["-", "5", "-", "-"]
    largest = max(largest_samples(toys))
    (change,) = (line.split() for line in said.splitlines() if line.startswith("gatherer/total  samples[]"))
    assert change == ["gatherer/total", "samples[]", "5", "of", "5", f"{largest:.3g}", "gatherer.total#0"]
    before, now, gap = (float(cell) for cell in row(said, "sum "))
    assert now == pytest.approx(2 * before, rel=1e-3)
    assert gap == pytest.approx(before, rel=1e-3)


def largest_samples(path: Path) -> Iterator[float]:
    recording = Recording(path)
    for id in recording.messages:
        if id.startswith("gatherer.total#"):
            yield float(decode(Total, recording.envelope(id).body).samples.max())


def test_messages_of_another_class_have_changed(tmp_path: Path):
    """Nobody consumes them: the graph is as good as before."""
    file = tmp_path / "doubles.yaml"
    file.write_text(DOUBLES)
    graph = load_graph(file)
    path, _ = record(graph, tmp_path / "doubles.mcap", ToyRun(graph, tmp_path).records())
    swap = ("--swap", f"doubler={__name__}:Writer")
    code, said = replay(path, *swap, "--set", f"score={__name__}:Count")
    assert code == 0, said
    assert row(said, "doubler/double") == ["-", "5", "-", "-"]
    assert "doubler/double  fields    5 of 5        -  doubler.double#0" in said
    assert (row(said, "tests.runner.common.toys"), row(said, __name__)) == (["10", "5", "-5"], ["-", "5", "-"])
    code, said = replay(path, *swap, "--until", "doubler.double#1")
    assert code == 0, said
    assert "differ from the recording" in said


@pytest.mark.parametrize(("stage", "error"), [("Mute", "ValueError"), ("Quitting", "SystemExit")])
def test_what_a_handler_raises_is_named_and_its_message_vanishes(toys: Path, stage: str, error: str):
    code, said = replay(toys, "--swap", f"gatherer=tests.runner.replay.test_whatif:{stage}")
    assert code == 1
    assert f"FAILED gatherer.on_answers of counter.number#2: {error}: no third total" in said
    assert "vanished: gatherer.total#4" in said


def test_a_process_that_has_gone_between_two_steps_is_named(toys: Path):
    swap = ("--swap", "gatherer=tests.runner.replay.test_whatif:Leaving")
    code, said = replay(toys, *swap, "--set", "worker.seconds=0.1", "--workers", "1")
    assert code == 2
    assert "gatherer.on_answers of counter.number#1: its process ended with exit code 7" in said


def test_stages_are_closed_at_the_end(toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CLOSED", str(tmp_path / "closed"))
    code, said = replay(toys, "--swap", "gatherer=tests.runner.replay.test_whatif:Closing")
    assert code == 0, said
    assert (tmp_path / "closed").exists()


def test_what_stays_as_recorded_is_not_held_in_memory(tmp_path: Path):
    file = tmp_path / "album.yaml"
    file.write_text(ALBUM)
    graph = load_graph(file)
    path, _ = record(graph, tmp_path / "album.mcap", ToyRun(graph, tmp_path).records())
    command = (sys.executable, "-c", MEASURED, sys.executable, "-m", "runner.cli", "replay", path, "--from", "weigher")
    *_, said, kilobytes = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert said == "NOTHING CHANGES: 150 identical, of 1 stages"
    assert int(kilobytes) < 130 * 1024


def test_another_seed_executes_everything(toys: Path):
    _, said = replay(toys, "--set", "seed=8")
    assert "executed again: splitter, worker, gatherer, watcher; as recorded: counter, sink" in said
    assert row(said, "splitter/piece") == ["20", "-", "-", "-"]
    assert row(said, "worker/answer") == ["-", "20", "-", "-"]


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--from", "gatherr"], "--from gatherr: no stage 'gatherr'; did you mean 'gatherer'? valid: gatherer"),
        (["--from", "counter"], "counter is a device, and what it emitted is recorded; valid: splitter, worker"),
        (["--set", "counter.count=3"], "counter is a device"),
        (["--set", "splitter.parts=4"], "nothing changes; valid: --from STAGE"),
        (["--set", "splitter.part=4"], "unknown key 'part'; did you mean 'parts'"),
        (["--swap", "gatherer"], "--swap gatherer: expected stage=module:Class"),
        (["--swap", "gather=a:B"], "no stage 'gather'; did you mean 'gatherer'"),
        (
            ["--swap", "gatherer=tests.runner.common.toys:Gathrer"],
            "no class 'Gathrer' in tests.runner.common.toys",
        ),
        (["--swap", "gatherer=tests.runner.common.toys:Doubler"], "has no input 'answers'"),
        (["--from", "splitter", "--verify"], "--verify compares the recording as it is"),
    ],
)
def test_what_is_impossible_is_refused_with_what_is_valid(
    toys: Path, arguments: list[str], error: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for name, value in clean_environment().items():
        monkeypatch.setenv(name, value)  # nothing is executed: this process will do
    assert main(["replay", str(toys), *arguments]) == 2
    assert error in capsys.readouterr().err
