"""Ports come from annotations, and a stage that breaks the contract is told where."""

from collections.abc import Iterator

import pytest

from runner.contract import Context, Message, Refused, Stage, Struct
from runner.graph.ports import inspect_stage, port_name
from tests.runner.common.toys import Account, Add, Answer, Collect, Double, Gatherer, Number, Piece, Total, Worker


def test_a_join_with_a_gather_is_read():
    stage = inspect_stage(Gatherer)
    (handler,) = stage.handlers
    assert [(port.name, port.type, port.kind) for port in handler.inputs] == [
        ("answers", Answer, "gather"),
        ("number", Number, "one"),
    ]
    assert stage.outputs == {"total": Total}
    assert handler.context is None


def test_the_part_drives_its_join_and_the_rest_is_kept():
    (handler,) = inspect_stage(Worker).handlers
    assert handler.driver is not None
    assert handler.driver.name == "piece"
    assert [handler.keeps(port) for port in handler.inputs] == [False, True]
    assert handler.context == "ctx"


def test_outputs_are_found_in_unions_and_iterators():
    class Many(Stage):
        def on_number(self, number: Number) -> Iterator[Double | Total] | None: ...

    assert inspect_stage(Many).outputs == {"double": Double, "total": Total}


def test_port_names_are_snake_case():
    assert port_name(Number) == "number"
    assert port_name(type("SceneEstimate", (Number,), {})) == "scene_estimate"
    assert port_name(type("RGBFrame", (Number,), {})) == "rgb_frame"


def test_commands_are_inputs_that_are_called():
    kind = inspect_stage(Account)
    assert kind.commands == {"add": Add, "collect": Collect}
    assert [handler.is_command for handler in kind.handlers] == [True, True, False]


class CommandJoined(Stage):
    def on_add(self, add: Add, number: Number) -> None: ...


class NoAnnotation(Stage):
    def on_number(self, number) -> None: ...  # type: ignore[no-untyped-def]


class NoResult(Stage):
    def on_number(self, number: Number): ...  # type: ignore[no-untyped-def]


class WrongType(Stage):
    def on_number(self, number: int) -> None: ...


class ListOfWhole(Stage):
    def on_numbers(self, numbers: list[Number]) -> None: ...


class TwoParts(Stage):
    def on_parts(self, piece: Piece, answer: Answer) -> None: ...


class SharedPort(Stage):
    def on_first(self, number: Number) -> None: ...

    def on_second(self, number: Number, double: Double) -> None: ...


class TOTAL(Number, frozen=True): ...


class TwoTotals(Stage):
    def on_number(self, number: Number) -> Total | TOTAL: ...


class NotADevice(Stage):
    def source(self, ctx: Context) -> Iterator[Number]: ...


class Empty(Stage):
    pass


class MutableConfig(Stage):
    class Config:
        pass

    def on_number(self, number: Number) -> None: ...


class Tagged(Struct, frozen=True):
    children: tuple["Tagged", ...] = ()
    tags: tuple[dict[str, frozenset[str] | None], ...] = ()


class Labels(Message, frozen=True):
    labels: tuple[Tagged, ...] = ()


class EmitsSet(Stage):
    def on_number(self, number: Number) -> Labels | None: ...


class TakesSet(Stage):
    def on_labels(self, labels: Labels) -> None: ...


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (EmitsSet, "EmitsSet: Labels.labels.tags: a set has no order; valid: tuple"),
        (TakesSet, "TakesSet: Labels.labels.tags: a set has no order; valid: tuple"),
        (NoAnnotation, r"NoAnnotation.on_number\(number\): has no annotation"),
        (NoResult, r"NoResult.on_number\(return\): has no annotation"),
        (WrongType, r"WrongType.on_number\(number\): .* is not a Message"),
        (ListOfWhole, r"ListOfWhole.on_numbers\(numbers\): a list gathers Parts, and Number is not one"),
        (CommandJoined, r"CommandJoined.on_add\(add\): a command is the only message its handler takes"),
        (TwoParts, r"TwoParts.on_parts\(piece, answer\): a handler takes at most one Part"),
        (SharedPort, "SharedPort: on_first and on_second would share the port 'number'; rename one of them"),
        (
            TwoTotals,
            "TwoTotals: .*toys:Total and .*:TOTAL would share the port 'total'; rename one of them",
        ),
        (NotADevice, "NotADevice.source: only a stage marked `device = True`"),
        (Empty, "Empty: has no handlers"),
        (MutableConfig, "MutableConfig.Config: must be a frozen dataclass"),
    ],
)
def test_a_broken_contract_is_named(cls: type[Stage], message: str):
    with pytest.raises(Refused, match=message):
        inspect_stage(cls)
