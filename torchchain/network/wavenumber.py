"""Energy of networks over wavevectors: by FFT on lattices, by plane waves of the box on packings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.states import Trajectory
from torchchain.network.lattices import PRIMITIVE, Lattice, reciprocal
from torchchain.network.networks import Network
from torchchain.network.trajectories import check_trajectory

POLARIZATIONS = ("longitudinal", "transverse")
MOST_WAVES = 4000


@dataclass(frozen=True, eq=False)
class Zone:
    """Wavevectors that fit into a lattice, folded into the first Brillouin zone, in the order of its FFT.

    Attributes:
        turns: periods along each primitive direction, (wavevector, dimension), integers from 0.
        wavevectors: (wavevector, dimension); on the zone's boundary one of several equivalent ones.
        lengths: |q|, (wavevector,).
        longitudinal: projector on the direction of q, (wavevector, dimension, dimension); on the boundary the mean over
            the equivalent wavevectors, at q = 0 a multiple of one.
        is_edge: whether q has an equivalent of the same length, (wavevector,).

    Example:
        >>> found = tc.network.zone(tc.lattice("triangular", (4, 4)))
        >>> tuple(found.wavevectors.shape), round(found.lengths.max().item(), 3)
        ((16, 2), 3.628)
    """

    turns: Tensor
    wavevectors: Tensor
    lengths: Tensor
    longitudinal: Tensor
    is_edge: Tensor


def zone(network: Lattice) -> Zone:
    """The wavevectors of a periodic lattice.

    Example:
        >>> tc.network.zone(tc.lattice("square", (4, 4))).lengths[:3].round(decimals=4).tolist()
        [0.0, 1.5708, 3.1416]
    """
    checks.instance("network", network, Lattice)
    if not network.is_periodic:
        raise checks.fail("boundary", "be periodic for wavevectors of a lattice", network.boundary)
    found, device = zone_of(network.kind, network.shape), network.bonds.device
    q, lengths, longitudinal = (x.to(network.positions) for x in (found.wavevectors, found.lengths, found.longitudinal))
    return Zone(found.turns.to(device), q, lengths, longitudinal, found.is_edge.to(device))


@lru_cache(maxsize=32)
def zone_of(kind: str, shape: tuple[int, ...]) -> Zone:
    """The wavevectors of periodic lattices of a kind and shape, in float64."""
    primitive = torch.tensor(PRIMITIVE[kind], dtype=torch.float64)
    d, vectors = len(shape), reciprocal(primitive).numpy()
    turns = np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1)
    fraction = turns / np.array(shape)
    fraction = fraction - np.round(fraction)
    moves = np.array(list(np.ndindex(*(5,) * d))) - 2
    best = np.full(len(turns), np.inf)
    for move in moves:
        best = np.minimum(best, np.linalg.norm((fraction + move) @ vectors, axis=1))
    folded = np.zeros((len(turns), d))
    projector, count = np.zeros((len(turns), d, d)), np.zeros(len(turns))
    for move in moves:
        q = (fraction + move) @ vectors
        length = np.linalg.norm(q, axis=1)
        near = length <= best * (1 + 1e-9) + 1e-12
        new = near & (count == 0)
        folded[new] = q[new]
        unit = q[near] / np.maximum(length[near], 1e-300)[:, None]
        projector[near] += unit[:, :, None] * unit[:, None, :]
        count[near] += 1
    projector /= count[:, None, None]
    projector[0] = np.eye(d) / d
    put = torch.from_numpy
    return Zone(put(turns), put(folded), put(best), put(projector), put(count > 1))


def transform(network: Lattice, field: Tensor) -> Tensor:
    """Unitary discrete Fourier transform over the lattice, (*any, particle, component) to (*any, wavevector, component).

    Example:
        >>> sheet = tc.lattice("square", (4, 4), motion="scalar")
        >>> field = torch.ones(16, 1, dtype=torch.float64)
        >>> tc.network.transform(sheet, field).abs().flatten().round(decimals=6).tolist()[:3]  # all at q = 0
        [4.0, 0.0, 0.0]
    """
    axes = tuple(range(-network.dimension - 1, -1))
    return torch.fft.fftn(field.unflatten(-2, network.shape), dim=axes, norm="ortho").flatten(axes[0], -2)


def wavenumber_energy(network: Lattice, trajectory: Trajectory) -> Tensor:
    """Energy of every wavevector and polarization, (*batch, time, wavevector, polarization).

    The real part of conj(v_q) . (M v)_q / 2 + conj(u_q) . (K u)_q / 2, projected on the direction of q (longitudinal)
    and on the directions across (transverse); one polarization only for motion "scalar" and in one dimension. The
    definition of a disordered chain: the sum over everything is the total energy, single terms can be slightly negative.
    q = 0, which has no direction, is the first wavevector and splits its energy evenly over the directions.

    Args:
        network: a periodic lattice; masses and bonds may be disordered.
        trajectory: displacement and velocity (*batch, time, particle, component).

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0], method="modes")
        >>> energy = tc.network.wavenumber_energy(sheet, path)
        >>> tuple(energy.shape), torch.allclose(energy.sum((-2, -1)), tc.network.total_energy(sheet, path))
        ((1, 64, 2), True)
    """
    displacement, velocity = check_trajectory(network, trajectory)
    where = zone(network)
    momentum = network.align(network.masses, velocity) * velocity
    return _split(network, where, velocity, momentum) + _split(
        network, where, displacement, -network.force(displacement)
    )


def _split(network: Lattice, where: Zone, first: Tensor, second: Tensor) -> Tensor:
    """Re conj(first_q) . P (second_q) / 2 for both projectors, (*any, wavevector, polarization)."""
    a, b = transform(network, first), transform(network, second)
    whole = (a.conj() * b).real.sum(-1) / 2
    if network.n_components == 1:
        return whole[..., None]
    along = torch.einsum("...qa,qab,...qb->...q", a.conj(), where.longitudinal.to(a), b).real / 2
    return torch.stack([along, whole - along], dim=-1)


@dataclass(frozen=True, eq=False)
class PlaneWaveEnergy:
    """Energy of a network on plane waves of its box.

    Attributes:
        wavevectors: (wavevector, dimension), q and -q as one, ascending in length; q = 0 first.
        energy: (*batch, time, wavevector, polarization).
        remainder: energy in none of the waves, (*batch, time); with it the sum is the total.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0], method="modes")
        >>> found = tc.network.plane_wave_energy(sheet, path, largest=2.0)
        >>> (found.remainder.abs() < 1e-9 * found.energy.sum()).item()  # one long wave is all there is
        True
    """

    wavevectors: Tensor
    energy: Tensor
    remainder: Tensor

    @property
    def lengths(self) -> Tensor:
        return self.wavevectors.square().sum(-1).sqrt()


def box_wavevectors(network: Network, largest: float) -> Tensor:
    """Wavevectors that fit into the periodic box up to a length, q and -q as one, ascending, (wavevector, dimension).

    Raises:
        FieldError: for a network without a box that is periodic along every direction.

    Args:
        network: in a box that is periodic along every direction.
        largest: |q| of the last one.

    Example:
        >>> tc.network.box_wavevectors(tc.lattice("square", (8, 8)), largest=0.8).shape
        torch.Size([3, 2])
    """
    largest = checks.number("largest wavenumber", largest, at_least=0)
    if network.cell is None:
        box = None if network.box is None else network.box.tolist()
        raise checks.fail("box", "be periodic along every direction for plane waves", box)
    cell = network.cell.detach().double().cpu().numpy()
    vectors = 2 * math.pi * np.linalg.inv(cell).T
    most = [int(largest * np.linalg.norm(row) / (2 * math.pi)) + 1 for row in cell]
    if np.prod([2.0 * r + 1 for r in most]) > 1e7:
        raise checks.fail("largest wavenumber", "leave fewer than 1e7 wavevectors", largest)
    turns = np.array(list(np.ndindex(*(2 * r + 1 for r in most)))) - np.array(most)
    lead = turns[np.arange(len(turns)), (turns != 0).argmax(1)]
    q = turns[lead >= 0] @ vectors  # of q and -q the one whose first turn is positive
    length = np.linalg.norm(q, axis=1)
    keep = length <= largest * (1 + 1e-12)
    q, length = q[keep], length[keep]
    return torch.from_numpy(q[np.lexsort((*q.T, length.round(9)))]).to(network.positions)


def plane_waves(network: Network, wavevectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Orthonormal waves closest to cos(q . x) e and sin(q . x) e, weighted by the root of the mass.

    The waves of an irregular packing overlap: of all orthonormal sets, G^-1/2 applied to them, G being their Gram
    matrix, is nearest to them and treats all alike (Lowdin, J. Chem. Phys. 18, 365, 1950).

    Returns:
        (*batch, unknown, wave), and the wavevector's number and the polarization (0, 1) of every wave.
    """
    x, d, c = network.positions, network.dimension, network.n_components
    phase = x @ wavevectors.mT
    columns, number, kind = [], [], []
    for k, q in enumerate(wavevectors):
        frame = polarizations(q, d) if c > 1 else torch.ones(1, 1).to(q)
        rest = not bool(q.any())
        for wave in [torch.ones_like(phase[:, k])] if rest else [phase[:, k].cos(), phase[:, k].sin()]:
            for e, direction in enumerate(frame):
                columns.append((wave[:, None] * direction).flatten())
                number.append(k)
                kind.append(int(e > 0))
    waves = torch.stack(columns, dim=-1)
    weighted = network.masses.sqrt().repeat_interleave(c, dim=-1)[..., :, None] * waves
    values, vectors = torch.linalg.eigh(weighted.mT @ weighted)
    bad = values[..., 0] <= 1e-10 * values[..., -1]
    if bool(bad.any()):
        raise checks.fail(
            "largest wavenumber", "leave waves that the particles tell apart (lower it)", f"{waves.shape[-1]} waves"
        )
    basis = weighted @ ((vectors * values.rsqrt()[..., None, :]) @ vectors.mT)
    device = wavevectors.device
    return basis, torch.tensor(number, device=device), torch.tensor(kind, device=device)


