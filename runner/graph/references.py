"""Finds what a graph names as ``module:NAME``: classes and tables."""

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import metadata, packages_distributions
from pathlib import Path
from typing import Any, TypeVar

from runner.contract import Migration, Migrations, Refused, Tolerance, Tolerances
from runner.graph.document import suggest
from runner.graph.packaged import find

T = TypeVar("T")


def load_class(reference: str, place: str, wanted: type[Any] | None = None) -> Any:
    """The object named ``module:Class``; raises Refused with the valid names beside the wrong one.

    Refuses a class, too, that has not all methods of the protocol ``wanted``.
    """
    module_name, _, class_name = reference.partition(":")
    members = vars(_module(module_name, place))
    if class_name not in members:
        classes = [name for name, one in members.items() if isinstance(one, type) and one.__module__ == module_name]
        raise Refused(f"{place}: no class {class_name!r} in {module_name}{suggest(class_name, classes)}")
    found = members[class_name]
    methods = [
        name for name, one in (vars(wanted) if wanted else {}).items() if inspect.isfunction(one) and name[:1] != "_"
    ]
    if missing := [name for name in methods if not callable(getattr(found, name, None))]:
        raise Refused(f"{place}: {reference} has no {', '.join(missing)}; valid: a class with {', '.join(methods)}")
    return found


def modules_of(graph: Mapping[str, Any]) -> list[str]:
    """The modules of the stages of a graph that may not have been checked, each once."""
    stages = graph.get("stages")
    entries = stages.values() if isinstance(stages, dict) else ()
    references = (entry.get("stage") for entry in entries if isinstance(entry, dict))
    return list(dict.fromkeys(str(reference).partition(":")[0] for reference in references))


def load_tolerances(reference: str | None, place: str) -> Tolerances:
    """The table ``module:NAME`` of tolerances, empty for None; raises Refused where it is none."""
    return _table(reference, place, Tolerance, key=lambda key: isinstance(key, str), keys="Type.field")


def load_migrations(reference: str | None, place: str) -> Migrations:
    """The table ``module:NAME`` of migrations, empty for None; raises Refused where it is none."""
    return _table(reference, place, Migration, key=_is_version, keys="(type, version)")


def _table(
    reference: str | None, place: str, kind: type[T], *, key: Callable[[Any], bool], keys: str
) -> Mapping[Any, T]:
    if reference is None:
        return {}
    module_name, _, name = reference.partition(":")
    members = vars(_module(module_name, place))
    table = members.get(name)
    if not isinstance(table, Mapping):
        tables = [other for other, value in members.items() if isinstance(value, Mapping) and other[:1] != "_"]
        raise Refused(f"{place}: no table {name!r} in {module_name}{suggest(name, tables)}")
    for found, value in table.items():
        if not key(found):
            raise Refused(f"{place}: {found!r} is no key of such a table; valid: {keys}")
        if not isinstance(value, kind):
            raise Refused(f"{place}: {found} is {value!r}; valid: a runner.contract.{kind.__name__}")
    return table


def _is_version(key: Any) -> bool:
    return isinstance(key, tuple) and [type(part) for part in key] == [str, int]


def _module(name: str, place: str) -> Any:
    if name[:1] in ("", "."):  # relative, to nothing
        raise Refused(f"{place}: no module {name!r}")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not (name == error.name or name.startswith(f"{error.name}.")):
            raise Refused(f"{place}: {name} cannot be imported: {error}{_extra(name)}") from None
        raise Refused(f"{place}: no module {name!r}{_elsewhere(name)}") from None
    except ImportError as error:
        raise Refused(f"{place}: {name} cannot be imported: {error}") from None
    except SystemExit as end:  # a script without a guard
        raise Refused(f"{place}: {name} cannot be imported: it calls sys.exit({end.code!r})") from None


@cache
def _extra(module_name: str) -> str:
    """What to type where a package may be there without its extra of the same name."""
    package = module_name.partition(".")[0]
    owners = packages_distributions().get(package, ())
    found = [owner for owner in owners if package in (metadata(owner).get_all("Provides-Extra") or ())]
    return f"; type: pip install '{found[0]}[{package}]'" if found else ""


def _elsewhere(module_name: str) -> str:
    """What the missing module may be instead or, where even its package is missing, what to do."""
    top = module_name.partition(".")[0]
    there = "run this in the folder that has it, or install it"
    if (spec := find(top)) is None:
        return f": {top} is neither in {Path.cwd()} nor installed; {there}"
    beside = suggest(module_name, _modules_beside(module_name))
    folder = next(iter(spec.submodule_search_locations or ()), "") if spec.origin is None else ""
    return f"{beside}; if {folder} is not the package {top} that is meant, {there}" if folder else beside


def _modules_beside(module_name: str) -> list[str]:
    """Names of the modules in the package that the missing one would be in."""
    package = module_name.rpartition(".")[0]
    try:
        paths = importlib.import_module(package).__path__ if package else []
    except (ImportError, AttributeError):
        return []
    return [f"{package}.{module.name}" for module in pkgutil.iter_modules(paths)]
