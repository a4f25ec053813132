"""Conditions on messages, such as ``ranker.scene_estimate.winner > 0``: a small language of its own, never ``eval``.

A name is ``stage.port`` followed by fields and indices; messages of several ports are those of one lineage.
There are comparisons, ``in``, ``and``, ``or``, ``not``,
``+ - * / // %``, numbers, text, ``None``, ``True``, ``False``, lists, and the functions ``len abs min max any all``.
A field of a list of records is the list of that field: ``any(ranker.scene_estimate.objects.cost > 1)``.
"""

from __future__ import annotations

import ast
import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import msgspec
import numpy as np

from runner.contract import Message, Refused
from runner.graph.document import suggest

MAX_LENGTH = 1000
MAX_DEPTH = 50
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "len": len, "abs": np.abs, "min": np.min, "max": np.max, "any": np.any, "all": np.all,
}  # fmt: skip
"""Each takes one argument."""
_OPERATORS: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod,
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Is: operator.is_, ast.IsNot: operator.is_not,
    ast.In: lambda value, values: value in values, ast.NotIn: lambda value, values: value not in values,
}  # fmt: skip
_UNARY: dict[type[ast.AST], Callable[[Any], Any]] = {
    ast.Not: operator.not_,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_ARRAY_FIELDS = ("shape", "size")
_NODES = (
    ast.Expression, ast.BoolOp, ast.And, ast.Or, ast.BinOp, ast.UnaryOp, ast.Compare, ast.Call, ast.Constant,
    ast.Attribute, ast.Subscript, ast.Name, ast.Load, ast.List, ast.Tuple, *_OPERATORS, *_UNARY,
)  # fmt: skip
_VALID = f"comparisons, and, or, not, + - * / // %, indices, in, {', '.join(FUNCTIONS)}"


class Expression:
    """A checked condition on messages of one or more ports."""

    def __init__(self, text: str, ports: Mapping[str, Mapping[str, type[Message]]]) -> None:
        """``ports`` has the output ports of every stage. Raises Refused, naming the part that is not valid."""
        self.text = text
        self._ports = ports
        self._tree = _parse(text)
        self.topics = frozenset(self._check(self._tree.body))
        """``stage/port`` of all that it names."""
        if not self.topics:
            raise self._refused("names no message; valid: stage.port.field, for example camera.frame.index > 3")

    def holds(self, messages: Mapping[str, Message]) -> bool:
        """Whether it holds for messages by topic; false while one is still to come.

        Raises Refused where it asks a message for what it does not have.
        """
        if not self.topics <= messages.keys():
            return False
        value = self._guarded(self._tree.body, messages)
        try:
            return bool(value)
        except ValueError:
            raise self._refused("is many values; valid: any(...) or all(...) of it") from None

    def _refused(self, reason: str) -> Refused:
        return Refused(f"--break {self.text!r}: {reason}")

    def _guarded(self, node: ast.expr, messages: Mapping[str, Message]) -> Any:
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self._value(node, messages)
        except (TypeError, ValueError, ArithmeticError, LookupError, AttributeError) as error:
            raise self._refused(f"{type(error).__name__}: {error}") from None

    # ------------------------------------------------------------------------------------ checking

    def _check(self, node: ast.AST) -> set[str]:
        """The topics below a node; raises Refused for what is not in the language."""
        topic = self._topic(node)
        if topic:
            return {topic}
        if not isinstance(node, _NODES) or (isinstance(node, ast.Constant) and isinstance(node.value, bytes | complex)):
            raise self._refused(f"{_source(node)} is not in the language; valid: {_VALID}")
        if isinstance(node, ast.Call):
            return self._check_call(node)
        if isinstance(node, ast.Name):
            raise self._refused(f"{node.id!r} alone is no message{self._stage_hint(node.id)}")
        return {topic for child in ast.iter_child_nodes(node) for topic in self._check(child)}

    def _check_call(self, node: ast.Call) -> set[str]:
        name = node.func.id if isinstance(node.func, ast.Name) else _source(node.func)
        if name not in FUNCTIONS or node.keywords or len(node.args) != 1:
            raise self._refused(f"{_source(node)} is not in the language; valid: {', '.join(FUNCTIONS)} of one value")
        return self._check(node.args[0])

    def _topic(self, node: ast.AST) -> str:
        """``stage/port`` of ``stage.port``; empty for everything else."""
        if not (isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)):
            return ""
        stage, port = node.value.id, node.attr
        if stage not in self._ports:
            raise self._refused(f"no stage {stage!r}{suggest(stage, self._ports)}")
        if port not in self._ports[stage]:
            raise self._refused(f"{stage} has no output {port!r}{suggest(port, self._ports[stage])}")
        return f"{stage}/{port}"

    def _stage_hint(self, name: str) -> str:
        if name in self._ports:
            return f"; valid: {', '.join(f'{name}.{port}' for port in self._ports[name]) or 'it has no outputs'}"
        return suggest(name, self._ports)

    # ------------------------------------------------------------------------------------ evaluating

    def _value(self, node: ast.expr, messages: Mapping[str, Message]) -> Any:
        topic = self._topic(node)
        if topic:
            return messages[topic]
        match node:
            case ast.Constant():
                return node.value
            case ast.List() | ast.Tuple():
                return [self._value(item, messages) for item in node.elts]
            case ast.Attribute():
                return self._field(self._value(node.value, messages), node.attr)
            case ast.Subscript():
                return _item(self._value(node.value, messages), self._value(node.slice, messages))
            case _:
                return self._operation(node, messages)

    def _operation(self, node: ast.expr, messages: Mapping[str, Message]) -> Any:
        match node:
            case ast.BoolOp(op=ast.And()):
                return all(self._value(value, messages) for value in node.values)
            case ast.BoolOp():
                return any(self._value(value, messages) for value in node.values)
            case ast.UnaryOp():
                return _UNARY[type(node.op)](_numbers(self._value(node.operand, messages)))
            case ast.BinOp():
                left, right = self._value(node.left, messages), self._value(node.right, messages)
                return _OPERATORS[type(node.op)](_number(left), _number(right))
            case ast.Call():
                return FUNCTIONS[cast("ast.Name", node.func).id](self._value(node.args[0], messages))
            case ast.Compare():
                return self._comparison(node, messages)
            case _:
                raise TypeError(f"{_source(node)} has no value")

    def _comparison(self, node: ast.Compare, messages: Mapping[str, Message]) -> Any:
        """``a < b < c`` is ``a < b and b < c``, element by element for arrays."""
        values = [self._value(value, messages) for value in (node.left, *node.comparators)]
        found: Any = True
        for operation, left, right in zip(node.ops, values, values[1:], strict=False):
            contains = isinstance(operation, ast.In | ast.NotIn | ast.Is | ast.IsNot)
            one = _OPERATORS[type(operation)](*((left, right) if contains else (_numbers(left), _numbers(right))))
            found = one if found is True else np.logical_and(found, one)
        return found

    def _field(self, value: Any, name: str) -> Any:
        """A field of a record, the fields of many, or the shape of an array: no other attribute can be reached."""
        if isinstance(value, msgspec.Struct):
            if name not in value.__struct_fields__:
                raise self._refused(
                    f"{type(value).__name__} has no field {name!r}{suggest(name, value.__struct_fields__)}"
                )
            return getattr(value, name)
        if isinstance(value, np.ndarray) and name in _ARRAY_FIELDS:
            return getattr(cast("Any", value), name)
        if isinstance(value, list | tuple):
            return [self._field(item, name) for item in cast("Sequence[Any]", value)]
        raise self._refused(f"{type(value).__name__} has no field {name!r}")


