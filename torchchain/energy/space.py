"""Energy in space: per particle, as full matrices, and its center and width (Eqs. 29-38, Appendix A)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory

DEFINITIONS = ("site", "bond")


def checked(chain: Chain, trajectory: Trajectory) -> None:
    """An error unless these are a chain and a trajectory with its particles."""
    checks.instance("chain", chain, Chain)
    checks.instance("trajectory", trajectory, Trajectory)
    shape = tuple(trajectory.displacement.shape)
    if shape[-1] != chain.n_particles:
        raise checks.fail(
            "trajectory.displacement", f"have shape (*batch, time, {chain.n_particles}) as the chain", f"shape {shape}"
        )


def kinetic_energy(chain: Chain, trajectory: Trajectory) -> Tensor:
    """Kinetic energy of every particle (Eq. 30), (*batch, time, particle).

    Args:
        chain: masses (*batch, particle).
        trajectory: velocity (*batch, time, particle).

    Example:
        >>> chain = tc.Chain(torch.ones(4, dtype=torch.float64))
        >>> path = tc.evolve(chain, tc.impulse(chain, velocity=0.5), [0.0], method="modes")
        >>> tc.kinetic_energy(chain, path).round(decimals=6).tolist()
        [[0.125, 0.0, 0.0, 0.0]]
    """
    checked(chain, trajectory)
    velocity = trajectory.velocity
    energy = chain.align(chain.masses / 2, velocity) * velocity.square()
    return checks.finite("energy of trajectory", energy, "particle")


def potential_energy(chain: Chain, trajectory: Trajectory, definition: str = "site") -> Tensor:
    """Potential energy of every particle relative to the precompressed state, (*batch, time, particle).

    Args:
        chain: the chain of the trajectory.
        trajectory: displacement (*batch, time, particle).
        definition: "site" is -F u / 2 (Eq. 33), negative on many sites of a disordered chain; on a ring u is counted
            from where its rigid motion has taken it, as the particle energies would otherwise grow with that. "bond" is
            half of the energy of both contacts (Eq. A3), never negative, and counts the whole of a wall contact for
            its one particle. Both have the same sum for linear contacts. Hertz contacts have only "bond".

    Example:
        >>> chain = tc.Chain(torch.ones(4, dtype=torch.float64), boundary="fixed")
        >>> path = tc.Trajectory(torch.zeros(1), torch.tensor([[0.0, 0.1, 0.0, 0.0]], dtype=torch.float64), torch.zeros(1, 4, dtype=torch.float64))
        >>> tc.potential_energy(chain, path, "bond").round(decimals=6).tolist()
        [[0.0025, 0.005, 0.0025, 0.0]]
    """
    checked(chain, trajectory)
    checks.choice("definition", definition, DEFINITIONS)
    displacement = trajectory.displacement
    if definition == "site":
        require_linear(chain, "definition 'bond'")
        energy = chain.force(displacement) * chain.without_rigid_motion(displacement, -0.5)
        return checks.finite("energy of trajectory", energy, "particle")
    contact = checks.finite("energy of trajectory", chain.contact_energy(displacement), "contact")
    ends = chain.of_both_ends(torch.ones_like(displacement[..., 0, :]))[..., None, :]  # a wall's contact has one
    return chain.of_both_contacts(contact / ends)


def particle_energy(chain: Chain, trajectory: Trajectory, definition: str = "site") -> Tensor:
    """Total energy of every particle (Eq. 36; Eq. A3 for "bond"), (*batch, time, particle).

    Args:
        chain: the chain of the trajectory.
        trajectory: displacement and velocity (*batch, time, particle).
        definition: "site" or "bond", see :func:`potential_energy`.

    Raises:
        FieldError: for "site" with Hertz contacts.

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 3, 0), boundary="fixed")
        >>> energy = tc.particle_energy(chain, tc.evolve(chain, tc.impulse(chain), [0.0, 20.0], method="modes"))
        >>> tuple(energy.shape), torch.allclose(energy[:, 0].sum(-1), energy[:, 1].sum(-1))
        ((3, 2, 64), True)
    """
    return kinetic_energy(chain, trajectory) + potential_energy(chain, trajectory, definition)


def total_energy(chain: Chain, trajectory: Trajectory) -> Tensor:
    """Energy of the whole chain relative to the precompressed state (Eq. 41), (*batch, time).

    Args:
        chain: of any contact law.
        trajectory: displacement and velocity (*batch, time, particle).

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 1, 0))
        >>> energy = tc.total_energy(chain, tc.evolve(chain, tc.standing_wave(chain, tone=5), [0.0, 100.0], method="modes"))
        >>> torch.allclose(energy[:, 0], energy[:, 1])
        True
    """
    checked(chain, trajectory)
    return checks.finite("energy of trajectory", chain.energy(trajectory.displacement, trajectory.velocity), "time")


def require_linear(chain: Chain, remedy: str) -> None:
    """An error for Hertz contacts where -F u / 2 would not be the potential energy."""
    if chain.contact != "linear":
        raise checks.fail(
            "contact", f"be 'linear' here, where the energy is quadratic (use {remedy})", repr(chain.contact)
        )


@dataclass(frozen=True, eq=False)
class EnergyMatrices:
    """KE (Eq. 29), PE (Eq. 32) and their sum TE (Eq. 35), each (*batch, time, particle, particle).

    Example:
        >>> chain = tc.Chain(torch.ones(8))
        >>> found = tc.energy_matrices(chain, tc.evolve(chain, tc.impulse(chain), [0.0, 3.0], method="modes"))
        >>> tuple(found.total.shape)
        (2, 8, 8)
    """

    kinetic: Tensor
    potential: Tensor
    total: Tensor


def energy_matrices(chain: Chain, trajectory: Trajectory) -> EnergyMatrices:
    """The full energy matrices M v v^T / 2 and -K u u^T / 2, a ring's u without its rigid motion; site energies on the diagonal.

    N times the memory of the diagonal, which is all that the rest of the library uses: for looking at the
    correlations between particles.

    Args:
        chain: N particles.
        trajectory: (*batch, time, particle).

    Returns:
        EnergyMatrices, each (*batch, time, particle, particle).

    Example:
        >>> chain = tc.Chain(torch.ones(8, dtype=torch.float64))
        >>> path = tc.evolve(chain, tc.impulse(chain), [3.0], method="modes")
        >>> diagonal = tc.energy_matrices(chain, path).total.diagonal(dim1=-2, dim2=-1)
        >>> torch.allclose(diagonal, tc.particle_energy(chain, path))
        True
    """
    checked(chain, trajectory)
    require_linear(chain, "total_energy or particle_energy with definition 'bond'")
    displacement, velocity = trajectory.displacement, trajectory.velocity
    displacement = chain.without_rigid_motion(displacement)
    masses = chain.align(chain.masses, velocity)
    kinetic = torch.einsum("...p,...q->...pq", masses * velocity, velocity) / 2
    potential = torch.einsum("...p,...q->...pq", chain.force(displacement), displacement) / -2
    return EnergyMatrices(kinetic, potential, checks.finite("energy of trajectory", kinetic + potential, "particle"))


def energy_center(energy: Tensor) -> Tensor:
    """Center of energy R(t) (Eq. 37), in particle numbers counted from 1.

    Args:
        energy: energy per particle, (*batch, time, particle).

    Returns:
        (*batch, time), same dtype and device.

    Raises:
        FieldError: if the total energy of a state is not positive.

    Example:
        >>> tc.energy_center(torch.tensor([[0.0, 1.0, 1.0, 0.0]])).tolist()
        [2.5]
    """
    energy = _per_particle(energy)
    return (energy @ _sites(energy)) / positive(energy.sum(-1), purpose="")


def energy_width(energy: Tensor) -> Tensor:
    """Mean squared width r^2(t) about the center of energy (Eq. 38), (*batch, time), in squared particle distances.

    Not a square root: the paper's r^2. Takes and raises what :func:`energy_center` does.

    Example:
        >>> tc.energy_width(torch.tensor([[0.0, 1.0, 1.0, 0.0]])).tolist()
        [0.25]
    """
    energy = _per_particle(energy)
    offset = _sites(energy) - energy_center(energy)[..., None]
    return (offset.square() * energy).sum(-1) / positive(energy.sum(-1), purpose="")


def _per_particle(energy: Tensor) -> Tensor:
    energy = checks.real_tensor("energy", energy)
    if energy.ndim == 0:
        raise checks.fail("energy", "have particles on its last axis", "shape ()")
    return energy


def _sites(energy: Tensor) -> Tensor:
    return torch.arange(1, energy.shape[-1] + 1, dtype=energy.dtype, device=energy.device)


def positive(total: Tensor, axis: str = "time", purpose: str = " to normalize") -> Tensor:
    """Total energies that shares are taken of: an error for one that is not positive and finite."""
    bad = ~((total > 0) & total.isfinite())
    checks.first_bad("total energy", f"be positive and finite{purpose}", total, bad, axis)
    return total
