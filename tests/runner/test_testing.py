"""What people test their stages with: one stage without a run, and a run that says how it ended."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from runner.contract import Context, Message, Refused, Stage
from runner.graph.reading import load_graph
from runner.message.codec import CodecError, decode
from runner.process.step import BrokenContract, step_seed
from runner.recording.recording import Recording
from runner.testing import read_until, run_graph, run_stage, start_graph
from tests.runner.common.recordings import TOYS, record_toys
from tests.runner.common.runs import DOUBLES
from tests.runner.common.toys import (
    Account,
    Add,
    Answer,
    Counter,
    Double,
    Doubler,
    Gatherer,
    Number,
    Piece,
    Splitter,
    Sum,
    Total,
    Worker,
)


def answer(index: int, value: float, count: int = 2) -> Answer:
    return Answer(index=index, count=count, samples=np.array([value]))


def test_a_stage_answers_message_by_message():
    assert run_stage(Doubler(Doubler.Config()), [Number(value=1), Number(value=4)]) == [
        Double(value=2),
        Double(value=8),
    ]


class Radio(Stage):
    """Hears something now and then, and doubles what it is told meanwhile."""

    device = True

    def source(self, ctx: Context) -> Iterator[Number | None]:
        for heard in (None, 1, None, None, 2, None):
            time.sleep(0.01)
            yield None if heard is None else Number(value=heard)

    def on_double(self, double: Double) -> Number:
        return Number(value=double.value)


def test_a_source_may_have_nothing_yet():
    assert run_stage(Radio()) == [Number(value=1), Number(value=2)]


def test_a_source_runs_to_its_end_or_its_limit():
    numbers = run_stage(Counter(Counter.Config(count=3)))
    assert numbers == [Number(value=0), Number(value=1), Number(value=2, last=True)]
    assert len(run_stage(Counter(Counter.Config(count=10**9)), limit=2)) == 2


def test_a_gather_waits_for_its_parts_and_sorts_them():
    first = {"answers": [answer(1, 4.0), answer(0, 3.0)], "number": Number(value=0)}
    second = {"number": Number(value=1, last=True), "answers": [answer(0, 5.0), answer(1, 6.0)]}
    totals: list[Total] = run_stage(Gatherer(), [first, second])
    assert [(total.samples.tolist(), total.last) for total in totals] == [([3, 4], False), ([5, 6], True)]


def test_what_lacks_its_partner_emits_nothing_and_is_named(capsys: pytest.CaptureFixture[str]):
    assert run_stage(Gatherer(), [{"answers": [answer(0, 3.0)]}]) == []
    assert "debug    on_answers of given.item#0 still lacks answers, number" in capsys.readouterr().out


def test_random_numbers_hang_on_seed_name_and_message_as_in_a_run(tmp_path: Path):
    graph = load_graph(TOYS, ("sink.path=out",))
    both = {"piece": Piece(index=0, count=1, value=0), "number": Number(value=0)}
    worker = graph.nodes["worker"].construct()
    (first,) = run_stage(worker, [both], seed=graph.seed, name="worker")
    rng = np.random.default_rng(step_seed(graph.seed, "worker", "given.piece#0"))
    np.testing.assert_array_equal(first.samples, rng.random(3))
    assert not np.array_equal(run_stage(worker, [both], seed=8, name="worker")[0].samples, first.samples)
    recording = Recording(record_toys(tmp_path)[0])
    pieces = run_stage(Splitter(Splitter.Config()), [Number(value=0)])
    assert [piece.value for piece in pieces] == [0, 0, 0, 0]
    assert decode(Piece, recording.envelope("splitter.piece#3").body) == pieces[3]


class Clock(Message, frozen=True, kw_only=True):
    time_ns: int
    folder: str


class Told(Stage):
    """Says what its context says."""

    def on_start(self, ctx: Context) -> None:
        ctx.log("ready", level="warning")

    def on_number(self, number: Number, ctx: Context) -> Clock:
        (ctx.directory / "file").touch()
        return Clock(time_ns=ctx.time_ns, folder=str(ctx.directory))


def test_the_context_has_time_folder_and_log(tmp_path: Path):
    said: list[tuple[str, str]] = []
    given = [Number(value=0), Number(value=1)]
    clocks = run_stage(Told(), given, folder=tmp_path, log=lambda text, level: said.append((level, text)))
    assert [clock.time_ns for clock in clocks] == [0, 1_000_000_000]
    assert ([clock.time_ns for clock in run_stage(Told(), given, times_ns=[7, 9])]) == [7, 9]
    assert said == [("warning", "ready")]
    assert (tmp_path / "file").exists()
    assert not Path(run_stage(Told(), given)[0].folder).exists()


def test_commands_are_messages_like_others():
    assert run_stage(Account(), [Add(amount=3), Add(amount=4)])[-1] == Sum(total=7, calls=2)


class Liar(Stage):
    """Breaks its word."""

    def on_number(self, number: Number) -> Total:
        if number.value:
            return None  # type: ignore[return-value]
        return Total(samples=np.zeros((2, 2)), last=False) if number.last else Number(value=1)  # type: ignore[return-value]


def test_errors_are_those_of_the_handler():
    with pytest.raises(ValueError, match=r"^cannot double 3$"):
        run_stage(Doubler(Doubler.Config(raise_at=3)), [Number(value=3)])
    with pytest.raises(Refused, match="nothing to add"):
        run_stage(Account(), [Add(amount=0)])
    with pytest.raises(BrokenContract, match="emitted a Number; its annotations announce total"):
        run_stage(Liar(), [Number(value=0)])
    with pytest.raises(BrokenContract, match=r"^returned None, which its annotation does not allow$"):
        run_stage(Liar(), [Number(value=1)])
    with pytest.raises(CodecError, match=r"Total.*samples"):
        run_stage(Liar(), [Number(value=0, last=True)])


class Cutter(Stage):
    """Emits pieces as it is told: (index, count) of each."""

    def __init__(self, *pieces: tuple[int, int]) -> None:
        self._pieces = pieces

    def on_number(self, number: Number) -> Iterator[Piece]:
        for index, count in self._pieces:
            yield Piece(index=index, count=count, value=number.value)


@pytest.mark.parametrize(
    ("pieces", "reason"),
    [
        ([(5, 2)], "emitted piece with index 5 of 2; valid: 0 to 1"),
        ([(0, 2), (-1, 2)], "emitted piece with index -1 of 2; valid: 0 to 1"),
        ([(0, 0)], "emitted piece with index 0 of 0; valid: a count of 1 and more"),
        ([(0, 2), (0, 2)], "emitted piece with index 0 of 2 twice in one step; valid: each index from 0 to 1 once"),
        ([(0, 2), (1, 3)], "emitted piece with index 1 of 3, after one of 2 in the same step; valid: the same count"),
    ],
)
def test_a_part_that_no_gather_could_take_breaks_the_contract(pieces: list[tuple[int, int]], reason: str):
    with pytest.raises(BrokenContract, match=f"^{re.escape(reason)}$"):
        run_stage(Cutter(*pieces), [Number(value=0)])


def test_parts_may_come_in_any_order_and_again_in_the_next_step():
    assert len(run_stage(Cutter((1, 2), (0, 2)), [Number(value=0), Number(value=1)])) == 4


class Subtract(Stage):
    """Has two inputs of one type."""

    def on_numbers(self, minuend: Number, subtrahend: Number) -> Double:
        return Double(value=minuend.value - subtrahend.value)


def test_what_fits_no_port_or_several_is_refused_with_the_ports():
    both = {"minuend": Number(value=9), "subtrahend": Number(value=2)}
    assert run_stage(Subtract(), [both]) == [Double(value=7)]
    with pytest.raises(Refused, match=r"Subtract: a Number fits minuend and subtrahend: name one, {'minuend': ...}"):
        run_stage(Subtract(), [Number(value=1)])
    with pytest.raises(Refused, match=r"Worker: a Double fits no input; inputs: piece \(Piece\), number \(Number\)"):
        run_stage(Worker(Worker.Config()), [Double(value=1)])
    with pytest.raises(Refused, match="Subtract has no input 'minuent'; did you mean 'minuend'"):
        run_stage(Subtract(), [{"minuent": Number(value=1)}])


# ---------------------------------------------------------------------------------------------- a whole graph


def test_a_graph_runs_and_its_messages_are_there(tmp_path: Path):
    run = run_graph(DOUBLES, f"sink.path={tmp_path / 'out.txt'}", folder=tmp_path)
    assert (run.code, run.output.splitlines()[-1]) == (0, "5 doubles"), run.output
    assert [double.value for double in run.messages(Double)] == [0, 2, 4, 6, 8]
    assert Recording(run.recording).verdict.complete


def test_a_run_without_a_recording_of_its_own_says_why(tmp_path: Path):
    run = run_graph("name: nothing", folder=tmp_path)
    assert run.code == 2
    with pytest.raises(LookupError, match=r": no recording; it printed:\n.*: stages: expected a mapping"):
        run.messages(Double)
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).touch()
    with pytest.raises(LookupError, match=r": several recordings, a\.mcap, b\.mcap; valid: a folder for each run$"):
        print(run.recording)


TEXT = """
name: waiting
stages:
  counter:
    stage: tests.runner.common.toys:Counter
    config: {count: 100000, period: 0.01}
"""


def test_a_graph_that_takes_too_long_is_ended_and_shows_what_it_printed(tmp_path: Path):
    with pytest.raises(TimeoutError, match=r"longer than 10 s; it printed:\n(.*\n)*.*processes are ready"):
        run_graph(TEXT, folder=tmp_path, seconds=10)
    assert Recording(next(tmp_path.glob("*.mcap"))).verdict.complete


def test_what_is_never_said_ends_the_graph_too(tmp_path: Path):
    process = start_graph(TEXT, folder=tmp_path)
    began = time.monotonic()
    with pytest.raises(TimeoutError, match=re.escape("'the moon' never appeared; it printed:")):
        read_until(process, "the moon", seconds=2)
    assert process.returncode != 0 and time.monotonic() - began < 60
