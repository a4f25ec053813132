"""The documents name only what exists."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]
TOP_LEVEL = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")} - {"build"}


def named_paths(text: str) -> set[str]:
    """Every path in backticks or in a link that begins with something at the top level."""
    candidates = re.findall(r"`([\w./*-]+)`", text) + re.findall(r"\]\(([\w./-]+)\)", text)
    return {path for path in candidates if "/" in path and path.split("/")[0] in TOP_LEVEL}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_path_exists(document: Path):
    missing = [path for path in sorted(named_paths(document.read_text())) if not any(ROOT.glob(path.rstrip("/")))]
    assert missing == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_picture_exists(document: Path):
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", document.read_text()):
        assert (document.parent / picture).is_file(), picture


def test_architecture_names_every_stage():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    stages = {path.stem for path in (ROOT / "stages").glob("*.py")} - {"__init__", "views"}
    assert {stage for stage in stages if stage not in text} == set()
