"""LAMMPS contact lists: ``dump ... local`` of ``compute property/local`` and ``compute pair/local``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.lammps import lists_contacts, read_header, scan_dump
from torchchain.frames.passes import frames_at
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import parse

FIELDS = ("id1", "id2", "overlap", "distance", "normal_force")
PAIRS = (("id1", "id2"), ("patom1", "patom2"), ("natom1", "natom2"), ("batom1", "batom2"))


def scan(path: Path, options: dict[str, Any]) -> Scan:
    """The contact lists of a file; shared with LIGGGHTS, whose files are of the same form."""
    return scan_dump(path, "ENTRIES")


def read_columns(path: Path, entries: Iterable[Entry]) -> Iterator[tuple[str, Sequence[str], dict[str, np.ndarray]]]:
    """File and frame, the names of all columns in order, and their numbers."""
    for text, here, _, header in frames_at(path, entries, partial(read_header, label="ENTRIES")):
        columns = header.columns
        yield here, columns, parse(here, text.blocks(header.count), columns, set(), set(columns))


def whole(here: str, name: str, values: np.ndarray) -> np.ndarray:
    """The values as integers, which ids must be."""
    bad = (values != np.rint(values)) | (np.abs(values) > 2**53)
    if bad.any():
        raise checks.fail(
            f"{here}: {name}",
            "be whole numbers, ids of particles",
            f"{values[bad][0]:g} in row {int(bad.argmax()) + 1}",
        )
    return values.astype(np.int64)


def _compute(name: str) -> str:
    """The part of a column's name that says which compute it is from."""
    return name.partition("[")[0]


def can_be_ids(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two columns can be the ids of pairs: whole numbers from 1 on, different in each row."""
    whole_numbers = all((values == np.rint(values)).all() and (values >= 1).all() for values in (first, second))
    return bool(whole_numbers and len(first) and (first != second).all())


def read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    """The contacts of each entry."""
    given = options.get("contact_columns")
    for here, names, rows in read_columns(path, entries):
        chosen = _chosen(here, names, rows, given)
        found = {field: rows[name] for field, name in chosen.items()}
        yield Raw(
            {field: whole(here, chosen[field], v) if field in ("id1", "id2") else v for field, v in found.items()}
        )


def _chosen(here: str, names: Sequence[str], rows: dict[str, np.ndarray], given: Any) -> dict[str, str]:
    """Which column is which field: as given, by name, or the only two neighbors that can be ids."""
    if given is None:
        for first, second in PAIRS:
            if first in names and second in names:
                return {"id1": first, "id2": second} | {field: field for field in FIELDS[2:] if field in names}
        if not len(rows[names[0]]):
            return {"id1": names[0], "id2": names[0]}
        pairs = [(a, b) for a, b in pairwise(names) if _compute(a) == _compute(b) and can_be_ids(rows[a], rows[b])]
        if len(pairs) == 1:
            return {"id1": pairs[0][0], "id2": pairs[0][1]}
        raise checks.fail(
            f"{here}: columns",
            "be named by contact_columns={'id1': ..., 'id2': ...}, as the file does not say which are ids",
            checks.shown(" ".join(names), 60),
        )
    if not isinstance(given, dict):
        raise checks.fail(
            "contact_columns", "be a dict such as {'id1': 'c_1[1]', 'id2': 'c_1[2]'} for lammps_local", given
        )
    checks.known_keys("contact_columns", given, FIELDS)
    for field in FIELDS[:2]:
        if field not in given:
            raise checks.fail("contact_columns", f"have the key {field}", given)
    for name in given.values():
        if name not in names:
            raise checks.fail(f"{here}: columns", f"hold {name}", checks.shown(" ".join(names), 60))
    return dict(given)


FORMAT = Format(
    name="lammps_local",
    holds="contacts",
    summary="LAMMPS dump local with the ids of each pair (compute property/local patom1 patom2) and what else there is",
    endings=(),
    recognizes=lists_contacts,
    scan=scan,
    read=read,
    options={"contact_columns": "dict from id1, id2, overlap, distance, normal_force to names of columns"},
)
