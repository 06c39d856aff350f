"""Trajectories of other codes, one frame in memory at a time."""

from __future__ import annotations

import glob
import math
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.frames import lammps, lammps_local, liggghts_local, mercury, mercury_fstat, motion, netcdf, xyz
from torchchain.frames.motion import ContactUnits, here, warn
from torchchain.frames.record import AXES, Box, Contacts, Frame
from torchchain.frames.registry import Entry, Format, Raw
from torchchain.frames.text import Text, readable

FORMATS: dict[str, Format] = {
    entry.name: entry
    for entry in (
        lammps.FORMAT, mercury.FORMAT, xyz.FORMAT, netcdf.FORMAT, liggghts_local.FORMAT, lammps_local.FORMAT, mercury_fstat.FORMAT,
    )
}  # fmt: skip
HEAD = 1 << 14
OPTIONS = ("time_step", "masses", "density", "contact_columns", "periodic")
Source = str | os.PathLike[str]


@dataclass(frozen=True)
class _File:
    """A file and its format."""

    path: Path
    format: Format


@dataclass(frozen=True)
class _Place:
    """Where a frame and its contacts are."""

    number: int
    file: _File
    entry: Entry
    contact_file: _File | None = None
    contact_entry: Entry | None = None


def read_frames(
    path: Source | Sequence[Source],
    contacts: Source | Sequence[Source] | None = None,
    format: str | None = None,
    **options: Any,
) -> Frames:
    """Frames of a trajectory that another code wrote.

    One pass looks at the headers and counts rows; positions are read when a frame is asked for.

    Args:
        path: a file, plain or gzip; a pattern such as "post/dump*.liggghts"; or a list of files, whose frames follow each other.
        contacts: the same for contact lists (LAMMPS and LIGGGHTS dump local, MercuryDPM .fstat), matched by time step or time.
        format: a name in ``torchchain.frames.FORMATS``; by default what the file begins with.
        options:
            time_step: time between two step numbers, for dumps without ITEM: TIME.
            masses: where the file has none: a number, one for each id in ascending order, a dict from type to mass, or a
                MercuryDPM .restart file.
            density: masses from the radii: of spheres, or of disks where the file has two dimensions.
            contact_columns: which columns of a contact list are which; see ``FORMATS[...].options``.
            periodic: axes such as "x" or "xy" on which the box is periodic, where the file does not say.

    Returns:
        Frames, at least one.

    Raises:
        FieldError: in one line with file, frame and field, for a file that cannot be read or does not hold together.

    Warns:
        FramesWarning: for a last frame that is cut short, which is left out.

    Example:
        >>> frames = read_frames("run.dump")  # doctest: +SKIP
        >>> chain, path = frames.chain(boundary="periodic"), frames.trajectory()  # doctest: +SKIP
    """
    checks.known_keys("options", options, OPTIONS)
    options = _check_options(options)
    if format is not None:
        checks.choice("format", format, [name for name, known in FORMATS.items() if known.holds == "particles"])
    places: list[_Place] = []
    cut, units, files = [], None, _files("path", path)
    for file in files:
        found = _known(file, "particles", format)
        scan = found.format.scan(file, options)
        places += [_Place(len(places) + 1 + i, found, entry) for i, entry in enumerate(scan.entries)]
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
    return Frames(tuple(places), options, units)


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


def _files(field: str, path: Source | Sequence[Source]) -> list[Path]:
    """The files of a path, a pattern, or a list; those of a pattern in the order of the numbers in their names."""
    if isinstance(path, (str, os.PathLike)):
        text = os.fspath(path)
        if isinstance(text, str) and not os.path.exists(text) and glob.has_magic(text):
            found = sorted(
                glob.glob(text),
                key=lambda name: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)],
            )
            if not found:
                raise checks.fail(field, "match at least one file", repr(text))
            return [readable(field, Path(name)) for name in found]
        return [readable(field, Path(os.fsdecode(text)))]
    if not isinstance(path, Sequence) or not path:
        raise checks.FieldTypeError(f"{field} must be a path, a pattern or a list of paths, got {checks.shown(path)}")
    return [file for part in path for file in _files(field, part)]


