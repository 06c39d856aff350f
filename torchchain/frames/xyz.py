"""Extended XYZ, as ASE and OVITO write it; needs the package ase (the extra ``xyz``)."""

from __future__ import annotations

import importlib
import io
import re
import warnings
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.passes import Passed, frames_at, scanned, where
from torchchain.frames.record import AXES, Box
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import CutShort, Text

NAMES = {
    "id": ("id", "ids", "particle_identifier"), "mass": ("mass", "masses"), "radius": ("radius", "radii"),
    "velocity": ("velo", "vel", "velocity", "velocities"),
}  # fmt: skip
MOST_DIGITS = 4
TIMES, STEPS = ("time", "Time"), ("step", "Step", "timestep", "Timestep")


def _ase() -> Any:
    try:
        return importlib.import_module("ase.io")
    except ImportError:
        raise checks.fail(
            "format",
            "be one whose reader is installed (pip install 'torchchain[xyz]')",
            "'xyz' without the package ase",
        ) from None


def _frame(text: Text, number: int, ase: Any, whole: bool) -> tuple[int, Any] | None:
    """Number of particles and, if ``whole``, the frame as ase reads it; else as it reads the comment line alone."""
    here = where(text.name, number)
    line = text.line()
    while line == "":
        line = text.line()
    if line is None:
        return None
    if not line.isdigit():
        raise checks.fail(f"{here}: line 1", "be the number of particles", checks.shown(line, 40))
    count = int(line)
    if not text.room_for(count, 4):
        raise checks.fail(f"{here}: line 1", "fit into the file", line)
    comment = text.line()
    if comment is None:
        raise CutShort
    wide = re.search(rf"[SRIL]\s*:\s*(\d{{{MOST_DIGITS + 1},}})", comment, re.IGNORECASE)
    if wide:  # ase would make room for as many columns
        raise checks.fail(
            f"{here}: Properties", f"have widths of at most {MOST_DIGITS} digits", checks.shown(wide[1], 40)
        )
    if whole:
        rows = b"".join(text.blocks(count)).decode("latin-1")
    else:
        if text.skip(count, b"\x00") < count:
            raise checks.fail(f"{here}: rows", "be text", "a zero byte")
        return count, _comment(here, comment, ase)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # ase only warns of a damaged comment line
            return count, ase.read(io.StringIO(f"{count}\n{comment}\n{rows}"), format="extxyz", index=0)
    except Exception as error:  # ase lets through whatever its parser comes upon
        raise checks.fail(f"{here}: rows", "be readable to ase", f"{type(error).__name__}: {error}") from None


def _comment(here: str, comment: str, ase: Any) -> dict[str, Any]:
    parse = importlib.import_module("ase.io.extxyz").key_val_str_to_dict
    try:
        found: dict[str, Any] = parse(comment)
    except Exception as error:
        raise checks.fail(f"{here}: line 2", "be key=value pairs", f"{type(error).__name__}: {error}") from None
    return found


def _of(here: str, info: dict[str, Any], keys: tuple[str, ...]) -> float | None:
    for key in keys:
        if key in info:
            value = info[key]
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float, np.integer, np.floating))
                or not np.isfinite(value)
            ):
                raise checks.fail(f"{here}: {key}", "be a finite number", value)
            return float(value)
    return None


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    ase = _ase()

    def passed(text: Text, number: int) -> Passed | None:
        found = _frame(text, number, ase, whole=False)
        if found is None:
            return None
        count, info = found
        step, time = (_of(where(path.name, number), info, keys) for keys in (STEPS, TIMES))
        return count, None if step is None else int(step), time

    return scanned(path, passed)


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    for _, here, _, (_, atoms) in frames_at(path, entries, partial(_frame, ase=_ase(), whole=True)):
        yield _convert(here, atoms)


def _convert(here: str, atoms: Any) -> Raw:
    arrays = atoms.arrays
    found = {axis: arrays["positions"][:, i] for i, axis in enumerate(AXES)}
    for name, keys in NAMES.items():
        for key in keys:
            if key in arrays:
                values = np.asarray(arrays[key])
                if name == "velocity":
                    if values.shape != (len(atoms), 3) or values.dtype.kind not in "iuf":
                        raise checks.fail(f"{here}: {key}", "be three numbers a particle", f"shape {values.shape}")
                    found |= {f"v{axis}": values[:, i].astype(np.float64) for i, axis in enumerate(AXES)}
                elif values.ndim != 1 or values.dtype.kind not in ("iu" if name == "id" else "iuf"):
                    raise checks.fail(
                        f"{here}: {key}",
                        f"be one {'whole ' if name == 'id' else ''}number a particle",
                        f"{values.dtype} of shape {values.shape}",
                    )
                else:
                    found[name] = values.astype(np.int64 if name == "id" else np.float64)
                break
    if "momenta" in arrays and "vx" not in found and "mass" in found:
        found |= {f"v{axis}": arrays["momenta"][:, i] / found["mass"] for i, axis in enumerate(AXES)}
    for name, values in found.items():
        if not np.isfinite(values).all():
            raise checks.fail(
                f"{here}: {name}",
                "be a finite number",
                f"{values[~np.isfinite(values)][0]} in row {int((~np.isfinite(values)).argmax()) + 1}",
            )
    if "id" not in found:
        found["id"] = np.arange(1, len(atoms) + 1)
    cell, box = np.asarray(atoms.cell), None
    if cell.any():
        if np.any(cell - np.diag(np.diag(cell))) or (np.diag(cell) < 0).any():
            raise checks.fail(f"{here}: Lattice", "be that of a box with sides along x, y, z (no tilt)", cell.tolist())
        box = Box((0.0,) * 3, tuple(np.diag(cell).tolist()), tuple(map(bool, atoms.pbc)))
    return Raw(found, box)


def _recognizes(head: bytes) -> bool:
    lines = head.split(b"\n", 2)
    return len(lines) > 1 and lines[0].strip().isdigit() and (b"=" in lines[1] or b"Properties" in lines[1])


FORMAT = Format(
    name="xyz",
    holds="particles",
    summary="extended XYZ with columns velo, mass, id, radius and Time in the comment line (needs ase)",
    endings=(".xyz", ".extxyz"),
    recognizes=_recognizes,
    scan=_scan,
    read=_read,
)
