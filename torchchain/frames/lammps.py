"""LAMMPS and LIGGGHTS text dumps of particles: ``dump ... custom`` and ``dump ... atom``, plain or gzip."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.record import AXES, Box
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import CutShort, Text, gone, parse

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


def where(name: str, number: int) -> str:
    """File and frame, as errors begin."""
    return f"{name}, frame {number}"


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
            step = int(_number(here, "TIMESTEP", _next(text), whole=True))
        elif item == "TIME":
            time = float(_number(here, "TIME", _next(text)))
        elif item == "UNITS":
            units = _next(text)
        elif item == "LABEL":
            _next(text)
        elif item.startswith("NUMBER OF "):
            count = int(_number(here, item, _next(text), whole=True))
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


def _number(here: str, field: str, word: str, whole: bool = False) -> float:
    try:
        if "_" in word:
            raise ValueError
        value = int(word) if whole else float(word)
        good = abs(value) < 2**63 and np.isfinite(float(value))
    except ValueError:
        good = False
    if not good:
        raise checks.fail(f"{here}: {field}", f"be a {'whole' if whole else 'finite'} number", checks.shown(word, 40))
    return value


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
    bounds = [[_number(here, "BOX BOUNDS", word) for word in side] for side in sides]
    for axis, (low, high) in zip(AXES, bounds, strict=True):
        if not low <= high:
            raise checks.fail(f"{here}: BOX BOUNDS", f"have {axis} bounds in order", f"{low:g} {high:g}")
    flags = words if len(words) == 3 else ["?"] * 3
    (xl, xh), (yl, yh), (zl, zh) = bounds
    px, py, pz = (flag.startswith("p") for flag in flags)
    return Box((xl, yl, zl), (xh, yh, zh), (px, py, pz))


def scan_dump(path: Path, label: str) -> Scan:
    """All frames of a dump, from one pass that looks at their headers only."""
    entries: list[Entry] = []
    units, columns = None, None
    with Text(path) as text:
        while True:
            number, offset = len(entries) + 1, text.position
            try:
                header = read_header(text, number, label)
                if header is None:
                    return Scan(entries, None, units)
                units = units or header.units
                if columns is not None and header.columns != columns:
                    raise checks.fail(
                        f"{where(path.name, number)}: columns",
                        f"stay {checks.shown(' '.join(columns), 50)}",
                        checks.shown(" ".join(header.columns), 50),
                    )
                columns = header.columns
                held = text.skip(header.count, b"ITEM:")
            except CutShort as cut:
                return Scan(entries, f"{where(path.name, number)}: the file ends after {cut.rows} of its rows", units)
            if held < header.count:
                raise checks.fail(f"{where(path.name, number)}: rows", f"be {header.count} as announced", held)
            entries.append(Entry(number, offset, header.count, header.step, header.time))


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    return scan_dump(path, "ATOMS")


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    with Text(path) as text:
        for entry in entries:
            text.seek(entry.offset)
            here = where(path.name, entry.number)
            header = read_header(text, entry.number, "ATOMS")
            if header is None:
                raise gone(here)
            columns = header.columns
            wanted = {
                name
                for name in columns
                if name in SAME
                or name in INTEGERS
                or name == "diameter"
                or name.removesuffix("u").removesuffix("s") in AXES
            }
            rows = parse(here, text.blocks(header.count), columns, INTEGERS, wanted)
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