def _known(path: Path, holds: str, name: str | None = None) -> _File:
    """The file with its format: as named, or as it begins."""
    if name is not None:
        return _File(path, FORMATS[name])
    with open(path, "rb") as file:
        head = file.read(HEAD)
    if head[:2] == b"\x1f\x8b":
        head = _head(path)
    for known in FORMATS.values():
        if known.holds == holds and known.recognizes(head):
            return _File(path, known)
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


def _time(entry: Entry, options: dict[str, Any]) -> float | None:
    if entry.time is not None:
        return entry.time
    step = options.get("time_step")
    return None if step is None or entry.step is None else entry.step * step


def _check_times(places: list[_Place], options: dict[str, Any]) -> None:
    """An error for frames out of order."""
    before: _Place | None = None
    for place in places:
        if before is not None:
            for field in ("step", "time"):
                a, b = getattr(before.entry, field), getattr(place.entry, field)
                if (a is None) != (b is None):
                    raise checks.fail(
                        f"{place.file.path.name}, frame {place.entry.number}: {field}",
                        "be given in all frames or in none",
                        b,
                    )
                if a is not None and b <= a:
                    raise checks.fail(
                        f"{place.file.path.name}, frame {place.entry.number}: {field}",
                        "be later than in the frame before",
                        f"{b:.10g} after {a:.10g}",
                    )
        before = place
    if options.get("time_step") is not None and places[0].entry.time is not None:
        raise checks.fail(
            "time_step", f"be left out, as {places[0].file.path.name} states its times", options["time_step"]
        )


def _with_contacts(places: list[_Place], files: list[Path], options: dict[str, Any]) -> list[_Place]:
    """The places of the frames, each with that of its contacts if there are any."""
    by: dict[Any, tuple[_File, Entry]] = {}
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
                raise checks.fail(f"{path.name}, frame {entry.number}: {kind}", "be another than before", key)
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
    return [
        replace(place, contact_file=one[0], contact_entry=one[1]) if one else place
        for place, one in zip(places, found, strict=True)
    ]


