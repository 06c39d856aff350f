"""LIGGGHTS contact lists: ``dump ... local`` of ``compute pair/gran/local``, as its ComputePairGranLocal (add_pair) writes them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames import lammps_local
from torchchain.frames.lammps import lists_contacts
from torchchain.frames.lammps_local import can_be_ids, read_columns, scan, whole
from torchchain.frames.registry import Entry, Format, Raw

# The order in which the compute writes, whatever the order of its keywords, and the values of each.
WIDTHS = {
    "pos": 6, "vel": 6, "id": 3, "force": 3, "force_normal": 3, "force_tangential": 3, "torque": 3, "torque_normal": 3,
    "torque_tangential": 3, "history": None, "contactArea": 1, "delta": 1, "contactPoint": 3, "ms_id": 2, "heatFlux": 1,
}  # fmt: skip


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    given = options.get("contact_columns")
    if isinstance(given, dict):  # columns by their names, as in any list
        yield from lammps_local.read(path, entries, options)
        return
    for here, names, rows in read_columns(path, entries):
        values = [rows[name] for name in names]
        if given is None:
            place = _ids(here, names, values)
            found = {"id1": values[place], "id2": values[place + 1]}
        else:
            places = _places(here, given, len(names))
            place = places["id"]
            found = {"id1": values[place], "id2": values[place + 1]}
            if "delta" in places:
                found["overlap"] = values[places["delta"]]
            for keyword in ("force_normal", "force"):
                if keyword in places:
                    at = places[keyword]
                    # The normal component's size; the whole force's where the contact has no friction.
                    found["normal_force"] = np.sqrt(values[at] ** 2 + values[at + 1] ** 2 + values[at + 2] ** 2)
                    break
        yield Raw({field: whole(here, field, v) if field in ("id1", "id2") else v for field, v in found.items()})


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


def _ids(here: str, names: Sequence[str], values: list[np.ndarray]) -> int:
    """The only place of two columns of whole numbers, different in each row, before a flag that is 0 or 1."""
    if not len(values[0]):
        return 0
    good = []
    for i in range(len(values) - 2):
        a, b, flag = values[i : i + 3]
        if can_be_ids(a, b) and np.isin(flag, (0, 1)).all():
            good.append(i)
    if len(good) != 1:
        raise checks.fail(
            f"{here}: columns",
            "be named by contact_columns='pos id force' (the compute's keywords), as they do not show which are ids",
            checks.shown(" ".join(names), 60),
        )
    return good[0]


def _one_compute(head: bytes) -> bool:
    if not lists_contacts(head):
        return False
    found = re.search(rb"ITEM: NUMBER OF (\S+).*?ITEM: \1 ([^\n]*)", head, re.DOTALL)
    line = found[2].split() if found else []
    return len(line) >= 3 and all(word.startswith(line[0].partition(b"[")[0] + b"[") for word in line)


FORMAT = Format(
    name="liggghts_local",
    holds="contacts",
    summary="LIGGGHTS dump local of compute pair/gran/local with its keyword id",
    endings=(),
    # One compute's values and nothing else; a LAMMPS list names its ids by another compute or by a name.
    recognizes=_one_compute,
    scan=scan,
    read=_read,
    options={"contact_columns": "the keywords of compute pair/gran/local in one string"},
)
