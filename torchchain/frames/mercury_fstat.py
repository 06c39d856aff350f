"""MercuryDPM: ``.fstat`` files of contacts, in the layout of its DPMBase (writeFstatHeader) and BaseInteraction (writeToFStat)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.passes import Passed, frames_at, scanned, where
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import CutShort, Text, as_number, parse

# Three lines that begin with '#' (time and a marker; domain; radii), then one row a contact and side.
COLUMNS = (
    "time", "id1", "id2", "x", "y", "z", "overlap", "sliding", "normal_force", "tangential_force",
    "nx", "ny", "nz", "tx", "ty", "tz",
)  # fmt: skip

_LARGE = 1 << 31  # no more particles than this, so that a pair is one number


def _header(text: Text, number: int) -> float | None:
    lines: list[list[str]] = []
    for _ in range(3):
        line = text.line()
        if line is None:
            if lines:
                raise CutShort
            return None
        if not line.startswith("#"):
            raise checks.fail(
                f"{where(text.name, number)}: header", "be three lines that begin with '#'", checks.shown(line, 40)
            )
        lines.append(line[1:].split())
    return as_number(f"{where(text.name, number)}: time", lines[0][0] if lines[0] else "")


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    def passed(text: Text, number: int) -> Passed | None:
        time = _header(text, number)
        return None if time is None else (text.count_until(b"#"), None, time)

    return scanned(path, passed)


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    for text, here, entry, _ in frames_at(path, entries, _header):
        rows = parse(here, text.blocks(entry.count), COLUMNS, {"id1", "id2"}, {"id1", "id2", "overlap", "normal_force"})
        for name in ("id1", "id2"):
            bad = np.abs(rows[name]) >= _LARGE
            if bad.any():
                raise checks.fail(f"{here}: {name}", f"be below {_LARGE}", int(rows[name][bad][0]))
        yield Raw(_once(rows))


def _once(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Each contact once: a pair has a row for either side, a contact with a wall or a fixed particle only one."""
    first, second = rows["id1"], rows["id2"]
    paired = np.isin(second * _LARGE + first, first * _LARGE + second)
    keep = (second < 0) | (first <= second) | ~paired
    return {name: values[keep] for name, values in rows.items()} | {"id2": np.where(second < 0, -1, second)[keep]}


FORMAT = Format(
    name="mercury_fstat",
    holds="contacts",
    summary="MercuryDPM .fstat: overlap and normal force of each contact; particles by their place in .data",
    endings=(".fstat",),
    recognizes=lambda head: head.startswith(b"#") and head.count(b"\n#") >= 2,
    scan=_scan,
    read=_read,
    match="time",
)
