"""From a frame to the network of its grains in contact."""

from __future__ import annotations

import torch

from torchchain import checks
from torchchain.frames.doubts import here
from torchchain.frames.record import AXES, Frame
from torchchain.frames.units import finite_masses
from torchchain.network import Packing, packing


def network(
    name: str, frame: Frame, at_rest: Frame, stiffness: float, contact: str, damping: float, prestress: bool
) -> Packing:
    """The network of the contacts of overlapping grains; see :meth:`Frames.network`.

    Args:
        name: of the file.
        frame: masses, ids, and radii where the state at rest has none.
        at_rest: positions and box.
        stiffness, contact, damping, prestress: as for :func:`torchchain.packing`.
    """
    if not torch.equal(frame.ids, at_rest.ids):
        raise checks.fail(f"{here(name, at_rest)}: ids", f"be those of {here(name, frame)}", "others")
    radii = at_rest.radii if at_rest.radii is not None else frame.radii
    if radii is None:
        raise checks.fail(f"{here(name, frame)}: radius", "be in the file for a network of contacts", "none")
    box = None
    if at_rest.box is not None and any(at_rest.box.periodic[AXES.index(axis)] for axis in at_rest.axes):
        lengths, marked = at_rest.box.lengths, at_rest.box.periodic
        periods = [float(lengths[i]) if marked[i] else torch.inf for i in map(AXES.index, at_rest.axes)]
        box = torch.tensor(periods, dtype=torch.float64)
    masses = finite_masses(name, frame)
    return packing(at_rest.positions, radii, masses, box, stiffness, contact, damping, prestress)
