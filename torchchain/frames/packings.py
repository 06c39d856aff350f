"""From a frame to the network of its grains in contact: overlapping disks or spheres, or a contact list."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.frames.doubts import warn
from torchchain.frames.record import AXES, Contacts, Frame
from torchchain.frames.units import LAWS, at_rest, contact_stiffness, finite_masses, periods, separation
from torchchain.network import Network, Packing, packing
from torchchain.network.packings import contact_law


def network(
    frame: Frame, reference: Frame, stiffness: float | str, contact: str, damping: float, prestress: bool
) -> Network:
    """The network of the contacts of grains; see :meth:`Frames.network`.

    Args:
        frame: masses, ids, and radii and contacts where the state at rest has none.
        reference: the state at rest: positions and box.
        stiffness: a number as for :func:`torchchain.packing`, or "linear" or "hertz": from force and overlap in the list.
        contact, damping, prestress: as for :func:`torchchain.packing`.
    """
    if not torch.equal(frame.ids, reference.ids):
        raise checks.fail(reference.at("ids"), f"be those of {frame.source}", "others")
    checks.choice("contact", contact, LAWS)
    masses = finite_masses(frame)
    found = [AXES.index(axis) for axis in reference.axes]
    sides = periods(reference.box)[found]
    box = sides if bool(sides.isfinite().any()) else None
    radii = reference.radii if reference.radii is not None else frame.radii
    if isinstance(stiffness, str):
        checks.choice("stiffness", stiffness, LAWS)
        contact = stiffness
    contacts = at_rest(frame, reference, contact)
    rested = replace(reference, masses=masses, radii=radii, contacts=contacts)
    if contacts is None:
        if isinstance(stiffness, str):
            contact_stiffness(rested, stiffness)  # an error: there is no list
        if radii is None:
            raise checks.fail(
                frame.at("radius"),
                "be in the file for a network of contacts, or contact lists with it (a chain: name its axis)",
                "none",
            )
        modulus = checks.number("stiffness", stiffness, above=0)
        try:
            return packing(reference.positions, radii, masses, box, modulus, contact, damping, prestress)
        except checks.FieldError as error:
            raise checks.FieldError(reference.at(str(error))) from None
    contacts = _between_grains(rested, contacts)
    force, slope = _laws(replace(rested, contacts=contacts), contacts, stiffness, contact, prestress)
    fields: dict[str, Any] = {
        "masses": masses, "positions": reference.positions, "bonds": contacts.pairs, "stiffness": slope,
        "tension": -force if prestress else 0.0, "box": box, "damping": damping,
    }  # fmt: skip
    try:
        if radii is not None and not isinstance(stiffness, str):
            return Packing(**fields, radii=radii, contact=contact, modulus=float(stiffness))
        return Network(**fields)
    except checks.FieldError as error:
        raise checks.FieldError(reference.at(str(error))) from None


def _between_grains(frame: Frame, contacts: Contacts) -> Contacts:
    """Those between the frame's particles only, and closed."""
    walls = (contacts.pairs < 0).any(-1)
    if bool(walls.any()):
        warn(frame.at("contacts"), f"{int(walls.sum())} with walls are left out, as a network has none")
    contacts = contacts.where(~walls)
    if contacts.overlap is None and frame.radii is not None and len(contacts.pairs):
        overlap = frame.radii[contacts.pairs].sum(-1) - separation(frame, contacts.pairs)
        contacts = replace(contacts, overlap=overlap)
    if contacts.overlap is not None and bool((contacts.overlap <= 0).any()):
        closed = contacts.where(contacts.overlap > 0)
        left = len(contacts.pairs) - len(closed.pairs)
        warn(frame.at("contacts"), f"{left} of {len(contacts.pairs)} are open and left out")
        contacts = closed
    if not len(contacts.pairs):
        raise checks.fail(frame.at("contacts"), "be at least one between two particles", "none")
    return contacts


def _laws(
    frame: Frame, contacts: Contacts, stiffness: float | str, contact: str, prestress: bool
) -> tuple[Tensor, Tensor]:
    """Force and its slope at every contact of the frame."""
    if isinstance(stiffness, str):
        slope = contact_stiffness(frame, stiffness)
        assert contacts.normal_force is not None
        return contacts.normal_force, slope
    modulus = checks.number("stiffness", stiffness, above=0)
    if contacts.overlap is not None:
        return contact_law(contacts.overlap, contact, modulus)
    if prestress or contact == "hertz":
        raise checks.fail(
            frame.at("overlap"),
            "be in the contact list, or radii in the file, for contacts under pressure (or linear ones with prestress=False)",
            "none",
        )
    zero = torch.zeros(len(contacts.pairs), dtype=torch.float64)
    return zero, zero + modulus
