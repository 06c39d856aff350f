"""Where the energy of a chain or a network is: per particle, per bond; and its spreading from a point of a network."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.energy import space
from torchchain.energy.space import positive
from torchchain.network.networks import Network
from torchchain.network.trajectories import check_trajectory


def kinetic_energy(chain: Chain | Network, trajectory: Trajectory) -> Tensor:
    """Kinetic energy of every particle of a chain (Eq. 30) or a network, (*batch, time, particle).

    Example:
        >>> ring = tc.Chain(tc.Disorder(strength=0.2).masses(32, 1, seed=0))
        >>> path = tc.evolve(ring, tc.standing_wave(ring, tone=3), [0.0, 5.0])
        >>> tc.kinetic_energy(ring, path).shape
        torch.Size([1, 2, 32])
    """
    if not isinstance(chain, Network):
        return space.kinetic_energy(chain, trajectory)
    return chain.kinetic_energy(check_trajectory(chain, trajectory)[1])


def bond_energy(chain: Chain | Network, trajectory: Trajectory) -> Tensor:
    """Energy stored in every contact of a chain or bond of a network, (*batch, time, contact | bond).

    That of a bond is negative where it pushes and turns more than it stretches.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> motion = tc.evolve(sheet, tc.network.plane_wave(sheet, (2, 0)), [0.0, 5.0])
        >>> tc.bond_energy(sheet, motion).shape  # three bonds a particle
        torch.Size([2, 192])
    """
    if isinstance(chain, Network):
        return chain.bond_energy(check_trajectory(chain, trajectory)[0])
    space.checked(chain, trajectory)
    return checks.finite("energy of trajectory", chain.contact_energy(trajectory.displacement), "contact")


def particle_energy(chain: Chain | Network, trajectory: Trajectory, definition: str | None = None) -> Tensor:
    """Total energy of every particle of a chain (Eq. 36) or a network, (*batch, time, particle).

    Args:
        chain: a chain or a network.
        trajectory: its states in time.
        definition: "site", -F u / 2 besides the kinetic energy (Eq. 36), or "bond", half of the energy of each of a
            particle's contacts (Eq. A3), and all of one with a wall or an anchor. None: "site" for a chain, "bond" for a
            network. Without walls or anchors u is counted from the center of mass for "site", as the particle energies
            would otherwise grow with the drift of the whole. The sum is :func:`total_energy` by either.

    Raises:
        FieldError: for states of another system, or "site" for Hertz contacts.

    >>> import torch, torchchain as tc
    >>> network = tc.lattice("triangular", (4, 4))
    >>> kick = torch.zeros(16, 2, dtype=torch.float64)
    >>> kick[0, 0] = 1.0
    >>> path = tc.evolve(network, tc.State(torch.zeros_like(kick), kick), [0.0, 1.0])
    >>> tc.particle_energy(network, path).sum(-1)
    tensor([0.5000, 0.5000], dtype=torch.float64)
    """
    if not isinstance(chain, Network):
        return space.particle_energy(chain, trajectory, "site" if definition is None else definition)
    kinetic = kinetic_energy(chain, trajectory)
    displacement = trajectory.displacement
    if checks.choice("definition", "bond" if definition is None else definition, space.DEFINITIONS) == "site":
        place = displacement if chain.n_anchors else displacement - center_of_mass(chain, displacement)
        return kinetic - (chain.force(displacement) * place).sum(-1) / 2
    bond = chain.bond_energy(displacement)
    i, j = chain.bonds.unbind(-1)
    n = chain.n_particles
    share = torch.where((i >= n) | (j >= n), 1.0, 0.5).to(bond) * bond
    stored = bond.new_zeros(*bond.shape[:-1], n + chain.n_anchors)
    stored = stored.index_add(-1, i, share).index_add(-1, j, share)
    return kinetic + stored[..., :n]


def center_of_mass(network: Network, displacement: Tensor) -> Tensor:
    """How far the center of mass has moved, (*batch, *any, 1, component)."""
    masses = network.align(network.masses, displacement)
    return (masses * displacement).sum(-2, keepdim=True) / masses.sum(-2, keepdim=True)


def total_energy(chain: Chain | Network, trajectory: Trajectory) -> Tensor:
    """Energy of a whole chain (Eq. 41) or network relative to its state of rest, (*batch, time).

    Example:
        >>> ring = tc.Chain(tc.Disorder(strength=0.2).masses(32, 1, seed=0))
        >>> path = tc.evolve(ring, tc.standing_wave(ring, tone=3), [0.0, 5.0])
        >>> energy = tc.total_energy(ring, path)[0]
        >>> bool((energy[1] / energy[0] - 1).abs() < 1e-12)
        True
    """
    if not isinstance(chain, Network):
        return space.total_energy(chain, trajectory)
    return chain.energy(*check_trajectory(chain, trajectory))


def distances(network: Network, origin: int | Any) -> Tensor:
    """Distance of every particle from a point, across the box where that is shorter, (particle,).

    Args:
        network: any.
        origin: a particle, counted from 1, or coordinates (dimension,).

    Example:
        >>> tc.network.distances(tc.lattice("square", (3, 3)), origin=1).round(decimals=3).tolist()[:3]  # across the box
        [0.0, 1.0, 1.0]
    """
    if isinstance(origin, int) and not isinstance(origin, bool):
        point = network.positions[checks.integer("origin", origin, 1, network.n_particles) - 1]
    else:
        point = checks.real_tensor("origin", origin).to(network.positions)
        if tuple(point.shape) != (network.dimension,):
            raise checks.fail("origin", f"be a particle or {network.dimension} coordinates", point)
    return network.nearest_image(network.positions - point).square().sum(-1).sqrt()


def energy_radius(network: Network, energy: Tensor, origin: int | Any) -> Tensor:
    """Mean distance of the energy from a point, R(t), (*batch, time).

    Args:
        network: any.
        energy: per particle, (*batch, time, particle).
        origin: a particle, counted from 1, or coordinates (dimension,).

    Raises:
        FieldError: if the total energy of a state is not positive.

    Example:
        >>> sheet, energy = tc.lattice("square", (5, 5)), torch.zeros(1, 25, dtype=torch.float64)
        >>> energy[0, 1] = 1.0  # all in the neighbor of particle 1
        >>> tc.network.energy_radius(sheet, energy, origin=1).tolist()
        [1.0]
    """
    return _share(energy) @ distances(network, origin)


def energy_spread(network: Network, energy: Tensor, origin: int | Any) -> Tensor:
    """Mean squared distance of the energy from a point, r^2(t), (*batch, time); arguments as :func:`energy_radius`.

    Example:
        >>> sheet, energy = tc.lattice("square", (5, 5)), torch.zeros(1, 25, dtype=torch.float64)
        >>> energy[0, 2] = 1.0  # two spacings from particle 1
        >>> tc.network.energy_spread(sheet, energy, origin=1).tolist()
        [4.0]
    """
    return _share(energy) @ distances(network, origin).square()


def energy_front(network: Network, energy: Tensor, origin: int | Any, share: float = 0.99) -> Tensor:
    """Radius about a point that holds this share of the energy, (*batch, time); arguments as :func:`energy_radius`.

    Example:
        >>> sheet = tc.lattice("square", (5, 5))
        >>> tc.network.energy_front(sheet, torch.ones(1, 25, dtype=torch.float64), origin=1, share=0.5).shape
        torch.Size([1])
    """
    share = checks.number("share", share, above=0, at_most=1)
    far, order = distances(network, origin).sort()
    held = _share(energy)[..., order].cumsum(-1)
    first = (held < share - 1e-12).sum(-1).clamp(max=network.n_particles - 1)
    return far[first]


def radial_profile(network: Network, energy: Tensor, origin: int | Any, edges: Any) -> Tensor:
    """Energy in rings (shells) about a point, (*batch, time, ring); their sum is the total if the edges hold all particles.

    Args:
        network: any.
        energy: per particle, (*batch, time, particle).
        origin: a particle, counted from 1, or coordinates (dimension,).
        edges: radii, ascending; ring r holds edges[r] <= distance < edges[r + 1].

    Example:
        >>> sheet = tc.lattice("square", (5, 5))
        >>> tc.network.radial_profile(sheet, torch.ones(1, 25, dtype=torch.float64), origin=1, edges=[0.0, 0.5, 1.2, 9.0]).tolist()
        [[1.0, 4.0, 20.0]]
    """
    edges = checks.real_tensor("edges", edges).to(energy)
    if edges.ndim != 1 or len(edges) < 2 or bool((edges.diff() <= 0).any()):
        raise checks.fail("edges", "be at least two ascending radii", edges.tolist())
    ring = torch.bucketize(distances(network, origin).to(energy), edges, right=True)
    rings = energy.new_zeros(*energy.shape[:-1], len(edges) + 1).index_add(-1, ring, energy)
    return rings[..., 1:-1]


def _share(energy: Tensor) -> Tensor:
    energy = checks.real_tensor("energy", energy)
    return energy / positive(energy.sum(-1), purpose="")[..., None]
