"""What a file format is to the rest: one record with how it is known, scanned and read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchchain.frames.record import Box


@dataclass(frozen=True)
class Entry:
    """Where a frame is in its file.

    Example:
        >>> tc.frames.Entry(number=1, offset=0, count=12, step=100).time is None
        True
    """

    number: int
    """counted from 1"""
    offset: int
    """byte of the uncompressed text, or row of a table"""
    count: int
    """particles, or contacts"""
    step: int | None = None
    time: float | None = None


@dataclass(frozen=True, eq=False)
class Raw:
    """The numbers of one frame as its file has them, in the order of its rows.

    ``columns`` has the names id, type, mass, radius, x, y, z, vx, vy, vz; of contacts id1, id2, overlap, normal_force.
    ``contacts`` has those that stand beside the particles: pairs of their places, overlap, normal_force.

    Example:
        >>> import numpy as np
        >>> sorted(tc.frames.Raw({"id": np.arange(1, 4), "x": np.zeros(3)}).columns)
        ['id', 'x']
    """

    columns: dict[str, np.ndarray]
    box: Box | None = None
    unwrapped: frozenset[str] = frozenset()
    contacts: dict[str, np.ndarray] | None = None


@dataclass(frozen=True)
class Scan:
    """What one pass over a file finds.

    Attributes:
        entries: of all whole frames.
        cut: words on a last frame that is not whole, or None.
        units: the file's own word for its units, or None.

    Example:
        >>> len(tc.frames.Scan([tc.frames.Entry(number=1, offset=0, count=12)]).entries)
        1
    """

    entries: list[Entry]
    cut: str | None = None
    units: str | None = None


@dataclass(frozen=True)
class Format:
    """One file format.

    Attributes:
        name: for ``format=``.
        holds: "particles" or "contacts".
        summary: one line for people.
        endings: of file names, lower case, without .gz.
        recognizes: from the first bytes of the text.
        scan: (path, options) to Scan.
        read: (path, entries, options) to one Raw each, in their order; the file is open only meanwhile.
        options: name to what it means, those of :func:`torchchain.read_frames` that the format looks at.
        match: contacts belong to the frame with the same "step" or "time".
        sibling: (path) to a mass for each id, from a file beside it, or None.

    Example:
        >>> tc.frames.FORMATS["lammps"].holds
        'particles'
    """

    name: str
    holds: str
    summary: str
    endings: tuple[str, ...]
    recognizes: Callable[[bytes], bool]
    scan: Callable[[Path, dict[str, Any]], Scan]
    read: Callable[[Path, Iterable[Entry], dict[str, Any]], Iterator[Raw]]
    options: dict[str, str] = field(default_factory=dict)
    match: str = "step"
    sibling: Callable[[Path], Path | None] = lambda path: None