def _parse(text: str) -> ast.Expression:
    refused = Refused(f"--break {text[:80]!r}: is longer than {MAX_LENGTH} characters")
    if len(text) > MAX_LENGTH:
        raise refused
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        raise Refused(
            f"--break {text!r}: is no expression: {reason or type(error).__name__}; valid: {_VALID}"
        ) from None
    if _depth(tree) > MAX_DEPTH:
        raise Refused(f"--break {text!r}: is nested deeper than {MAX_DEPTH} levels")
    return tree


def _depth(tree: ast.AST) -> int:
    level, depth = [tree], 0
    while level:
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        depth += 1
    return depth


def _item(value: Any, index: Any) -> Any:
    """One item, by number, by several numbers for an array, by key for a mapping: nothing that makes arrays larger."""
    kinds, numbers = (str | int, index) if isinstance(value, dict) else (int, index)
    if isinstance(value, np.ndarray) and isinstance(index, list):
        numbers = tuple(cast("list[Any]", index))
    if not isinstance(value, list | tuple | np.ndarray | dict):
        raise TypeError(f"a {type(value).__name__} has no items")
    if not all(isinstance(number, kinds) for number in (numbers if isinstance(numbers, tuple) else (numbers,))):
        raise TypeError(f"{index!r} is no index")
    return cast("Any", value)[numbers]


def _number(value: Any) -> Any:
    """Arithmetic is for numbers and arrays of them: repeated text or lists would only fill memory."""
    value = _numbers(value)
    if not isinstance(value, int | float | np.number | np.ndarray | np.bool_):
        raise TypeError(f"{type(value).__name__} is no number")
    return value


def _numbers(value: Any) -> Any:
    """A list of numbers as an array, so that it is compared element by element; everything else as it is."""
    if isinstance(value, list | tuple) and value:
        items = cast("Sequence[Any]", value)
        if all(isinstance(item, int | float | str | np.number) for item in items):
            return np.array(items)
    return value


def _source(node: ast.AST) -> str:
    try:
        return repr(ast.unparse(node)[:60])
    except (ValueError, RecursionError, AttributeError):
        return type(node).__name__
