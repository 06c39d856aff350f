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
    n, shape = chain.n_particles, getattr(trajectory.displacement, "shape", ())
    for field in ("displacement", "velocity"):
        value = getattr(trajectory, field)
        checks.instance(f"trajectory.{field}", value, Tensor)
        if value.dtype not in (torch.float32, torch.float64) or value.layout != torch.strided or value.is_meta:
            raise checks.FieldTypeError(
                f"trajectory.{field} must be a dense tensor of float32 or float64, got {value.dtype} on {value.device}"
            )
        if value.ndim < 2 or value.shape[-1] != n or value.shape != shape:
            raise checks.fail(
                f"trajectory.{field}", f"have shape (*batch, time, {n}), one for both", f"shape {tuple(value.shape)}"
            )


def kinetic_energy(chain: Chain, trajectory: Trajectory) -> Tensor:
    """Kinetic energy of every particle (Eq. 30), (*batch, time, particle)."""
    checked(chain, trajectory)
    velocity = trajectory.velocity
    return checks.finite(
        "energy of trajectory", chain.align(chain.masses, velocity) * velocity.square() / 2, "particle"
    )


def potential_energy(chain: Chain, trajectory: Trajectory, definition: str = "site") -> Tensor:
    """Potential energy of every particle relative to the precompressed state, (*batch, time, particle).

    Args:
        chain: the chain of the trajectory.
        trajectory: displacement (*batch, time, particle).
        definition: "site" is -F u / 2 (Eq. 33), negative on many sites of a disordered chain; "bond" is half of
            the energy of both contacts (Eq. A3), never negative, and counts the whole of a wall contact for its
            one particle. Both have the same sum for linear contacts. Hertz contacts have only "bond".
    """
    checked(chain, trajectory)
    checks.choice("definition", definition, DEFINITIONS)
    displacement = trajectory.displacement
    if definition == "site":
        require_linear(chain, "definition 'bond'")
        return checks.finite("energy of trajectory", -chain.force(displacement) * displacement / 2, "particle")
    contact = checks.finite("energy of trajectory", chain.contact_energy(displacement) / 2, "contact")
    if chain.boundary == "periodic":
        return contact + contact.roll(-1, -1)
    energy = contact[..., 1:] + contact[..., :-1]
    energy[..., 0] += contact[..., 0]
    energy[..., -1] += contact[..., -1]
    return energy


def particle_energy(chain: Chain, trajectory: Trajectory, definition: str = "site") -> Tensor:
    """Total energy of every particle (Eq. 36; Eq. A3 for "bond"), (*batch, time, particle)."""
    return kinetic_energy(chain, trajectory) + potential_energy(chain, trajectory, definition)


def total_energy(chain: Chain, trajectory: Trajectory) -> Tensor:
    """Energy of the whole chain relative to the precompressed state (Eq. 41), (*batch, time)."""
    total = kinetic_energy(chain, trajectory).sum(-1) + chain.contact_energy(trajectory.displacement).sum(-1)
    return checks.finite("energy of trajectory", total, "time")


def require_linear(chain: Chain, remedy: str) -> None:
    """An error for Hertz contacts where -F u / 2 would not be the potential energy."""
    if chain.contact != "linear":
        raise checks.fail(
            "contact", f"be 'linear' here, where the energy is quadratic (use {remedy})", repr(chain.contact)
        )


@dataclass(frozen=True, eq=False)
class EnergyMatrices:
    """KE (Eq. 29), PE (Eq. 32) and their sum TE (Eq. 35), each (*batch, time, particle, particle)."""

    kinetic: Tensor
    potential: Tensor
    total: Tensor


def energy_matrices(chain: Chain, trajectory: Trajectory) -> EnergyMatrices:
    """The full energy matrices M v v^T / 2 and -K u u^T / 2; their diagonals are the site energies.

    N times the memory of the diagonal, which is all that the rest of the library uses: for looking at the
    correlations between particles.
    """
    checked(chain, trajectory)
    require_linear(chain, "total_energy or particle_energy with definition 'bond'")
    displacement, velocity = trajectory.displacement, trajectory.velocity
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
    """
    energy = _per_particle(energy)
    return (energy @ _sites(energy)) / _positive_total(energy)


def energy_width(energy: Tensor) -> Tensor:
    """Mean squared width r^2(t) about the center of energy (Eq. 38), (*batch, time), in squared particle distances.

    Not a square root: the paper's r^2. Takes and raises what :func:`energy_center` does.
    """
    energy = _per_particle(energy)
    offset = _sites(energy) - energy_center(energy)[..., None]
    return (offset.square() * energy).sum(-1) / _positive_total(energy)


def _per_particle(energy: Tensor) -> Tensor:
    energy = checks.real_tensor("energy", energy)
    if energy.ndim == 0:
        raise checks.fail("energy", "have particles on its last axis", "shape ()")
    return energy


def _sites(energy: Tensor) -> Tensor:
    return torch.arange(1, energy.shape[-1] + 1, dtype=energy.dtype, device=energy.device)


def _positive_total(energy: Tensor) -> Tensor:
    total = energy.sum(-1)
    checks.first_bad("total energy", "be positive and finite", total, ~((total > 0) & total.isfinite()), "time")
    return total
