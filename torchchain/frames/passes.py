"""The two passes over a text file: where its frames are, and their numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from torchchain import checks
from torchchain.frames.registry import Entry, Scan
from torchchain.frames.text import CutShort, Text

Header = TypeVar("Header")
Passed = tuple[int, int | None, float | None]
"""Rows of a frame, its time step number and its time."""


def where(name: str, number: int) -> str:
    """File and frame, as errors begin."""
    return f"{name}, frame {number}"


def scanned(path: Path, passed: Callable[[Text, int], Passed | None]) -> Scan:
    """Where the frames of a file are.

    Args:
        path: the file.
        passed: passes over the next frame, whose number it is given; None at the end of the file.
    """
    entries: list[Entry] = []
    with Text(path) as text:
        while True:
            number, offset = len(entries) + 1, text.position
            try:
                found = passed(text, number)
            except CutShort as cut:
                return Scan(entries, f"{where(path.name, number)}: the file ends after {cut.rows} of its rows")
            if found is None:
                return Scan(entries)
            entries.append(Entry(number, offset, *found))


def frames_at(
    path: Path, entries: Iterable[Entry], header: Callable[[Text, int], Header | None]
) -> Iterator[tuple[Text, str, Entry, Header]]:
    """The file before the rows of each frame, the words that its errors begin with, its entry and its header."""
    with Text(path) as text:
        for entry in entries:
            text.seek(entry.offset)
            here = where(path.name, entry.number)
            found = header(text, entry.number)
            if found is None:
                raise checks.fail(here, "stay as it was when the file was opened", "its end")
            yield text, here, entry, found
