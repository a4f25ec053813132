"""Conditions on messages: Python expressions, such as ``ranker.scene_estimate.winner > 0``, with checked names."""

from __future__ import annotations

import ast
import builtins
from collections import defaultdict
from collections.abc import Iterator, Mapping
from types import SimpleNamespace

import msgspec
import numpy as np

from runner.contract import Message, Refused
from runner.graph.document import suggest


class Expression:
    """A condition on messages of one or more ports, each named ``stage.port``; ``np`` is NumPy."""

    def __init__(self, text: str, ports: Mapping[str, Mapping[str, type[Message]]]) -> None:
        """``ports`` has the output ports of every stage. Raises Refused for what is no expression or names none."""
        self._text = text
        self._ports = ports
        try:
            tree = ast.parse(text.strip(), mode="eval")
            self._code = compile(tree, "--break", "eval")
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise self._refused(f"is no expression of Python: {error}") from None
        nodes = list(ast.walk(tree))
        variables = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
        variables |= {node.arg for node in nodes if isinstance(node, ast.arg)}
        self._others = {"np", *dir(builtins), *variables} - ports.keys()
        self.topics = frozenset(self._topics(tree))
        """``stage/port`` of all that it names."""
        if not self.topics:
            raise self._refused("names no message; valid: stage.port.field, for example camera.frame.index > 3")

    def holds(self, messages: Mapping[str, Message]) -> bool:
        """Whether it holds for messages by topic; false while one is still to come. Raises Refused where it fails."""
        if not self.topics <= messages.keys():
            return False
        stages: dict[str, SimpleNamespace] = defaultdict(SimpleNamespace)
        for topic in self.topics:
            stage, port = topic.split("/")
            setattr(stages[stage], port, messages[topic])
        try:
            return bool(eval(self._code, {"np": np, **stages}))
        except Exception as error:
            raise self._refused(_reason(error)) from None

    def _topics(self, node: ast.AST) -> Iterator[str]:
        """The topics below a node; raises Refused for a stage, port or field that does not exist."""
        match node:
            case ast.Attribute(ast.Name(stage), port) if stage not in self._others:
                if stage not in self._ports:
                    raise self._refused(f"no stage {stage!r}{suggest(stage, self._ports)}")
                if port not in self._ports[stage]:
                    raise self._refused(f"{stage} has no output {port!r}{suggest(port, self._ports[stage])}")
                yield f"{stage}/{port}"
                return
            case ast.Attribute(ast.Attribute(ast.Name(stage), port), field) if port in self._ports.get(stage, ()):
                kind = self._ports[stage][port]
                if not hasattr(kind, field):
                    raise self._refused(_no_field(kind, field))
            case ast.Name(stage) if stage not in self._others:
                valid = [f"{stage}.{port}" for port in self._ports.get(stage, ())] or self._ports
                raise self._refused(f"{stage!r} alone is no message{suggest(stage, valid)}")
            case _:
                pass
        for child in ast.iter_child_nodes(node):
            yield from self._topics(child)

    def _refused(self, reason: str) -> Refused:
        return Refused(f"--break {self._text!r}: {reason}")


def _reason(error: Exception) -> str:
    if isinstance(error, AttributeError) and isinstance(error.obj, msgspec.Struct):
        return _no_field(type(error.obj), str(error.name))
    return f"{type(error).__name__}: {error}"


def _no_field(kind: type[msgspec.Struct], field: str) -> str:
    return f"{kind.__name__} has no field {field!r}{suggest(field, kind.__struct_fields__)}"
