"""From the numbers of a file to a frame: ids, masses and contacts, checked against the first frame."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.frames import mercury
from torchchain.frames.doubts import warn
from torchchain.frames.opening import File, Place, time_of
from torchchain.frames.passes import where
from torchchain.frames.record import AXES, Box, Contacts, Frame
from torchchain.frames.registry import Raw
from torchchain.frames.text import readable


def build(place: Place, raw: Raw, contacts: Raw | None, first: Frame | None, options: dict[str, Any]) -> Frame:
    """A frame from its numbers: in the order of the ids, checked against the first."""
    at = where(place.file.path.name, place.entry.number)
    columns = raw.columns
    if "id" not in columns:
        raise checks.fail(
            f"{at}: id", "be in the file, as rows come in any order", f"columns {', '.join(columns) or 'of no use'}"
        )
    ids = columns["id"]
    if not len(ids):
        raise checks.fail(f"{at}: particles", "be at least one", 0)
    order = np.argsort(ids, kind="stable")
    ids = ids[order]
    if len(ids) > 1 and (np.diff(ids) == 0).any():
        raise checks.fail(f"{at}: id", "be there once", int(ids[:-1][np.diff(ids) == 0][0]))
    axes = tuple(axis for axis in AXES if axis in columns)
    if not axes:
        raise checks.fail(f"{at}: positions", "be in the file (x, xu, xs or xsu)", f"columns {', '.join(columns)}")
    moving = all(f"v{axis}" in columns for axis in axes)

    def column(name: str) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(columns[name][order], dtype=np.float64))

    for name in ("mass", "radius"):
        if name in columns and (columns[name] <= 0 if name == "mass" else columns[name] < 0).any():
            bad = int(np.argmin(columns[name]))
            raise checks.fail(
                f"{at}: {name}",
                "be positive" if name == "mass" else "not be negative",
                f"{columns[name][bad]:g} of id {int(columns['id'][bad])}",
            )
    frame = Frame(
        number=place.number,
        step=place.entry.step,
        time=time_of(place.entry, options),
        ids=torch.from_numpy(np.ascontiguousarray(ids, dtype=np.int64)),
        axes=axes,
        positions=torch.stack([column(axis) for axis in axes], -1),
        unwrapped=tuple(axis in raw.unwrapped for axis in axes),
        velocities=torch.stack([column(f"v{axis}") for axis in axes], -1) if moving else None,
        masses=column("mass") if "mass" in columns else None,
        radii=column("radius") if "radius" in columns else None,
        box=_marked(raw.box, options),
        source=at,
    )
    if first is None:
        types = columns["type"][order] if "type" in columns else None
        return replace(frame, **masses_of(frame, types, place.file, options))
    check_same(frame, first)
    frame = replace(
        frame, ids=first.ids, masses=first.masses, radii=first.radii if frame.radii is None else frame.radii
    )
    if contacts is not None and place.listed is not None:
        listed = where(place.listed[0].path.name, place.listed[1].number)
        return replace(frame, contacts=contacts_of(listed, contacts.columns, frame, place.file.path.name))
    return frame if raw.contacts is None else replace(frame, contacts=own_contacts(frame, raw.contacts))


def _marked(box: Box | None, options: dict[str, Any]) -> Box | None:
    marks = options.get("periodic")
    if box is None or not marks:
        return box
    return replace(box, periodic=tuple(f or axis in marks for axis, f in zip(AXES, box.periodic, strict=True)))


def kept(frame: Frame, places: Tensor) -> Frame:
    """The particles at these places, and the contacts between them."""
    contacts = frame.contacts
    if contacts is not None:
        moved = torch.full((len(frame.ids) + 1,), -2, dtype=torch.int64)  # the last is that of -1, a wall
        moved[places] = torch.arange(len(places))
        moved[-1] = -1
        pairs = moved[contacts.pairs]
        # A contact with a particle that is left out is one with a wall.
        contacts = replace(contacts, pairs=pairs.clamp(min=-1)).where((pairs >= 0).any(-1))

    def part(values: Tensor | None) -> Tensor | None:
        return None if values is None else values[places]

    return replace(
        frame,
        ids=frame.ids[places],
        positions=frame.positions[places],
        velocities=part(frame.velocities),
        masses=part(frame.masses),
        radii=part(frame.radii),
        contacts=contacts,
    )


def check_same(frame: Frame, first: Frame) -> None:
    """An error for a frame with other particles, columns or properties than the first."""
    if not torch.equal(frame.ids, first.ids):
        missing, new = first.ids[~torch.isin(first.ids, frame.ids)], frame.ids[~torch.isin(frame.ids, first.ids)]
        words = [
            f"{len(part)} {word} (id {int(part[0])}{', ...' if len(part) > 1 else ''})"
            for word, part in (("missing", missing), ("new", new))
            if len(part)
        ]
        raise checks.fail(
            frame.at("id"), f"be those of the {len(first.ids)} particles of the first frame", " and ".join(words)
        )
    if frame.axes != first.axes or frame.unwrapped != first.unwrapped:
        raise checks.fail(frame.at("positions"), "be as in the first frame", ", ".join(frame.axes))
    check_properties(frame, first, "stay as in the first frame (have particles come or gone?)")


def check_properties(frame: Frame, other: Frame, rule: str) -> None:
    """An error for masses or radii, where both frames have them, that differ from those of another frame."""
    for name in ("masses", "radii"):
        a, b = getattr(frame, name), getattr(other, name)
        if a is not None and b is not None and not torch.equal(a, b):
            bad = int((a != b).nonzero()[0])
            raise checks.fail(frame.at(name), rule, f"{a[bad]:g} against {b[bad]:g} of id {int(other.ids[bad])}")


def masses_of(frame: Frame, types: np.ndarray | None, file: File, options: dict[str, Any]) -> dict[str, Any]:
    """Masses (and ids) of the first frame from elsewhere, where the file has none."""
    given, density = options.get("masses"), options.get("density")
    n = len(frame.ids)
    if frame.masses is not None:
        if given is not None or density is not None:
            raise checks.fail(
                "masses" if given is not None else "density",
                f"be left out, as {file.path.name} has masses",
                given if given is not None else density,
            )
        return {}
    if density is not None:
        if frame.radii is None:
            raise checks.fail(frame.at("radius"), "be in the file for masses from a density", "none")
        volume = math.pi * frame.radii**2 if len(frame.axes) == 2 else 4 / 3 * math.pi * frame.radii**3
        if bool((volume == 0).any()):
            raise checks.fail(frame.at("radius"), "be positive for masses from a density", "0")
        return {"masses": density * volume}
    if given is None:
        beside = file.format.sibling(file.path)
        if beside is None:
            return {}
        try:
            return {"masses": _of_restart(frame, mercury.read_restart(readable("masses", beside)), beside.name)}
        except checks.FieldError as error:
            warn(frame.at("masses"), f"none, as the file beside it cannot serve: {error}")
            return {}
    if isinstance(given, (str, os.PathLike)):
        path = readable("masses", Path(given))
        return {"masses": _of_restart(frame, mercury.read_restart(path), path.name)}
    if isinstance(given, Mapping):
        if types is None:
            raise checks.fail(frame.at("type"), "be in the file for masses of types", "none")
        unknown = [int(kind) for kind in np.unique(types) if int(kind) not in given]
        if unknown:
            raise checks.fail("masses", f"hold the type {unknown[0]} of {frame.source}", checks.shown(dict(given)))
        known = {kind: checks.number("masses", value, above=0.0) for kind, value in given.items()}
        return {"masses": torch.tensor([known[int(kind)] for kind in types], dtype=torch.float64)}
    values = checks.real_tensor("masses", given).to(torch.float64)
    if values.ndim > 1 or (values.ndim == 1 and len(values) != n):
        raise checks.fail("masses", f"be a number or {n} numbers, one for each id", values)
    checks.first_bad("masses", "be positive", values, values <= 0, "particle")
    return {"masses": values.expand(n).clone()}


def _of_restart(frame: Frame, found: dict[str, np.ndarray], name: str) -> Tensor:
    """Masses from a .restart file, whose particles are in the order of the .data file's rows."""
    if len(found["mass"]) != len(frame.ids):
        raise checks.fail(f"{name}: Particles", f"be the {len(frame.ids)} of {frame.source}", len(found["mass"]))
    radii = torch.from_numpy(found["radius"])
    if frame.radii is not None:
        # Text of both files has ten digits or more.
        bad = (radii - frame.radii).abs() > 1e-6 * frame.radii
        if bool(bad.any()):
            i = int(bad.nonzero()[0])
            raise checks.fail(
                f"{name}: radius",
                f"be that of {frame.source}",
                f"{float(radii[i]):g} against {float(frame.radii[i]):g} of particle {i}",
            )
    return torch.from_numpy(found["mass"])


