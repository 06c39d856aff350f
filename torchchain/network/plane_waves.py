"""Plane waves of lattices, to start from and to project on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.chain.excitation import PHASES
from torchchain.network.lattices import Lattice
from torchchain.network.wavenumber import POLARIZATIONS, zone


def plane_wave(
    network: Lattice,
    turns: Sequence[int],
    polarization: str = "longitudinal",
    amplitude: float = 0.01,
    phase: str = "sin",
) -> State:
    """A displacement e A sin(q . x) at rest, (*batch, particle, component).

    Args:
        network: a periodic lattice.
        turns: how many wavelengths fit along each primitive direction: q = sum of turns / shape times reciprocal vectors.
        polarization: "longitudinal" (e along q, folded into the first zone), "transverse" (across; the first of two in
            three dimensions) or "scalar" for one component.
        amplitude: A.
        phase: "sin" or "cos".

    Raises:
        FieldError: for a sine that vanishes on every particle, and for a direction that q = 0 does not have.

    Example:
        >>> wave = tc.network.plane_wave(tc.lattice("triangular", (8, 8)), turns=(1, 0), polarization="transverse")
        >>> tuple(wave.displacement.shape)
        (64, 2)
    """
    where = zone(network)
    numbers = [checks.integer("turns", t) for t in turns]
    if len(numbers) != network.dimension:
        raise checks.fail("turns", f"have {network.dimension} entries", numbers)
    allowed = POLARIZATIONS if network.n_components > 1 else ("scalar",)
    checks.choice("polarization", polarization, allowed)
    checks.choice("phase", phase, PHASES)
    amplitude = checks.number("amplitude", amplitude)
    shape = torch.tensor(network.shape)
    wrapped = torch.tensor(numbers) % shape
    if phase == "sin" and bool(((2 * wrapped) % shape == 0).all()):
        raise checks.fail("turns", "not be those of a sine that vanishes at every particle (use phase 'cos')", numbers)
    which = int((where.turns.cpu() == wrapped).all(-1).nonzero()[0])
    # Whole turns are left out exactly: the phase is a ratio of integers.
    sites = where.turns.cpu()  # row-major coordinates of the particles, too
    common = math.lcm(*network.shape)
    cycle = ((sites * wrapped * (common // shape)).sum(-1) % common).to(torch.float64)
    angle = (2 * math.pi * cycle / common).to(network.positions)
    wave = amplitude * (angle.sin() if phase == "sin" else angle.cos())
    direction = _direction(where.wavevectors[which], network.n_components, polarization, numbers)
    field = (wave[:, None] * direction).expand(*network.batch_shape, -1, -1).clone()
    return State(field, torch.zeros_like(field))


def _direction(q: Tensor, components: int, polarization: str, turns: list[int]) -> Tensor:
    if components == 1:
        return torch.ones(1).to(q)
    if not bool(q.any()):
        raise checks.fail("turns", "not all be zero for a polarization", turns)
    unit = q / q.norm()
    if polarization == "longitudinal":
        return unit
    if components == 2:
        return torch.stack([-unit[1], unit[0]])
    axis = torch.zeros_like(unit)
    axis[int(unit.abs().argmin())] = 1.0
    across = axis - (axis @ unit) * unit
    return across / across.norm()
