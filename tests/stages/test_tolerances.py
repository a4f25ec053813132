import inspect
from types import ModuleType

import msgspec
import pytest

from stages.messages import arrays, digest, robot, scene, sensing, task
from stages.messages.tolerances import TOLERANCES


def declared(module: ModuleType) -> dict[str, set[str]]:
    structs = dict(inspect.getmembers(module, inspect.isclass)).values()
    return {kind.__name__: set(kind.__struct_fields__) for kind in structs if issubclass(kind, msgspec.Struct)}


FIELDS = {
    name: fields
    for module in (arrays, digest, robot, scene, sensing, task)
    for name, fields in declared(module).items()
}


@pytest.mark.parametrize("key", TOLERANCES)
def test_every_field_exists(key: str):
    kind, _, field = key.partition(".")
    assert field in FIELDS[kind]
