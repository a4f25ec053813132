"""What could not be sent, read or described is refused by field, before anything starts."""

import re
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, TypedDict

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from runner.contract import Message, Refused, Spec, Struct
from runner.message.classes import refuse_class
from tests.runner.message.test_codec import Nest, Sample

Floats = NDArray[np.float32]


class Words(NamedTuple):
    words: frozenset[str]


class Choice(TypedDict):
    one: str | bytes


@dataclass(frozen=True)
class Wave:
    phase: complex
    next: "Wave | None" = None


class Inner(Struct, frozen=True, kw_only=True):
    values: tuple[Floats, ...]


@pytest.mark.parametrize("kind", [Sample, Nest])
def test_arrays_may_be_anywhere(kind: type[Message]):
    refuse_class(kind)


@pytest.mark.parametrize(
    ("annotation", "said"),
    [
        (complex, "M.it: type <class 'complex'> is not supported; valid: numbers, texts, tuples, arrays, Structs"),
        (tuple[Wave, ...], "M.it.phase: type <class 'complex'> is not supported; valid: numbers,"),
        (str | bytes, "M.it: Type unions may not contain more than one str-like type"),
        (Choice, "M.it.one: Type unions may not contain more than one str-like type"),
        (int | Annotated[Floats, Spec("float32", ())], "M.it: Type unions containing a custom type may not"),
        (dict[str, Any], "M.it: Any does not say what is sent; valid: numbers, texts, tuples, arrays, Structs"),
        (Words, "M.it.words: a set has no order; valid: tuple"),
        (Floats, "M.it: an array needs its Spec; valid: Annotated[NDArray[...], Spec(dtype, shape)]"),
        (Inner | None, "M.it.values: an array needs its Spec"),
        (Annotated[Floats, Spec("float128", ("N",))], "M.it: element type 'float128' is not one of bool, int8,"),
        (Annotated[Floats, Spec("float32", (-1,))], "M.it: shape (-1,) is not a tuple of at most 8 numbers and names"),
        (Annotated[Floats, Spec("float32", ("N",) * 9)], "M.it: shape ('N', 'N',"),
        (Annotated[Floats | None, Spec("float32", ())], "M.it: a Spec says what an array is, and this is"),
    ],
)
def test_what_cannot_travel_is_refused_by_field(annotation: Any, said: str):
    kind: Any = msgspec.defstruct("M", [("it", annotation)], bases=(Message,), frozen=True, kw_only=True)
    with pytest.raises(Refused, match=f"^{re.escape(said)}"):
        refuse_class(kind)


class Drawn(Message, frozen=True, kw_only=True):
    pixels: Annotated[Floats, Spec("float32", ())] = np.zeros((), np.float32)


def test_a_default_that_cannot_be_described_is_refused():
    with pytest.raises(Refused, match=r"^Drawn: Encoding objects of type numpy\.ndarray is unsupported$"):
        refuse_class(Drawn)