class Frames:
    """The frames of a trajectory, read when they are asked for: iterate, index with a number, or take a slice.

    What holds for all frames is that of the first: ids, masses, radii, box, contacts. Each frame is checked against it as
    it is read. Units are the file's, or those of :meth:`scaled`.
    """

    def __init__(
        self,
        places: tuple[_Place, ...],
        options: dict[str, Any],
        file_units: str | None = None,
        scale: Any = None,
        keep: Tensor | None = None,
        first: Frame | None = None,
    ) -> None:
        self._places, self._options, self.file_units, self._scale, self._keep = places, options, file_units, scale, keep
        self._origin = first if first is not None else self._read_first()
        self._first: Frame | None = None

    @property
    def name(self) -> str:
        """Of the (first) file."""
        return self._places[0].file.path.name

    def __repr__(self) -> str:
        form = self._places[0].file.format.name
        return f"Frames({self.name!r}, {form}: {len(self)} frames of {len(self.ids)} particles)"

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Frames: ...
    def __getitem__(self, index: int | slice) -> Frame | Frames:
        if isinstance(index, slice):
            places = self._places[index]
            if not places:
                raise checks.fail(f"{self.name}: frames", f"be at least one of {len(self)}", str(index))
            if index.step is not None and index.step < 0:
                raise checks.fail(f"{self.name}: frames", "stay in their order", str(index))
            return Frames(places, self._options, self.file_units, self._scale, self._keep, self._origin)
        index = checks.integer(f"{self.name}: index", index, -len(self), len(self) - 1)
        return next(self._frames([self._places[index]]))

    def __iter__(self) -> Iterator[Frame]:
        return self._frames(self._places)

    # What all frames share

    @property
    def first(self) -> Frame:
        """The first frame, kept."""
        if self._first is None:
            self._first = self[0]
        return self._first

    @property
    def times(self) -> Tensor:
        """Time of every frame, (frame,).

        Raises:
            FieldError: where the file has only step numbers and no time step was given.
        """
        times = [_time(place.entry, self._options) for place in self._places]
        if any(time is None for time in times):
            raise checks.fail(
                f"{self.name}: TIME",
                "be in the file (LAMMPS: dump_modify ... time yes) or follow from time_step=",
                "none",
            )
        return torch.tensor(times, dtype=torch.float64) / self._unit("time")

    @property
    def steps(self) -> Tensor | None:
        """Time step number of every frame, (frame,), or None."""
        steps = [place.entry.step for place in self._places]
        return None if steps[0] is None else torch.tensor(steps)

    @property
    def ids(self) -> Tensor:
        """(particle,), ascending."""
        return self.first.ids

    @property
    def masses(self) -> Tensor | None:
        """(particle,), in the order of the ids, or None."""
        return self.first.masses

    @property
    def radii(self) -> Tensor | None:
        """(particle,), in the order of the ids, or None."""
        return self.first.radii

    @property
    def box(self) -> Box | None:
        """That of the first frame."""
        return self.first.box

    @property
    def contacts(self) -> Contacts | None:
        """Those of the first frame."""
        return self.first.contacts

    @property
    def positions(self) -> Tensor:
        """Of all frames, (frame, particle, axis): reads the whole file."""
        return torch.stack([frame.positions for frame in self])

    @property
    def velocities(self) -> Tensor:
        """Of all frames, (frame, particle, axis): reads the whole file."""
        found = []
        for frame in self:
            if frame.velocities is None:
                raise checks.fail(f"{here(self.name, frame)}: velocities", "be in the file", "none")
            found.append(frame.velocities)
        return torch.stack(found)

    # Other views

    def select(self, ids: Any) -> Frames:
        """The same frames with these particles only: without walls made of particles, for instance.

        Args:
            ids: whole numbers, each in the file.
        """
        wanted = torch.as_tensor(ids).reshape(-1)
        if wanted.is_floating_point() or wanted.dtype == torch.bool or not len(wanted):
            raise checks.FieldTypeError(f"ids must be whole numbers, at least one, got {checks.shown(ids)}")
        wanted = wanted.unique().to(torch.int64)
        missing = wanted[~torch.isin(wanted, self.ids)]
        if len(missing):
            raise checks.fail("ids", f"be in {self.name}", int(missing[0]))
        return Frames(self._places, self._options, self.file_units, self._scale, wanted, self._origin)

    def scaled(self, units: Any) -> Frames:
        """The same frames in other units.

        Args:
            units: what has ``unit(quantity)`` for "length", "time", "mass" and "force": a :class:`torchchain.Scaling`, for
                files in SI units, or what :meth:`fit_units` gives.
        """
        if not callable(getattr(units, "unit", None)):
            raise checks.FieldTypeError(f"units must be a Scaling or ContactUnits, got {checks.shown(units)}")
        if self._scale is not None:
            raise checks.fail("units", "be given once", "frames that are scaled already")
        return Frames(self._places, self._options, self.file_units, units, self._keep, self._origin)

    def fit_units(self, law: str = "hertz", reference: Frames | Frame | None = None) -> ContactUnits:
        """Units in which mean mass, mean contact stiffness and mean overlap are 1, from the contact list of a state at rest.

        Args:
            law: "hertz", stiffness (3/2) F / overlap, or "linear", F / overlap.
            reference: the state at rest; by default the first frame.
        """
        frame = reference[0] if isinstance(reference, Frames) else (reference or self.first)
        return motion.fit_units(self.name, frame, law)

    # Chains

    def chain(
        self,
        boundary: str = "periodic",
        stiffness: Any = 1.0,
        *,
        axis: str | None = None,
        contact: str = "linear",
        damping: Any = 0.0,
    ) -> Chain:
        """The chain of these particles: their masses in their order along an axis.

        Args:
            boundary: "periodic" or "fixed".
            stiffness: a number or (contact,); or "linear" or "hertz": from force and overlap in the contact list.
            axis: "x", "y" or "z"; by default the one on which the particles form a line.
            contact, damping: as for :class:`torchchain.Chain`.

        Raises:
            FieldError: without masses, for particles that form no line, for contacts between others than neighbors.

        Warns:
            FramesWarning: for a mean mass far from 1, and a box that is not periodic where the chain is.
        """
        return motion.chain(self.name, self.first, boundary, stiffness, axis, contact, damping)

    def trajectory(
        self, reference: Source | Frames | Frame | None = None, *, axis: str | None = None, chain: Chain | None = None
    ) -> Trajectory:
        """Displacements from a reference, across periodic boundaries, and velocities.

        Args:
            reference: the state without a wave: a file of one frame, frames or a frame; by default the first frame.
            axis: "x", "y" or "z" for a chain along it; "all" for vectors, in the order of the ids; by default the axis on
                which the particles form a line, "all" if they form none.
            chain: if given, energy that drifts and contacts that open are looked for; see :func:`check_energy`.

        Returns:
            Trajectory with times counted from the first frame, and displacement and velocity (time, particle) in the order of
            :meth:`chain`, or (time, particle, axis).

        Raises:
            FieldError: for other particles than the reference's, for neighbors that pass each other, without velocities or times.

        Warns:
            FramesWarning: for displacements above the overlap, positions of too few digits, and motion across the chain.
        """
        at_rest, name = self._reference(reference)
        found = motion.displacements(self.name, self, len(self), self.first, at_rest, name, axis, self._unit("length"))
        if chain is not None:
            checks.instance("chain", chain, Chain)
            if found.displacement.ndim != 2 or chain.masses.shape != found.displacement.shape[-1:]:
                raise checks.fail(
                    "chain",
                    f"have masses of shape {tuple(found.displacement.shape[1:])}",
                    f"shape {tuple(chain.masses.shape)}",
                )
            motion.check_energy(self.name, chain, found)
        return found

    def _reference(self, reference: Source | Frames | Frame | None) -> tuple[Frame, str]:
        if reference is None:
            return self.first, self.name
        if isinstance(reference, Frame):
            return reference, "reference"
        if not isinstance(reference, Frames):
            options = {name: value for name, value in self._options.items() if name == "periodic"}  # only where it is
            reference = Frames(read_frames(reference, **options)._places, options, None, self._scale, self._keep)
        if len(reference) != 1:
            raise checks.fail(
                f"{reference.name}: frames", "be one for a reference (choose it: read_frames(path)[-1])", len(reference)
            )
        return reference.first, reference.name

    # Reading

    def _unit(self, quantity: str) -> float:
        return 1.0 if self._scale is None else float(self._scale.unit(quantity))

    def _read_first(self) -> Frame:
        return self._build(self._places[0], next(self._raws(self._places[:1])), None, None)

    def _raws(self, places: Iterable[_Place]) -> Iterator[Raw]:
        """The frames as their files have them; each file is opened once for consecutive frames."""
        for file, group in _groups([(place.file, place.entry) for place in places]):
            yield from file.format.read(file.path, group, self._options)

    def _frames(self, places: Sequence[_Place]) -> Iterator[Frame]:
        listed = [
            (place.contact_file, place.contact_entry) for place in places if place.contact_file and place.contact_entry
        ]
        contacts = (raw for file, group in _groups(listed) for raw in file.format.read(file.path, group, self._options))
        own: Iterator[Any] = iter(())
        if places[0].file.format is netcdf.FORMAT and places[0].contact_file is None:
            own = (
                found
                for file, group in _groups([(place.file, place.entry) for place in places])
                for found in netcdf.read_contacts(file.path, group)
            )
        for place, raw in zip(places, self._raws(places), strict=True):
            joined = next(contacts) if place.contact_entry is not None else None
            yield self._view(self._build(place, raw, joined, self._origin), next(own, None))

    def _build(self, place: _Place, raw: Raw, contacts: Raw | None, first: Frame | None) -> Frame:
        """A frame from its numbers: in the order of the ids, checked against the first."""
        at = f"{place.file.path.name}, frame {place.entry.number}"
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
            time=_time(place.entry, self._options),
            ids=torch.from_numpy(np.ascontiguousarray(ids, dtype=np.int64)),
            axes=axes,
            positions=torch.stack([column(axis) for axis in axes], -1),
            unwrapped=tuple(axis in raw.unwrapped for axis in axes),
            velocities=torch.stack([column(f"v{axis}") for axis in axes], -1) if moving else None,
            masses=column("mass") if "mass" in columns else None,
            radii=column("radius") if "radius" in columns else None,
            box=self._marked(raw.box),
        )
        if first is None:
            types = columns["type"][order] if "type" in columns else None
            return replace(frame, **_masses(at, frame, types, place.file, self._options))
        _check_same(at, frame, first)
        frame = replace(
            frame, ids=first.ids, masses=first.masses, radii=first.radii if frame.radii is None else frame.radii
        )
        if contacts is not None:
            assert place.contact_file is not None
            assert place.contact_entry is not None
            frame = replace(
                frame,
                contacts=_contacts(
                    f"{place.contact_file.path.name}, frame {place.contact_entry.number}",
                    contacts.columns,
                    frame,
                    place.file.path.name,
                ),
            )
        return frame

    def _marked(self, box: Box | None) -> Box | None:
        marks = self._options.get("periodic")
        if box is None or not marks:
            return box
        x, y, z = (flag or axis in marks for axis, flag in zip(AXES, box.periodic, strict=True))
        return replace(box, periodic=(x, y, z))

    def _view(self, frame: Frame, own: dict[str, np.ndarray] | None) -> Frame:
        """The frame as this view shows it: its particles, its units."""
        if own is not None:
            frame = replace(frame, contacts=_own_contacts(f"{self.name}, frame {frame.number}", own, len(frame.ids)))
        if self._keep is not None:
            frame = _kept(frame, torch.searchsorted(frame.ids, self._keep))
        if self._scale is None:
            return frame
        length, time, mass = self._unit("length"), self._unit("time"), self._unit("mass")
        box = frame.box
        if box is not None:
            lower, upper = ([bound / length for bound in bounds] for bounds in (box.lower, box.upper))
            box = Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]), box.periodic)
        return replace(
            frame,
            time=None if frame.time is None else frame.time / time,
            positions=frame.positions / length,
            velocities=None if frame.velocities is None else frame.velocities * (time / length),
            masses=None if frame.masses is None else frame.masses / mass,
            radii=None if frame.radii is None else frame.radii / length,
            box=box,
            contacts=motion.scaled_contacts(frame.contacts, length, self._unit("force")),
        )