def polarizations(q: Tensor, d: int) -> Tensor:
    """Orthonormal directions, the first along q, as rows."""
    if not bool(q.any()):
        return torch.eye(d).to(q)
    frame = torch.linalg.qr(torch.cat([(q / q.norm())[:, None], torch.eye(d).to(q)], dim=1))[0].mT
    return frame[:d]


def plane_wave_energy(network: Network, trajectory: Trajectory, largest: float) -> PlaneWaveEnergy:
    """Energy of a packing, or any network in a periodic box, over wavevectors up to a length.

    With B from :func:`plane_waves`, the energy of a wave is |B^T M^1/2 v|^2 / 2 + (B^T M^1/2 u)(B^T M^-1/2 K u) / 2. Waves
    up to |q| hold about a share (|q| / pi)^dimension of all motions of particles at unit distance; what is in none of them
    is reported.

    Args:
        network: periodic along every direction.
        trajectory: displacement and velocity (*batch, time, particle, component).
        largest: |q| of the last wavevector.

    Returns:
        PlaneWaveEnergy.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0], method="modes")
        >>> found = tc.network.plane_wave_energy(sheet, path, largest=2.0)
        >>> tuple(found.wavevectors.shape), tuple(found.energy.shape)
        ((10, 2), (1, 10, 2))
    """
    displacement, velocity = check_trajectory(network, trajectory)
    wavevectors = box_wavevectors(network, largest)
    if 2 * len(wavevectors) * network.n_components > min(MOST_WAVES, network.n_unknowns):
        raise checks.fail(
            "largest wavenumber",
            f"leave at most {min(MOST_WAVES, network.n_unknowns)} waves, fewer than unknowns",
            f"{largest:g}: {2 * len(wavevectors) * network.n_components}",
        )
    basis, number, kind = plane_waves(network, wavevectors)
    root = network.align(network.masses.sqrt(), displacement)
    force = -network.force(displacement)
    batch = len(network.batch_shape)
    basis = basis.reshape(*network.batch_shape, *[1] * (displacement.ndim - batch - 3), *basis.shape[-2:])
    speed, place, pull = ((x.flatten(-2)) @ basis for x in (root * velocity, root * displacement, force / root))
    each = (speed.square() + place * pull) / 2
    polarizations = 1 if network.n_components == 1 else 2
    energy = each.new_zeros(*each.shape[:-1], len(wavevectors) * polarizations)
    energy = energy.index_add(-1, number * polarizations + (kind if polarizations == 2 else 0 * kind), each)
    energy = energy.unflatten(-1, (len(wavevectors), polarizations))
    if polarizations == 2:  # q = 0 has no direction
        at_rest = energy[..., :1, :].sum(-1, keepdim=True) * torch.tensor([1.0, network.dimension - 1.0]).to(energy)
        energy = torch.cat([at_rest / network.dimension, energy[..., 1:, :]], dim=-2)
    total = ((root * velocity).square() + displacement * force).sum((-2, -1)) / 2
    return PlaneWaveEnergy(wavevectors, energy, total - energy.sum((-2, -1)))


def shell_energy(lengths: Tensor, energy: Tensor, edges: Any) -> Tensor:
    """Energies of wavevectors summed into shells of |q|, (*batch, time, shell, polarization).

    Args:
        lengths: |q|, (wavevector,).
        energy: (*batch, time, wavevector, polarization).
        edges: ascending; shell s holds edges[s] < |q| <= edges[s + 1].

    Example:
        >>> energy = torch.ones(1, 3, 1)  # one instant, three wavevectors, one polarization
        >>> tc.network.shell_energy(torch.tensor([0.0, 0.5, 1.0]), energy, edges=[0.0, 0.7, 1.4]).flatten().tolist()
        [1.0, 1.0]
    """
    edges = checks.real_tensor("edges", edges).to(energy)
    shell = torch.bucketize(lengths.to(energy) * (1 - 1e-12), edges)
    shells = energy.new_zeros(*energy.shape[:-2], len(edges) + 1, energy.shape[-1]).index_add(-2, shell, energy)
    return shells[..., 1:-1, :]
