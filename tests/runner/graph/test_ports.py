"""Ports come from annotations, and a stage that breaks the contract is told where."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from runner.contract import Context, Message, Refused, Stage, Struct
from runner.graph.ports import inspect_stage, port_name, refuse_construction
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


class AnAttribute(Stage):
    on_air = False


class AProperty(Stage):
    @property
    def on_number(self) -> None: ...


class AStaticMethod(Stage):
    @staticmethod
    def on_number(number: Number) -> None: ...


class AnObject(Stage):
    on_number = functools.partial(print)


class Async(Stage):
    async def on_number(self, number: Number) -> None: ...


class Variadic(Stage):
    def on_number(self, *number: Number) -> None: ...


class ByPosition(Stage):
    def on_number(self, number: Number, /) -> None: ...


class StatefulDevice(Stage):
    device = True
    stateful = True

    def on_number(self, number: Number) -> None: ...


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (AnAttribute, r"AnAttribute.on_air: is of type bool and no method; valid: def on_air\(self, ...\), or another"),
        (AProperty, "AProperty.on_number: is of type property and no method; valid"),
        (AStaticMethod, "AStaticMethod.on_number: is of type staticmethod and no method; valid"),
        (AnObject, "AnObject.on_number: is of type partial and no method; valid"),
        (Async, "Async.on_number: is async, and nobody would await it; valid"),
        (Variadic, r"Variadic.on_number\(number\): is variadic positional, and messages are given by name"),
        (ByPosition, r"ByPosition.on_number\(number\): is positional-only, and messages are given by name"),
        (StatefulDevice, "StatefulDevice: is a device and stateful; valid: one of both, for its past lies outside"),
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


class Abstract(Stage, ABC):
    def on_number(self, number: Number) -> None: ...

    @abstractmethod
    def double(self) -> None: ...


class NeedsTwo(Stage):
    def __init__(self, port: int, host: str) -> None: ...

    def on_number(self, number: Number) -> None: ...


class LeavesSettings(Stage):
    @dataclass(frozen=True)
    class Config:
        port: int = 1

    def on_number(self, number: Number) -> None: ...


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (Abstract, "Abstract: is abstract, it has no double"),
        (NeedsTwo, "NeedsTwo.__init__: missing a required argument: 'port'; valid: def __init__.self.$"),
        (LeavesSettings, "LeavesSettings.__init__: too many .* arguments; valid: def __init__.self, config: Config.$"),
    ],
)
def test_what_no_graph_could_construct_is_named(cls: type[Stage], message: str):
    with pytest.raises(Refused, match=message):
        refuse_construction(inspect_stage(cls))