def _groups(pairs: Sequence[tuple[Any, Any]]) -> Iterator[tuple[_File, list[Entry]]]:
    """Consecutive entries of one file together."""
    begin = 0
    for i in range(1, len(pairs) + 1):
        if i == len(pairs) or pairs[i][0] is not pairs[begin][0]:
            yield pairs[begin][0], [entry for _, entry in pairs[begin:i]]
            begin = i


def _kept(frame: Frame, places: Tensor) -> Frame:
    """The particles at these places, and the contacts between them."""
    contacts = frame.contacts
    if contacts is not None:
        moved = torch.full((len(frame.ids) + 1,), -2, dtype=torch.int64)  # the last is that of -1, a wall
        moved[places] = torch.arange(len(places))
        moved[-1] = -1
        pairs = moved[contacts.pairs]
        # A contact with a particle that is left out is one with a wall.
        inside = (pairs >= 0).any(-1)
        pairs = pairs[inside].clamp(min=-1)
        contacts = Contacts(
            pairs, *(None if v is None else v[inside] for v in (contacts.overlap, contacts.normal_force))
        )

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


def _check_same(at: str, frame: Frame, first: Frame) -> None:
    """An error for a frame with other particles, columns or properties than the first."""
    if not torch.equal(frame.ids, first.ids):
        missing, new = first.ids[~torch.isin(first.ids, frame.ids)], frame.ids[~torch.isin(frame.ids, first.ids)]
        words = [
            f"{len(part)} {word} (id {int(part[0])}{', ...' if len(part) > 1 else ''})"
            for word, part in (("missing", missing), ("new", new))
            if len(part)
        ]
        raise checks.fail(
            f"{at}: id", f"be those of the {len(first.ids)} particles of the first frame", " and ".join(words)
        )
    if frame.axes != first.axes or frame.unwrapped != first.unwrapped:
        raise checks.fail(f"{at}: positions", "be as in the first frame", ", ".join(frame.axes))
    for name in ("masses", "radii"):
        a, b = getattr(frame, name), getattr(first, name)
        if a is not None and b is not None and not torch.equal(a, b):
            bad = int((a != b).nonzero()[0])
            raise checks.fail(
                f"{at}: {name}",
                "stay as in the first frame (have particles come or gone?)",
                f"{a[bad]:g} after {b[bad]:g} of id {int(first.ids[bad])}",
            )


