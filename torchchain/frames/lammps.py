"""LAMMPS and LIGGGHTS text dumps of particles: ``dump ... custom`` and ``dump ... atom``, plain or gzip."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.passes import Passed, frames_at, scanned, where
from torchchain.frames.record import AXES, Box
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import CutShort, Text, as_number, parse

SAME = {"id": "id", "type": "type", "mass": "mass", "radius": "radius", "vx": "vx", "vy": "vy", "vz": "vz"}
INTEGERS = {"id", "type", "ix", "iy", "iz"}


@dataclass(frozen=True)
class Header:
    """The lines before the rows of a frame."""

    step: int
    time: float | None
    units: str | None
    count: int
    box: Box | None
    columns: tuple[str, ...]


def lists_contacts(head: bytes) -> bool:
    """Whether a file begins like a dump of pairs: of entries, or of what ``dump_modify label`` calls them."""
    return head.lstrip().startswith(b"ITEM: ") and re.search(rb"ITEM: NUMBER OF (?!ATOMS)", head) is not None


def read_header(text: Text, number: int, label: str) -> Header | None:
    """The header of the next frame, None at the end of the file.

    Args:
        text: at the beginning of a frame.
        number: of the frame, for errors.
        label: "ATOMS" for particles; otherwise any other label will do.
    """
    here = where(text.name, number)
    step = time = units = count = None
    box = None
    while True:
        line = text.line()
        if line is None:
            if step is not None or count is not None or time is not None:
                raise CutShort
            return None
        if not line and step is None and count is None and time is None:
            continue  # blank lines between frames
        if not line.startswith("ITEM: "):
            if number > 1 and step is None and time is None and units is None:
                raise checks.fail(
                    f"{where(text.name, number - 1)}: NUMBER OF {label}",
                    "be the number of its rows",
                    f"more rows, next {checks.shown(line, 40)}",
                )
            raise checks.fail(here, "begin with lines 'ITEM: ...' (a LAMMPS text dump)", checks.shown(line, 40))
        item = line[6:]
        if item.startswith("TIMESTEP"):
            step = int(as_number(f"{here}: TIMESTEP", _next(text), whole=True))
        elif item == "TIME":
            time = float(as_number(f"{here}: TIME", _next(text)))
        elif item == "UNITS":
            units = _next(text)
        elif item == "LABEL":
            _next(text)
        elif item.startswith("NUMBER OF "):
            count = int(as_number(f"{here}: {item}", _next(text), whole=True))
            if count < 0:
                raise checks.fail(f"{here}: {item}", "not be negative", count)
        elif item.startswith("BOX BOUNDS"):
            box = _box(here, item[10:].split(), [_next(text) for _ in range(3)])
        else:
            break
    word, *columns = item.split()
    if (word == "ATOMS") != (label == "ATOMS"):
        raise checks.fail(
            here,
            "hold particles (ITEM: ATOMS)" if label == "ATOMS" else "hold contacts (ITEM: ENTRIES)",
            checks.shown(line, 60),
        )
    if step is None:
        raise checks.fail(f"{here}: TIMESTEP", "be given", "none")
    if count is None:
        raise checks.fail(f"{here}: NUMBER OF {word}", "be given", "none")
    if not columns:
        raise checks.fail(f"{here}: {word}", "name its columns", "none (a dump from before 2010?)")
    if len(set(columns)) < len(columns):
        raise checks.fail(f"{here}: {word}", "name each column once", next(c for c in columns if columns.count(c) > 1))
    if not text.room_for(count, len(columns)):
        raise checks.fail(f"{here}: NUMBER OF {word}", "fit into the file", count)
    return Header(step, time, units, count, box, tuple(columns))


def _next(text: Text) -> str:
    line = text.line()
    if line is None:
        raise CutShort
    return line


def _box(here: str, words: list[str], lines: list[str]) -> Box:
    sides = [line.split() for line in lines]
    if any(word in ("xy", "abc") for word in words) or any(len(side) > 2 for side in sides):
        raise checks.fail(
            f"{here}: BOX BOUNDS",
            "be those of a box with sides along x, y, z (no tilt)",
            checks.shown(" ".join(words) or lines[0], 40),
        )
    if any(len(side) != 2 for side in sides):
        raise checks.fail(
            f"{here}: BOX BOUNDS",
            "be two numbers a line",
            checks.shown(next(s for s in lines if len(s.split()) != 2), 40),
        )
    bounds = [[as_number(f"{here}: BOX BOUNDS", word) for word in side] for side in sides]
    for axis, (low, high) in zip(AXES, bounds, strict=True):
        if not low <= high:
            raise checks.fail(f"{here}: BOX BOUNDS", f"have {axis} bounds in order", f"{low:g} {high:g}")
    flags = words if len(words) == 3 else ["?"] * 3
    lower, upper = zip(*bounds, strict=True)
    return Box(lower, upper, tuple(flag.startswith("p") for flag in flags))


def scan_dump(path: Path, label: str) -> Scan:
    """All headers of a file, and whether each has as many rows as it announces."""
    units: str | None = None
    columns: tuple[str, ...] | None = None

    def passed(text: Text, number: int) -> Passed | None:
        nonlocal units, columns
        header = read_header(text, number, label)
        if header is None:
            return None
        units = units or header.units
        if columns is not None and header.columns != columns:
            raise checks.fail(
                f"{where(path.name, number)}: columns",
                f"stay {checks.shown(' '.join(columns), 50)}",
                checks.shown(" ".join(header.columns), 50),
            )
        columns = header.columns
        held = text.skip(header.count, b"ITEM:")
        if held < header.count:
            raise checks.fail(f"{where(path.name, number)}: rows", f"be {header.count} as announced", held)
        return header.count, header.step, header.time

    return replace(scanned(path, passed), units=units)


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    return scan_dump(path, "ATOMS")


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    for text, here, _, header in frames_at(path, entries, partial(read_header, label="ATOMS")):
        wanted = {
            name
            for name in header.columns
            if name in SAME
            or name in INTEGERS
            or name == "diameter"
            or name.removesuffix("u").removesuffix("s") in AXES
        }
        rows = parse(here, text.blocks(header.count), header.columns, INTEGERS, wanted)
        yield _convert(here, rows, header.box)


def _convert(here: str, rows: dict[str, np.ndarray], box: Box | None) -> Raw:
    """Columns under their common names, coordinates in units of length; unwrapped if the dump says how."""
    found = {SAME[name]: values for name, values in rows.items() if name in SAME}
    if "diameter" in rows and "radius" not in rows:
        found["radius"] = rows["diameter"] / 2
    unwrapped = set()
    for i, axis in enumerate(AXES):
        scaled = f"{axis}u" not in rows and axis not in rows
        names = [name for name in ((f"{axis}su", f"{axis}s") if scaled else (f"{axis}u", axis)) if name in rows]
        if not names:
            continue
        values = rows[names[0]]
        if scaled or f"i{axis}" in rows:
            if box is None:
                raise checks.fail(f"{here}: BOX BOUNDS", f"be given for {names[0]}", "none")
            low, length = box.lower[i], box.upper[i] - box.lower[i]
            if scaled:
                values = low + length * values
            if not names[0].endswith("u") and f"i{axis}" in rows:
                values = values + length * rows[f"i{axis}"]
        found[axis] = values
        if names[0].endswith("u") or f"i{axis}" in rows:
            unwrapped.add(axis)
    return Raw(found, box, frozenset(unwrapped))


FORMAT = Format(
    name="lammps",
    holds="particles",
    summary="LAMMPS or LIGGGHTS text dump (dump custom or atom): x, xu, xs or xsu, image flags, any order of columns and rows",
    endings=(".dump", ".lammpstrj", ".lammpsdump", ".liggghts"),
    recognizes=lambda head: head.lstrip().startswith(b"ITEM: ") and not lists_contacts(head),
    scan=_scan,
    read=_read,
)
