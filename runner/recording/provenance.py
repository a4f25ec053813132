"""Where and with what a graph ran: package versions, source revision, machine, and the files its settings name."""

import hashlib
import itertools
import os
import platform
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, distributions, version
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml

from runner.graph.packaged import find, locate, portable_name
from runner.graph.references import modules_of

DISTRIBUTION = "scene-programming"
"""The package that the runner comes in."""
FIRST_NUMERICAL = (
    "llvmlite",
    "mujoco",
    "numba",
    "numpy",
    "opencv-contrib-python-headless",
    "pyrender",
    "scipy",
    "torch",
)
"""The packages that compute, of every recording that was made before graphs named theirs."""
_SETTINGS = (
    "ATEN_CPU_CAPABILITY",
    "GLIBC_TUNABLES",
    "MKL_CBWR",
    "MKL_ENABLE_INSTRUCTIONS",
    "NPY_DISABLE_CPU_FEATURES",
    "NUMBA_CPU_FEATURES",
    "NUMBA_CPU_NAME",
    "ONEDNN_MAX_CPU_ISA",
    "OPENBLAS_CORETYPE",
    "OPENCV_CPU_DISABLE",
)
HASHED_BYTES = 64 * 2**20
"""Larger files and folders are named without a hash."""
HASHED_FILES = 1000


def package_versions() -> dict[str, str]:
    """Every installed package; of two of a name the one that is imported.

    What a package brings along for itself does not count: setuptools adds its own folder of them to the search path
    once it is imported, so the answer would depend on what has been imported so far.
    """
    folders = [folder for folder in sys.path if not (Path(folder).parent / "__init__.py").exists()]
    found: dict[str, str] = {}
    for installed in distributions(path=folders):
        found.setdefault(installed.metadata["Name"], installed.metadata["Version"])
    return dict(sorted(found.items(), key=lambda named: named[0].lower()))


def changes(then: Mapping[str, str], now: Mapping[str, str], names: Iterable[str]) -> Iterator[str]:
    """What of these names, for example of packages with their versions, is not as it was."""
    for name in names:
        if then.get(name) != now.get(name):
            yield f"{name} {then.get(name, 'absent')} -> {now.get(name, 'absent')}"


def numerical(graph: Mapping[str, Any]) -> Sequence[str]:
    """The packages that compute, as a recorded graph names them: another version may round a float differently.

    A graph without a word of them was recorded before graphs could name them.
    """
    return graph.get("numerical", FIRST_NUMERICAL)


def runner_version() -> str:
    """The runner's version, with the revision of its source where that is a checkout."""
    try:
        number = version(DISTRIBUTION)
    except PackageNotFoundError:
        number = "not installed"
    return f"{number} {_revision(Path(__file__).parent)}".rstrip()


def revision(graph: Mapping[str, Any]) -> str:
    """The git commit of the source of a graph's stages, with ``-dirty`` where it was changed since.

    Empty outside a checkout, and several where the stages come from several. What is installed has a version instead.
    """
    packages = dict.fromkeys(module.partition(".")[0] for module in modules_of(graph))
    folders = (_folder_of(package) for package in packages)
    return " ".join(dict.fromkeys(filter(None, (_revision(folder) for folder in folders if folder is not None))))


def _folder_of(package: str) -> Path | None:
    """Where a package or module at the top lies, without importing it."""
    spec = find(package)
    places = [] if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
    return next((Path(place).parent for place in places if place and Path(place).exists()), None)


@cache
def _revision(folder: Path) -> str:
    installed = any(folder.is_relative_to(sysconfig.get_path(name)) for name in ("purelib", "platlib"))
    commit = "" if installed else _git(folder, "rev-parse", "HEAD")
    return f"{commit}-dirty" if commit and _git(folder, "status", "--porcelain", "--untracked-files=no") else commit


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def machine() -> dict[str, str]:
    """What the last bits of a float may depend on: processor, interpreter and linear algebra."""
    blas = cast("dict[str, Any]", np.show_config(mode="dicts"))["Build Dependencies"]["blas"]
    return {
        "processor": _processor("model name") or platform.processor(),
        "vectors": " ".join([*_vector_units(), *_settings()]),
        "system": platform.platform(),
        "libc": " ".join(platform.libc_ver()),
        "python": platform.python_version(),
        "blas": f"{blas.get('name')} {blas.get('version')}",
    }


def fingerprint(machine: Mapping[str, str], packages: Mapping[str, str], numerical: Iterable[str]) -> str:
    """One hash over all that equal bytes need: the processor and its vector units, libm, the interpreter, BLAS and the
    packages that compute. Where it differs from the recording's, floats are equal within tolerances only."""
    parts = [machine.get(key, "") for key in ("processor", "vectors", "libc", "python", "blas")]
    parts += [f"{name} {packages.get(name, 'absent')}" for name in sorted(numerical)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _processor(key: str) -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def _vector_units() -> Iterator[str]:
    return (flag for flag in _processor("flags").split() if flag.startswith(("avx", "fma", "sse4")))


def _settings() -> Iterator[str]:
    """What the environment tells the numerical libraries to take the processor for."""
    return (f"{name}={os.environ[name]}" for name in _SETTINGS if name in os.environ)


def file_hashes(graph: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of everything that a setting of the graph names: files, folders with all that is in them, and YAML files
    with the files they name, for example the catalogue with its meshes."""
    texts = {text for stage in graph["stages"].values() for text in _texts(stage.get("config", {}))}
    parts = {text: _parts(locate(Path(text), Path())) for text in sorted(texts) if text}
    return {text: _hash(files) for text, files in parts.items() if files}


def _parts(path: Path) -> list[Path]:
    """The files that belong to a setting's file or folder; none where it is neither, or all of the machine."""
    if path == Path("/"):
        return []
    if os.path.isdir(path):  # noqa: PTH112 - takes any text, and Path.is_dir() does not
        return sorted(inner for inner in itertools.islice(path.rglob("*"), HASHED_FILES) if inner.is_file())
    if not os.path.isfile(path):  # noqa: PTH113
        return []
    named = {path.parent / text for text in _texts(_yaml(path))} if path.suffix in (".yaml", ".yml") else set[Path]()
    return [path, *sorted(inner for inner in named if inner.is_file())]


def _yaml(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_text())
    except (OSError, ValueError, yaml.YAMLError):
        return None


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)


def _hash(paths: Sequence[Path]) -> str:
    size = sum(path.stat().st_size for path in paths)
    if size > HASHED_BYTES:
        return f"not hashed, {size} bytes"
    try:
        first, *others = [hashlib.sha256(path.read_bytes()) for path in paths]
    except OSError as error:
        return f"not hashed, {error.strerror}"
    if not others:
        return first.hexdigest()
    return hashlib.sha256(b"".join(found.digest() for found in (first, *others))).hexdigest()


def portable(value: Any, folders: Mapping[str, str]) -> Any:
    """A copy of a tree in which paths inside packages are relative, and those below one folder are below another:
    everybody finds their own files.
    """

    def there(text: str) -> str:
        start = next((old for old in folders if text.startswith(f"{old}/")), None)
        below = text if start is None else str(Path(folders[start]) / text[len(start) + 1 :])
        return portable_name(Path(text)) or below

    return with_texts(value, there)


def with_texts(value: Any, change: Callable[[str], str]) -> Any:
    """A copy of a tree with every text in it changed."""
    match value:
        case str():
            return change(value)
        case dict():
            return {key: with_texts(inner, change) for key, inner in value.items()}
        case list():
            return [with_texts(inner, change) for inner in value]
        case _:
            return value
