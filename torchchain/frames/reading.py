"""Trajectories of other codes, one frame in memory at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.frames.building import build, kept
from torchchain.frames.chains import chain as make_chain
from torchchain.frames.doubts import check_energy, check_opening
from torchchain.frames.motion import displacements
from torchchain.frames.opening import File, Place, Source, find, time_of
from torchchain.frames.packings import network as make_network
from torchchain.frames.record import TIMED, Box, Contacts, Frame
from torchchain.frames.registry import Entry, Raw
from torchchain.frames.units import LAWS, ContactUnits, at_rest, fit_units, scaled_frame
from torchchain.network import Network, NetworkTrajectory


class Frames:
    """The frames of a trajectory, read when they are asked for: iterate, index with a number, or take a slice.

    What holds for all frames is that of the first: ids, masses, radii, box, contacts. Each frame is checked against it as
    it is read. Units are the file's, or those of :meth:`scaled`.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> frame = "ITEM: TIMESTEP\\n{0}\\nITEM: NUMBER OF ATOMS\\n2\\nITEM: ATOMS id mass xu vx\\n1 0.9 0 {0}\\n2 1.1 1 0\\n"
        >>> path = Path(mkdtemp(), "run.dump")
        >>> _ = path.write_text(frame.format(0) + frame.format(1))
        >>> frames = tc.read_frames(path, time_step=0.01)
        >>> len(frames), frames.times.tolist(), frames[1].velocities.tolist()
        (2, [0.0, 0.01], [[1.0], [0.0]])
    """

    def __init__(
        self,
        places: tuple[Place, ...],
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
        times = [time_of(place.entry, self._options) for place in self._places]
        if any(time is None for time in times):
            raise checks.fail(
                f"{self.name}: TIME",
                TIMED,
                "none",
            )
        return torch.tensor(times, dtype=torch.float64) / self._unit("time")

    @property
    def files(self) -> list[Path]:
        """Every file that is read: of frames, of contacts, and of masses."""
        given = self._options.get("masses")
        found = [place.file.path for place in self._places]
        found += [place.listed[0].path for place in self._places if place.listed]
        if isinstance(given, (str, os.PathLike)):
            found.append(Path(given))
        elif given is None and self._options.get("density") is None:
            beside = self._places[0].file.format.sibling(self._places[0].file.path)
            found += [beside] if beside is not None else []
        return list(dict.fromkeys(found))

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
                raise checks.fail(frame.at("velocities"), "be in the file", "none")
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

    def fit_units(self, law: str = "hertz", reference: Source | Frames | Frame | None = None) -> ContactUnits:
        """Units in which mean mass, mean contact stiffness and mean overlap are 1, from the contact list of a state at rest.

        Args:
            law: "hertz", stiffness (3/2) F / overlap, or "linear", F / overlap.
            reference: the state at rest, as for :meth:`trajectory`, by default the first frame; without a contact list of
                its own, that of the first frame is carried over to it.
        """
        checks.choice("law", law, LAWS)
        return fit_units(self._rested(reference, law), law)

    # Chains

    def chain(
        self,
        boundary: str = "periodic",
        stiffness: Any = 1.0,
        *,
        axis: str | None = None,
        contact: str = "linear",
        damping: Any = 0.0,
        reference: Source | Frames | Frame | None = None,
    ) -> Chain:
        """The chain of these particles: their masses in their order along an axis.

        Args:
            boundary: "periodic" or "fixed".
            stiffness: a number or (contact,); or "linear" or "hertz": from force and overlap in the contact list.
            axis: "x", "y" or "z"; by default the one on which the particles form a line.
            contact, damping: as for :class:`torchchain.Chain`.
            reference: the state at rest, at which a stiffness from the contact list is taken, as for :meth:`fit_units`.

        Raises:
            FieldError: without masses, for particles that form no line, for contacts between others than neighbors.

        Warns:
            FramesWarning: for a mean mass far from 1, and a box that is not periodic where the chain is.
        """
        frame = self._rested(reference, stiffness) if isinstance(stiffness, str) else self.first
        return make_chain(frame, boundary, stiffness, axis, contact, damping)

    def trajectory(
        self, reference: Source | Frames | Frame | None = None, *, axis: str | None = None, chain: Chain | None = None
    ) -> Trajectory:
        """Displacements from a reference, across periodic boundaries, and velocities.

        Args:
            reference: the state without a wave: a file of one frame, frames or a frame; by default the first frame.
            axis: "x", "y" or "z" for a chain along it; "all" for vectors, in the order of the ids; by default the axis on
                which the particles form a line, "all" if they form none.
            chain: if given, energy that drifts and contacts that open are looked for; see
                :func:`check_energy` and :func:`check_opening`.

        Returns:
            Trajectory with times counted from the first frame, and displacement and velocity (time, particle) in the order of
            :meth:`chain`; or NetworkTrajectory, (time, particle, axis), in the order of the ids and of :meth:`network`.

        Raises:
            FieldError: for other particles than the reference's, for neighbors that pass each other, without velocities or times.

        Warns:
            FramesWarning: for displacements above the overlap, positions of too few digits, and motion across the chain.
        """
        rest = self._reference(reference)
        found = displacements(self, len(self), self.first, rest, axis, self._unit("length"))
        if chain is not None:
            checks.instance("chain", chain, Chain)
            if isinstance(found, NetworkTrajectory) or chain.masses.shape != found.displacement.shape[-1:]:
                raise checks.fail(
                    "chain",
                    f"have masses of shape {tuple(found.displacement.shape[1:])}",
                    chain.masses,
                )
            check_energy(self.name, chain, found)
            check_opening(self.name, chain, found)
        return found

    def network(
        self,
        reference: Source | Frames | Frame | None = None,
        *,
        stiffness: float | str = 1.0,
        contact: str = "linear",
        damping: float = 0.0,
        prestress: bool = True,
    ) -> Network:
        """The network of these particles in contact, in the order of the ids, in their box.

        Contacts are those of the contact list, where the frames were read with one, else of overlapping disks or spheres.

        Args:
            reference: the state at rest, as for :meth:`trajectory`; by default the first frame.
            stiffness: as for :func:`torchchain.packing`, in the units of the frames; or "linear" or "hertz": from force and
                overlap of each contact in the list.
            contact, damping, prestress: as for :func:`torchchain.packing`.

        Returns:
            Packing, whose states have the axes (particle, axis) that the file holds; of a contact list without radii, or
            with its own stiffnesses, a Network.

        Raises:
            FieldError: without masses, or without both radii and contacts; for a contact listed twice.

        Warns:
            FramesWarning: for contacts with walls, and open ones, which are left out.
        """
        rest = self._reference(reference)
        return make_network(self.first, rest, stiffness, contact, damping, prestress)

    def _rested(self, reference: Source | Frames | Frame | None, law: str) -> Frame:
        """The first frame with its contacts as they are at rest."""
        rest = self._reference(reference)
        return replace(self.first, contacts=at_rest(self.first, rest, law))

    def _reference(self, reference: Source | Frames | Frame | None) -> Frame:
        if reference is None:
            return self.first
        if isinstance(reference, Frame):
            return reference
        if not isinstance(reference, Frames):
            options = {name: value for name, value in self._options.items() if name == "periodic"}  # only where it is
            reference = Frames(*find(reference, None, None, options), self._scale, self._keep)
        if len(reference) != 1:
            raise checks.fail(
                f"{reference.name}: frames", "be one for a reference (choose it: read_frames(path)[-1])", len(reference)
            )
        return reference.first

    # Reading

    def _unit(self, quantity: str) -> float:
        return 1.0 if self._scale is None else float(self._scale.unit(quantity))

    def _read_first(self) -> Frame:
        place = self._places[0]
        return build(place, next(self._raws([(place.file, place.entry)])), None, None, self._options)

    def _raws(self, pairs: Sequence[tuple[Any, Any]]) -> Iterator[Raw]:
        """The numbers of files and entries in them; each file is opened once for consecutive entries."""
        for file, group in _groups(pairs):
            yield from file.format.read(file.path, group, self._options)

    def _frames(self, places: Sequence[Place]) -> Iterator[Frame]:
        contacts = self._raws([place.listed for place in places if place.listed])
        for place, raw in zip(places, self._raws([(place.file, place.entry) for place in places]), strict=True):
            joined = next(contacts) if place.listed else None
            frame = build(place, raw, joined, self._origin, self._options)
            if self._keep is not None:
                frame = kept(frame, torch.searchsorted(frame.ids, self._keep))
            yield frame if self._scale is None else scaled_frame(frame, self._scale)


def _groups(pairs: Sequence[tuple[Any, Any]]) -> Iterator[tuple[File, list[Entry]]]:
    """Consecutive entries of one file together."""
    begin = 0
    for i in range(1, len(pairs) + 1):
        if i == len(pairs) or pairs[i][0] is not pairs[begin][0]:
            yield pairs[begin][0], [entry for _, entry in pairs[begin:i]]
            begin = i