def _masses(at: str, frame: Frame, types: np.ndarray | None, file: _File, options: dict[str, Any]) -> dict[str, Any]:
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
            raise checks.fail(f"{at}: radius", "be in the file for masses from a density", "none")
        volume = math.pi * frame.radii**2 if len(frame.axes) == 2 else 4 / 3 * math.pi * frame.radii**3
        if bool((volume == 0).any()):
            raise checks.fail(f"{at}: radius", "be positive for masses from a density", "0")
        return {"masses": density * volume}
    if given is None:
        beside = file.format.sibling(file.path)
        if beside is None:
            return {}
        try:
            return {"masses": _of_restart(at, frame, mercury.read_restart(readable("masses", beside)), beside.name)}
        except checks.FieldError as error:
            warn(f"{at}: masses", f"none, as the file beside it cannot serve: {error}")
            return {}
    if isinstance(given, (str, os.PathLike)):
        path = readable("masses", Path(given))
        return {"masses": _of_restart(at, frame, mercury.read_restart(path), path.name)}
    if isinstance(given, Mapping):
        if types is None:
            raise checks.fail(f"{at}: type", "be in the file for masses of types", "none")
        unknown = [int(kind) for kind in np.unique(types) if int(kind) not in given]
        if unknown:
            raise checks.fail("masses", f"hold the type {unknown[0]} of {at}", checks.shown(dict(given)))
        known = {kind: checks.number("masses", value, above=0.0) for kind, value in given.items()}
        return {"masses": torch.tensor([known[int(kind)] for kind in types], dtype=torch.float64)}
    values = checks.real_tensor("masses", given).to(torch.float64)
    if values.ndim > 1 or (values.ndim == 1 and len(values) != n):
        raise checks.fail("masses", f"be a number or {n} numbers, one for each id", f"shape {tuple(values.shape)}")
    checks.first_bad("masses", "be positive", values, values <= 0, "particle")
    return {"masses": values.expand(n).clone()}