def contacts_of(at: str, columns: dict[str, np.ndarray], frame: Frame, name: str) -> Contacts:
    """Contacts with ids turned into places."""
    ids = frame.ids.numpy()
    pairs = np.empty((len(columns["id1"]), 2), dtype=np.int64)
    for side in (0, 1):
        wanted = columns[f"id{side + 1}"]
        place = np.searchsorted(ids, wanted).clip(max=len(ids) - 1)
        wall = wanted == -1 if side else np.zeros(len(wanted), dtype=bool)
        bad = (ids[place] != wanted) & ~wall
        if bad.any():
            raise checks.fail(f"{at}: id{side + 1}", f"be that of a particle of {name}", int(wanted[bad][0]))
        pairs[:, side] = np.where(wall, -1, place)
    same = pairs[:, 0] == pairs[:, 1]
    if same.any():
        raise checks.fail(f"{at}: contacts", "join two particles", f"id {int(ids[pairs[same][0, 0]])} with itself")
    rest = {name: torch.from_numpy(np.ascontiguousarray(v, dtype=np.float64)) for name, v in columns.items()}
    overlap = rest.get("overlap")
    if overlap is None and "distance" in rest and frame.radii is not None:
        overlap = frame.radii[pairs].sum(-1) - rest["distance"]  # a list with distances has no walls
    return Contacts(torch.from_numpy(pairs), overlap, rest.get("normal_force"))


def own_contacts(frame: Frame, found: dict[str, np.ndarray]) -> Contacts:
    """Contacts of a netCDF file, whose pairs are places already."""
    pairs = torch.from_numpy(np.ascontiguousarray(found["pairs"], dtype=np.int64))
    n = len(frame.ids)
    if bool(((pairs < -1) | (pairs >= n)).any()):
        raise checks.fail(frame.at("contact_pair"), f"be places from 0 to {n - 1}, or -1", f"{int(pairs.max())}")
    rest = [
        torch.from_numpy(np.ascontiguousarray(found[field], dtype=np.float64)) if field in found else None
        for field in ("overlap", "normal_force")
    ]
    return Contacts(pairs, rest[0], rest[1])
