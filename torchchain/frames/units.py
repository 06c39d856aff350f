"""Masses and contact stiffnesses of a frame, and the units that they set."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.scaling import derived_units
from torchchain.frames.record import AXES, Box, Contacts, Frame

LAWS = ("linear", "hertz")


@dataclass(frozen=True)
class ContactUnits:
    """Units in which the mean mass, the mean contact stiffness and the mean overlap are 1.

    Has ``unit(quantity)`` like :class:`torchchain.Scaling`.

    Attributes:
        mass, stiffness, length: in the file's units; positive.

    Example:
        >>> units = tc.frames.ContactUnits(mass=2.0, stiffness=8.0, length=0.01)
        >>> units.unit("time")  # sqrt(mass / stiffness)
        0.5
    """

    mass: float
    stiffness: float
    length: float

    def __post_init__(self) -> None:
        for field in ("mass", "stiffness", "length"):
            object.__setattr__(self, field, checks.number(f"units.{field}", getattr(self, field), above=0.0))

    def unit(self, quantity: str) -> float:
        """The file's value of the dimensionless 1 of a quantity."""
        known = derived_units(self.mass, self.stiffness, self.length)
        return known[checks.choice("quantity", quantity, known)]


def finite_masses(frame: Frame) -> Tensor:
    """The masses, (particle,); an error that says where they could come from if there are none."""
    if frame.masses is None:
        raise checks.fail(
            frame.at("masses"),
            "be in the file (LAMMPS: the column mass; MercuryDPM: the .restart beside it) or be given by masses= or, with radii, density=", "none",
        )  # fmt: skip
    fixed = frame.masses.isinf()
    if bool(fixed.any()):
        raise checks.fail(
            frame.at("masses"),
            "be finite (leave out fixed particles with frames.select)",
            f"a fixed particle, id {int(frame.ids[fixed][0])}",
        )
    return frame.masses


def contact_stiffness(frame: Frame, law: str) -> Tensor:
    """Slope of the force at each contact of the frame, (contact,): F / overlap, or (3/2) F / overlap of a Hertz contact."""
    checks.choice("law", law, LAWS)
    contacts = frame.contacts
    if contacts is None:
        raise checks.fail(
            frame.at("contacts"),
            "be read with the frames (read_frames(..., contacts=)) for their stiffness",
            "none",
        )
    for field in ("overlap", "normal_force"):
        values = getattr(contacts, field)
        if values is None:
            raise checks.fail(frame.at(field), "be in the contact list for its stiffness", "none")
        if bool((values <= 0).any()):
            raise checks.fail(
                frame.at(field),
                "be positive at every contact for its stiffness",
                f"{float(values[values <= 0][0]):g}",
            )
    assert contacts.overlap is not None
    assert contacts.normal_force is not None
    return (1.5 if law == "hertz" else 1.0) * contacts.normal_force / contacts.overlap


def periods(box: Box | None) -> Tensor:
    """Lengths of the box along x, y, z, infinite where it is not periodic, (3,)."""
    return torch.tensor([(box.period(axis) if box else 0) or torch.inf for axis in AXES], dtype=torch.float64)


def separation(frame: Frame, pairs: Tensor) -> Tensor:
    """Distance of the centers of pairs, across the box where that is shorter, (pair,)."""
    side = periods(frame.box)[[AXES.index(axis) for axis in frame.axes]]
    apart = frame.positions[pairs[:, 1]] - frame.positions[pairs[:, 0]]
    turns = torch.where(side.isfinite(), (apart / side).round() * side, 0.0)
    return (apart - turns).square().sum(-1).sqrt()


def at_rest(frame: Frame, reference: Frame, law: str) -> Contacts | None:
    """The contacts in the reference: its own, or those of a frame with overlap and force as the law takes them there.

    Between two particles that move from distance L to L0 the overlap grows by L - L0, and the force as its power 1
    ("linear") or 3/2 ("hertz"). Walls, which are nowhere in a list, keep theirs.
    """
    contacts = frame.contacts
    if reference.contacts is not None or contacts is None or reference is frame:
        return reference.contacts if reference.contacts is not None else contacts
    if contacts.overlap is None:
        return replace(contacts, normal_force=None) if contacts.normal_force is not None else contacts
    free = (contacts.pairs >= 0).all(-1)
    pairs = contacts.pairs.clamp(min=0)
    moved = torch.where(free, separation(frame, pairs) - separation(reference, pairs), 0.0)
    overlap, force = contacts.overlap + moved, contacts.normal_force
    if force is not None:
        power = 1.5 if law == "hertz" else 1.0
        force = force * torch.where(contacts.overlap > 0, overlap / contacts.overlap, 1.0).clamp(min=0) ** power
    return replace(contacts, overlap=overlap, normal_force=force)


def fit_units(frame: Frame, law: str) -> ContactUnits:
    """Units from the masses and contacts of a frame at rest; see :meth:`Frames.fit_units`."""
    stiffness = contact_stiffness(frame, law)
    masses = finite_masses(frame)
    assert frame.contacts is not None
    assert frame.contacts.overlap is not None
    if not len(stiffness):
        raise checks.fail(frame.at("contacts"), "be at least one for units", "none")
    return ContactUnits(float(masses.mean()), float(stiffness.mean()), float(frame.contacts.overlap.mean()))


def scaled_frame(frame: Frame, units: Any) -> Frame:
    """The frame in other units, anything with ``unit(quantity)``."""
    length, time, mass, force = (float(units.unit(name)) for name in ("length", "time", "mass", "force"))
    box, contacts = frame.box, frame.contacts
    if box is not None:
        lower, upper = (tuple(bound / length for bound in bounds) for bounds in (box.lower, box.upper))
        box = Box(lower, upper, box.periodic)
    if contacts is not None:
        overlap = None if contacts.overlap is None else contacts.overlap / length
        normal = None if contacts.normal_force is None else contacts.normal_force / force
        contacts = Contacts(contacts.pairs, overlap, normal)
    return replace(
        frame,
        time=None if frame.time is None else frame.time / time,
        positions=frame.positions / length,
        velocities=None if frame.velocities is None else frame.velocities * (time / length),
        masses=None if frame.masses is None else frame.masses / mass,
        radii=None if frame.radii is None else frame.radii / length,
        box=box,
        contacts=contacts,
    )
