"""Contact lists of LAMMPS and LIGGGHTS, ``dump ... local``.

LAMMPS writes those of ``compute property/local`` and ``compute pair/local``, LIGGGHTS those of ``compute pair/gran/local``, as
its ComputePairGranLocal (add_pair) has them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
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
# The order in which LIGGGHTS' compute writes, whatever the order of its keywords, and the values of each.
WIDTHS = {
    "pos": 6, "vel": 6, "id": 3, "force": 3, "force_normal": 3, "force_tangential": 3, "torque": 3, "torque_normal": 3,
    "torque_tangential": 3, "history": None, "contactArea": 1, "delta": 1, "contactPoint": 3, "ms_id": 2, "heatFlux": 1,
}  # fmt: skip
Rows = dict[str, np.ndarray]
"""All columns of a list in their order, or the fields that they are."""


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    return scan_dump(path, "ENTRIES")


def _read(
    choose: Callable[[str, Rows, Any], Rows], path: Path, entries: Iterable[Entry], options: dict[str, Any]
) -> Iterator[Raw]:
    """The contacts of each entry, whose fields are chosen from the columns as ``contact_columns`` says."""
    for text, here, _, header in frames_at(path, entries, partial(read_header, label="ENTRIES")):
        rows = parse(here, text.blocks(header.count), header.columns, set(), set(header.columns))
        found = choose(here, rows, options.get("contact_columns"))
        for field in ("id1", "id2"):
            values = found[field]
            bad = (values != np.rint(values)) | (np.abs(values) > 2**53)
            if bad.any():
                raise checks.fail(
                    f"{here}: {field}",
                    "be whole numbers, ids of particles",
                    f"{values[bad][0]:g} in row {int(bad.argmax()) + 1}",
                )
            found[field] = values.astype(np.int64)
        yield Raw(found)


def _can_be_ids(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two columns can be the ids of pairs: whole numbers from 1 on, different in each row."""
    whole_numbers = all((values == np.rint(values)).all() and (values >= 1).all() for values in (first, second))
    return bool(whole_numbers and len(first) and (first != second).all())


def _unnamed(here: str, rows: Rows, how: str) -> checks.FieldError:
    words = checks.shown(" ".join(rows), 60)
    return checks.fail(
        f"{here}: columns", f"be named by contact_columns={how}, as they do not show which are ids", words
    )


def _by_names(here: str, rows: Rows, given: Any) -> Rows:
    """As given, by name, or the only two neighbors that can be ids."""
    names = list(rows)
    if given is None:
        for first, second in PAIRS:
            if first in names and second in names:
                return {"id1": rows[first], "id2": rows[second]} | {f: rows[f] for f in FIELDS[2:] if f in names}
        if not len(rows[names[0]]):
            return {"id1": rows[names[0]], "id2": rows[names[0]]}
        # Of one compute, which a column's name begins with.
        beside = [(a, b) for a, b in pairwise(names) if a.partition("[")[0] == b.partition("[")[0]]
        pairs = [(rows[a], rows[b]) for a, b in beside if _can_be_ids(rows[a], rows[b])]
        if len(pairs) == 1:
            return {"id1": pairs[0][0], "id2": pairs[0][1]}
        raise _unnamed(here, rows, "{'id1': ..., 'id2': ...}")
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
    return {field: rows[name] for field, name in given.items()}


def _by_keywords(here: str, rows: Rows, given: Any) -> Rows:
    """As the keywords of LIGGGHTS' compute say, or the only two columns that can be ids before a flag that is 0 or 1."""
    if isinstance(given, dict):  # columns by their names, as in any list
        return _by_names(here, rows, given)
    values = list(rows.values())
    if given is None:
        good = [
            i for i, flag in enumerate(values[2:]) if _can_be_ids(*values[i : i + 2]) and np.isin(flag, (0, 1)).all()
        ]
        if len(good) != 1 and len(values[0]):
            raise _unnamed(here, rows, "'pos id force' (the compute's keywords)")
        return dict(zip(("id1", "id2"), values[good[0] if len(values[0]) else 0 :], strict=False))
    places = _places(here, given, len(values))
    found = dict(zip(("id1", "id2"), values[places["id"] :], strict=False))
    if "delta" in places:
        found["overlap"] = values[places["delta"]]
    for keyword in ("force_normal", "force"):
        if keyword in places:
            # The normal component's size; the whole force's where the contact has no friction.
            x, y, z = values[places[keyword] :][:3]
            found["normal_force"] = np.sqrt(x**2 + y**2 + z**2)
            break
    return found


def _places(here: str, given: Any, n_columns: int) -> dict[str, int]:
    """First column of each keyword of the compute."""
    words = given.split() if isinstance(given, str) else None
    if not words or len(set(words)) < len(words) or not set(words) <= set(WIDTHS) or "id" not in words:
        raise checks.fail(
            "contact_columns",
            "be the keywords of compute pair/gran/local, id among them, such as 'pos id force delta'",
            given,
        )
    fixed = sum(WIDTHS[word] or 0 for word in words)
    history = n_columns - fixed
    if history < 0 or (history > 0 and "history" not in words):
        raise checks.fail(f"{here}: columns", f"be {fixed} for '{given}'", n_columns)
    places, at = {}, 0
    for word, width in WIDTHS.items():
        if word in words:
            places[word] = at
            at += history if width is None else width
    return places


def _one_compute(head: bytes) -> bool:
    if not lists_contacts(head):
        return False
    found = re.search(rb"ITEM: NUMBER OF (\S+).*?ITEM: \1 ([^\n]*)", head, re.DOTALL)
    line = found[2].split() if found else []
    return len(line) >= 3 and all(word.startswith(line[0].partition(b"[")[0] + b"[") for word in line)


LIGGGHTS = Format(
    name="liggghts_local",
    holds="contacts",
    summary="LIGGGHTS dump local of compute pair/gran/local with its keyword id",
    endings=(),
    # One compute's values and nothing else; a LAMMPS list names its ids by another compute or by a name.
    recognizes=_one_compute,
    scan=_scan,
    read=partial(_read, _by_keywords),
    options={"contact_columns": "the keywords of compute pair/gran/local in one string"},
)
LAMMPS = Format(
    name="lammps_local",
    holds="contacts",
    summary="LAMMPS dump local with the ids of each pair (compute property/local patom1 patom2) and what else there is",
    endings=(),
    recognizes=lists_contacts,
    scan=_scan,
    read=partial(_read, _by_names),
    options={"contact_columns": "dict from id1, id2, overlap, distance, normal_force to names of columns"},
)
