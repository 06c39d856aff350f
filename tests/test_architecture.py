"""docs/architecture.md tells the truth: every name in it is there, and every room is in it."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`(torchchain(?:\.\w+)+)`", TEXT)))


def resolved(name):
    """What a dotted name stands for."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part)
        return found
    raise AssertionError(name)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_there(name):
    assert resolved(name) is not None


def test_every_equation_has_its_place():
    numbers = set()
    for first, last in re.findall(
        r"(?<![\w.])(\d+)(?:-(\d+))?(?=[, |])", "".join(re.findall(r"^\| Eqs?\.[^|]*\|", TEXT, re.M))
    ):
        numbers |= set(range(int(first), int(last or first) + 1))
    assert set(range(1, 52)) <= numbers


def test_every_room_and_file_named_is_there():
    rooms = {path.name for path in (ROOT / "torchchain").iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    assert rooms == set(re.findall(r"^\| `(\w+)/`", TEXT, re.M))
    files = {path.stem for path in (ROOT / "torchchain").glob("[!_]*.py")}
    assert files == set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| `\w+`.*?\|", TEXT, re.M))))
    for file in re.findall(r"`(\w+/\w+\.py)`", TEXT):
        assert (ROOT / "torchchain" / file).is_file() or (ROOT / file).is_file(), file
