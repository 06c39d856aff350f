"""Finding the frames: files, formats, times, and the contacts of each frame."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from torchchain import checks
from torchchain.frames.doubts import warn
from torchchain.frames.formats import FORMATS
from torchchain.frames.passes import where
from torchchain.frames.record import AXES
from torchchain.frames.registry import Entry, Format
from torchchain.frames.text import Text, readable

HEAD = 1 << 14  # bytes by which a format is known
OPTIONS = ("time_step", "masses", "density", "contact_columns", "periodic")
Source = str | os.PathLike[str]


@dataclass(frozen=True)
class File:
    """A file and its format."""

    path: Path
    format: Format


@dataclass(frozen=True)
class Place:
    """Where a frame is, and where its contacts are if they are in a file of their own."""

    number: int
    file: File
    entry: Entry
    listed: tuple[File, Entry] | None = None


def find(
    path: Any, contacts: Any, format: str | None, options: dict[str, Any]
) -> tuple[tuple[Place, ...], dict[str, Any], str | None]:
    """Where all frames and their contacts are, the options checked, and the file's word for its units."""
    checks.known_keys("options", options, OPTIONS)
    options = _check_options(options)
    if format is not None:
        checks.choice("format", format, [name for name, known in FORMATS.items() if known.holds == "particles"])
    places: list[Place] = []
    cut, units, files = [], None, _files("path", path)
    for file in files:
        found = _known(file, "particles", format)
        scan = found.format.scan(file, options)
        places += [Place(len(places) + 1 + i, found, entry) for i, entry in enumerate(scan.entries)]
        units = units or scan.units
        if scan.cut:
            if file is not files[-1] or not places:
                raise checks.fail(scan.cut.partition(":")[0], "be whole", scan.cut.partition(": ")[2])
            cut.append(scan.cut)
    if not places:
        raise checks.fail(files[0].name, "hold at least one frame", "none")
    _check_times(places, options)
    for words in cut:
        warn(words.partition(":")[0], words.partition(": ")[2] + ": left out")
    if contacts is not None:
        places = _with_contacts(places, _files("contacts", contacts), options)
    return tuple(places), options, units


def _check_options(options: dict[str, Any]) -> dict[str, Any]:
    if options.get("time_step") is not None:
        options["time_step"] = checks.number("time_step", options["time_step"], above=0.0)
    if options.get("density") is not None:
        options["density"] = checks.number("density", options["density"], above=0.0)
        if options.get("masses") is not None:
            raise checks.fail("density", "not be given together with masses", options["density"])
    periodic = options.get("periodic")
    if periodic is not None and (not isinstance(periodic, str) or not set(periodic) <= set(AXES)):
        raise checks.fail("periodic", "be axes such as 'x' or 'xy'", periodic)
    return options


def matching(field: str, word: str) -> list[str]:
    """The file of that name, or those that match the pattern, in the order of the numbers in their names."""
    if os.path.exists(word) or not glob.has_magic(word):
        return [word]
    found = glob.glob(word)
    if not found:
        raise checks.fail(field, "match at least one file", repr(word))
    return sorted(found, key=lambda name: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)])


def _files(field: str, path: Source | Sequence[Source]) -> list[Path]:
    """The files of a path, a pattern, or a list; those of a pattern in the order of the numbers in their names."""
    if isinstance(path, (str, os.PathLike)):
        return [readable(field, Path(name)) for name in matching(field, os.fsdecode(path))]
    if not isinstance(path, Sequence) or not path:
        raise checks.FieldTypeError(f"{field} must be a path, a pattern or a list of paths, got {checks.shown(path)}")
    return [file for part in path for file in _files(field, part)]


def _known(path: Path, holds: str, name: str | None = None) -> File:
    """The file with its format: as named, or as it begins."""
    if name is not None:
        return File(path, FORMATS[name])
    with open(path, "rb") as file:
        head = file.read(HEAD)
    if head[:2] == b"\x1f\x8b":
        head = _head(path)
    for known in FORMATS.values():
        if known.holds == holds and known.recognizes(head):
            return File(path, known)
    other = next((known.name for known in FORMATS.values() if known.recognizes(head)), None)
    names = ", ".join(known.name for known in FORMATS.values() if known.holds == holds)
    raise checks.fail(
        path.name,
        f"be a file of {holds} ({names})",
        f"one of {other}" if other else f"one that begins with {checks.shown(head[:24].decode('latin-1'))}",
    )


def _head(path: Path) -> bytes:
    with Text(path) as text:
        return text.head(HEAD)


def time_of(entry: Entry, options: dict[str, Any]) -> float | None:
    """The time of a frame, None where neither its file nor a time step tells it."""
    if entry.time is not None:
        return entry.time
    step = options.get("time_step")
    return None if step is None or entry.step is None else entry.step * step


def _check_times(places: list[Place], options: dict[str, Any]) -> None:
    """An error for frames out of order."""
    for before, place in pairwise(places):
        for field in ("step", "time"):
            a, b = getattr(before.entry, field), getattr(place.entry, field)
            at = f"{where(place.file.path.name, place.entry.number)}: {field}"
            if (a is None) != (b is None):
                raise checks.fail(at, "be given in all frames or in none", b)
            if a is not None and b <= a:
                raise checks.fail(at, "be later than in the frame before", f"{b:.10g} after {a:.10g}")
    if options.get("time_step") is not None and places[0].entry.time is not None:
        raise checks.fail(
            "time_step", f"be left out, as {places[0].file.path.name} states its times", options["time_step"]
        )


def _with_contacts(places: list[Place], files: list[Path], options: dict[str, Any]) -> list[Place]:
    """The places of the frames, each with that of its contacts if there are any."""
    by: dict[Any, tuple[File, Entry]] = {}
    kind = "step"
    for path in files:
        file = _known(path, "contacts")
        kind = file.format.match
        scan = file.format.scan(path, options)
        if scan.cut:
            warn(scan.cut.partition(":")[0], scan.cut.partition(": ")[2] + ": left out")
        for entry in scan.entries:
            key = getattr(entry, kind)
            if key in by:
                raise checks.fail(f"{where(path.name, entry.number)}: {kind}", "be another than before", key)
            by[key] = (file, entry)
    if getattr(places[0].entry, kind) is None:
        raise checks.fail(
            f"{places[0].file.path.name}: {kind}", f"be in the file to find the contacts in {files[0].name}", "none"
        )
    found = [by.get(getattr(place.entry, kind)) for place in places]
    if not any(found):
        raise checks.fail(
            f"{files[0].name}: {kind}", f"be that of a frame of {places[0].file.path.name}", checks.shown(list(by)[:3])
        )
    return [replace(place, listed=one) for place, one in zip(places, found, strict=True)]
