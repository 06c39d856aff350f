"""Where the energy of a network is: per particle, per bond, and its spreading from a point."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.states import Trajectory
from torchchain.energy.space import positive
from torchchain.network.networks import Network
from torchchain.network.trajectories import check_trajectory

DEFINITIONS = ("bond", "site")


def kinetic_energy(network: Network, trajectory: Trajectory) -> Tensor:
    """Kinetic energy of every particle, (*batch, time, particle).

    Args:
        network: the network of the trajectory.
        trajectory: velocity (*batch, time, particle, component).

    Example:
        >>> sheet = tc.lattice("triangular", (4, 4))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0], method="modes")
        >>> tc.network.kinetic_energy(sheet, path).sum().item()  # the wave starts at rest
        0.0
    """
    _, velocity = check_trajectory(network, trajectory)
    return (network.align(network.masses, velocity) * velocity.square()).sum(-1) / 2


def bond_energy(network: Network, trajectory: Trajectory) -> Tensor:
    """Energy stored in every bond, (*batch, time, bond); negative where a pushing bond turns more than it stretches.

    Args:
        network: the network of the trajectory.
        trajectory: displacement (*batch, time, particle, component).

    Example:
        >>> sheet = tc.lattice("triangular", (4, 4))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0], method="modes")
        >>> torch.allclose(tc.network.bond_energy(sheet, path).sum(-1), tc.network.total_energy(sheet, path))  # at rest
        True
    """
    displacement, _ = check_trajectory(network, trajectory)
    return network.bond_energy(displacement)


def particle_energy(network: Network, trajectory: Trajectory, definition: str = "bond") -> Tensor:
    """Energy of every particle, (*batch, time, particle); the sum is :func:`total_energy` by either definition.

    Args:
        network: the network of the trajectory.
        trajectory: displacement and velocity (*batch, time, particle, component).
        definition: "bond": half of the energy of each of its bonds (all of a bond to an anchor) besides the kinetic;
            "site": u . K u / 2 instead, which is negative on many particles; of a network without anchors u is counted
            from its center of mass, as the particle energies would otherwise grow with the drift of the whole.

    Example:
        >>> sheet = tc.lattice("triangular", (4, 4))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0, 5.0], method="modes")
        >>> tuple(tc.network.particle_energy(sheet, path).shape)
        (2, 16)
    """
    checks.choice("definition", definition, DEFINITIONS)
    kinetic = kinetic_energy(network, trajectory)
    if definition == "site":
        displacement = trajectory.displacement
        place = displacement if network.n_anchors else displacement - center_of_mass(network, displacement)
        return kinetic - (network.force(displacement) * place).sum(-1) / 2
    bond = network.bond_energy(trajectory.displacement)
    i, j = network.bonds.unbind(-1)
    n = network.n_particles
    share = torch.where((i >= n) | (j >= n), 1.0, 0.5).to(bond) * bond
    stored = bond.new_zeros(*bond.shape[:-1], n + network.n_anchors)
    stored = stored.index_add(-1, i, share).index_add(-1, j, share)
    return kinetic + stored[..., :n]


def center_of_mass(network: Network, displacement: Tensor) -> Tensor:
    """How far the center of mass has moved, (*batch, *any, 1, component)."""
    masses = network.align(network.masses, displacement)
    return (masses * displacement).sum(-2, keepdim=True) / masses.sum(-2, keepdim=True)


def total_energy(network: Network, trajectory: Trajectory) -> Tensor:
    """Energy of the whole network, (*batch, time).

    Args:
        network: any.
        trajectory: displacement and velocity (*batch, time, particle, component).

    Example:
        >>> sheet = tc.network.disordered(tc.lattice("triangular", (6, 6)), tc.Disorder(strength=0.3), seed=0)
        >>> energy = tc.network.total_energy(sheet, tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0, 50.0], method="modes"))
        >>> torch.allclose(energy[..., 0], energy[..., 1])
        True
    """
    return kinetic_energy(network, trajectory).sum(-1) + bond_energy(network, trajectory).sum(-1)


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
            raise checks.fail(
                "origin", f"be a particle or {network.dimension} coordinates", f"shape {tuple(point.shape)}"
            )
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
