"""From a frame to its chain: masses and contacts in the order along an axis."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.frames.doubts import warn
from torchchain.frames.order import check_contact_order, line_axis, line_order
from torchchain.frames.record import Frame
from torchchain.frames.units import LAWS, contact_stiffness, finite_masses

FAR = 0.1  # of a mean mass from 1


def chain(frame: Frame, boundary: str, stiffness: Any, axis: str | None, contact: str, damping: Any) -> Chain:
    """The chain of a frame; see :meth:`Frames.chain`."""
    line = line_axis(frame, axis)
    if line is None:
        raise checks.fail(
            frame.at("positions"),
            "lie on a line along an axis for a chain (or name it: axis='x')",
            f"{len(frame.ids)} particles that do not",
        )
    order = line_order(frame, line)
    check_contact_order(frame, order, line)
    masses = finite_masses(frame)[order]
    n = len(masses)
    if n < 2:
        raise checks.fail(frame.at("ids"), "be at least 2 for a chain", n)
    mean, spread = float(masses.mean()), float(masses.std()) / math.sqrt(n)
    if abs(mean - 1) > max(FAR, 4 * spread):
        warn(
            frame.at("masses"),
            f"their mean is {mean:.4g}, not 1: times are in other units than the library's (frames.scaled, or import --units mass, gives those)",
        )
    checks.choice("boundary", boundary, ("periodic", "fixed"))
    if boundary == "periodic" and frame.box is not None and not frame.period(line):
        warn(frame.at("box"), f"not marked periodic along {line}, but the chain is to be")
    if isinstance(stiffness, str):
        stiffness = _from_contacts(frame, stiffness, order, boundary)
    return Chain(masses, boundary, stiffness, contact, damping)


def _from_contacts(frame: Frame, law: str, order: Tensor, boundary: str) -> Tensor:
    """The stiffness of every contact in the order of the chain's, (contact,)."""
    if law not in LAWS:
        raise checks.fail("stiffness", "be a number, a tensor (contact,), 'linear' or 'hertz'", repr(law))
    values = contact_stiffness(frame, law)
    contacts = frame.contacts
    assert contacts is not None
    n = len(order)
    place = torch.empty_like(order)
    place[order] = torch.arange(n)
    found = torch.full((n + 1,), torch.nan, dtype=torch.float64)
    for (a, b), value in zip(contacts.pairs.tolist(), values.tolist(), strict=True):
        if a < 0 or b < 0:
            at = 0 if int(place[max(a, b)]) == 0 else n
        else:
            low, high = sorted((int(place[a]), int(place[b])))
            at = high if high - low == 1 and not (n == 2 and not math.isnan(float(found[1]))) else 0
        if not math.isnan(float(found[at])):
            raise checks.fail(frame.at("contacts"), "be one between two neighbors", f"a second one at contact {at + 1}")
        found[at] = value
    found = found[:n] if boundary == "periodic" else found
    if bool(found.isnan().any()):
        raise checks.fail(
            frame.at("contacts"),
            f"be {len(found)}, one between any two neighbors{' and one with each wall' if boundary == 'fixed' else ''}",
            f"none at contact {int(found.isnan().nonzero()[0]) + 1}",
        )
    return found