def _of_restart(at: str, frame: Frame, found: dict[str, np.ndarray], name: str) -> Tensor:
    """Masses from a .restart file, whose particles are in the order of the .data file's rows."""
    if len(found["mass"]) != len(frame.ids):
        raise checks.fail(f"{name}: Particles", f"be the {len(frame.ids)} of {at}", len(found["mass"]))
    radii = torch.from_numpy(found["radius"])
    if frame.radii is not None:
        # Text of both files has ten digits or more.
        bad = (radii - frame.radii).abs() > 1e-6 * frame.radii
        if bool(bad.any()):
            i = int(bad.nonzero()[0])
            raise checks.fail(
                f"{name}: radius",
                f"be that of {at}",
                f"{float(radii[i]):g} against {float(frame.radii[i]):g} of particle {i}",
            )
    return torch.from_numpy(found["mass"])


def _contacts(at: str, columns: dict[str, np.ndarray], frame: Frame, name: str) -> Contacts:
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


def _own_contacts(at: str, found: dict[str, np.ndarray], n: int) -> Contacts:
    """Contacts of a netCDF file, whose pairs are places already."""
    pairs = torch.from_numpy(np.ascontiguousarray(found["pairs"], dtype=np.int64))
    if bool(((pairs < -1) | (pairs >= n)).any()):
        raise checks.fail(f"{at}: contact_pair", f"be places from 0 to {n - 1}, or -1", f"{int(pairs.max())}")
    rest = [
        torch.from_numpy(np.ascontiguousarray(found[field], dtype=np.float64)) if field in found else None
        for field in ("overlap", "normal_force")
    ]
    return Contacts(pairs, rest[0], rest[1])


def convert(
    path: Source | Sequence[Source],
    out: Source,
    contacts: Source | Sequence[Source] | None = None,
    format: str | None = None,
    **options: Any,
) -> Path:
    """Write frames into one netCDF file that :func:`read_frames` reads many times faster than text.

    Args:
        path, contacts, format, options: as for :func:`read_frames`.
        out: the file to be written; it appears when it is whole.

    Returns:
        The path of the new file.
    """
    frames = read_frames(path, contacts, format, **options)
    target = Path(out)
    if target.exists() and any(target.samefile(place.file.path) for place in frames._places):
        raise checks.fail("out", "be another file than those read", str(target))
    if target.is_dir() or not target.parent.is_dir():
        raise checks.fail("out", "be a file in a folder that is there", str(target))
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".convert-") as scratch:
            part = Path(scratch) / "frames.nc"
            netcdf.write(part, frames, frames.name, frames.file_units)
            os.replace(part, target)
    except OSError as error:
        raise checks.fail("out", "be a file that can be written", f"{target}: {error.strerror or error}") from None
    return target
