"""The energy of a mixture's species: in space, and in bands of wavenumber."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.excitation import StandingWave
from torchchain.chain.states import State, Trajectory
from torchchain.energy.bands import bin_energy, center_tones
from torchchain.energy.space import DEFINITIONS, particle_energy, require_linear
from torchchain.energy.wavenumber import product, transform
from torchchain.species.mixtures import MixedChain


def species_energy(
    chain: Chain, trajectory: Trajectory, labels: Tensor, n_species: int, definition: str = "bond"
) -> Tensor:
    """Energy of the beads of every species (Eq. 36 or A3, summed), (*batch, time, species).

    Args:
        chain: masses (*batch, particle).
        trajectory: displacement and velocity (*batch, *any, time, particle).
        labels: species of every bead, counted from 0, (*batch, particle).
        n_species: S.
        definition: "bond", where the energy of a contact is half that of each of its beads, or "site".

    Raises:
        FieldError: for labels that are none, or another shape.

    Example:
        >>> mixture = tc.species.Mixture((tc.species.Species("a"), tc.species.Species("b", mass=2.0)))
        >>> chain, labels = mixture.chain(32, 3, 0), mixture.labels(32, 3, 0)
        >>> path = tc.evolve(chain, tc.impulse(chain, site=4), [0.0, 9.0])
        >>> energy = tc.species.species_energy(chain, path, labels, 2)
        >>> torch.allclose(energy.sum(-1), tc.total_energy(chain, path))
        True
    """
    energy = particle_energy(chain, trajectory, definition)
    return torch.stack([(energy * part).sum(-1) for part in _parts(chain, energy, labels, n_species)], dim=-1)


def species_band_energy(
    chain: Chain,
    trajectory: Trajectory,
    labels: Tensor,
    n_species: int,
    n_bands: int = 32,
    definition: str = "bond",
) -> Tensor:
    """Energy of every species in every band of wavenumber, (*batch, time, species, band).

    Args:
        chain: a ring with linear contacts, an even number of particles, masses (*batch, particle).
        trajectory: displacement and velocity (*batch, *any, time, particle).
        labels: species of every bead, counted from 0, (*batch, particle).
        n_species: S.
        n_bands: B.
        definition: "bond" transforms sqrt(m) v of the beads of one species and sqrt(kappa) times the elongation of the
            contacts, the energy of a contact half that of each of its beads: never negative, and the sum of all is the
            total energy, as the first band of each takes in k = 0. A random order of species scatters even a plane wave
            over all bands, as seen by one of them. "site" sums Eq. 42 over the beads of one species, [(m_p v_p) v + (-F_p) u] / 2 with the waves v and u
            of all beads: sums over species are the band energies of the chain, but one can be far below zero.

    Raises:
        FieldError: for Hertz contacts, walls, labels that are none, or bands that do not divide the tones.

    Example:
        >>> mixture = tc.species.Mixture((tc.species.Species("a"), tc.species.Species("b", mass=2.0)))
        >>> chain, labels = mixture.chain(32, 3, 0), mixture.labels(32, 3, 0)
        >>> path = tc.evolve(chain, tc.standing_wave(chain, tone=4), [0.0, 9.0])
        >>> energy = tc.species.species_band_energy(chain, path, labels, 2, n_bands=4, definition="site")
        >>> torch.allclose(energy.sum(-2), tc.band_energy(chain, path, n_bands=4, normalize=False))
        True
    """
    checks.choice("definition", definition, DEFINITIONS)
    require_linear(chain, "species_energy, which is defined for every contact law")
    if not chain.is_free:
        raise checks.fail("boundary", "be 'periodic' for energies over wavenumber and species", repr(chain.boundary))
    displacement, velocity = trajectory.displacement, trajectory.velocity
    masses, n, found = chain.align(chain.masses, velocity), chain.n_particles, []
    parts = _parts(chain, velocity, labels, n_species)
    if definition == "site":
        displacement = chain.without_rigid_motion(displacement)
        speed, wave = transform(velocity), transform(displacement)
        momentum, force = masses * velocity, -chain.force(displacement)
    else:
        moving = masses.sqrt() * velocity
        elongation = chain.elongation(displacement)
        stretched = chain.align(chain.contact_stiffness, elongation).sqrt() * elongation
    for part in parts:
        if definition == "site":
            energy = (product(transform(momentum * part), speed) + product(transform(force * part), wave)) / 2
        else:
            share = chain.of_both_ends(part) / 2
            moved, strained = transform(moving * part), transform(share.sqrt() * stretched)
            energy = (product(moved, moved) + product(strained, strained)) / 2
        energy[..., 1 : (n + 1) // 2] *= 2  # k and -k are added, except where they are one wavenumber
        if definition == "bond":
            energy[..., 1] += energy[..., 0]
        found.append(bin_energy(energy, n_bands))
    return torch.stack(found, dim=-2)


def species_waves(chain: MixedChain, wave: StandingWave, n_bands: int, chosen: Sequence[int]) -> State:
    """Standing waves of velocity on the beads of one species each, the others and all contacts at rest.

    Args:
        chain: masses (*batch, particle).
        wave: amplitude, that of the velocity, and phase.
        n_bands: bands of every species; each wave has the center tone of one.
        chosen: which, counted from 1, those of the first species first.

    Returns:
        State (*batch, wave, particle).

    Example:
        >>> chain = tc.species.Mixture((tc.species.Species("a"), tc.species.Species("b"))).chain(32, 3, 0)
        >>> state = tc.species.species_waves(chain, tc.StandingWave(), n_bands=4, chosen=(1, 6))
        >>> tuple(state.velocity.shape), float(state.displacement.abs().max())
        ((3, 2, 32), 0.0)
    """
    if chain.labels is None:
        raise checks.fail("chain", "have labels", None)
    moving = replace(wave, tones=center_tones(chain.n_particles, n_bands)).state(chain).displacement
    velocity = [moving[..., (band - 1) % n_bands, :] * (chain.labels == (band - 1) // n_bands) for band in chosen]
    speed = torch.stack(velocity, dim=-2)
    return State(torch.zeros_like(speed), speed)


def _parts(chain: Chain, field: Tensor, labels: Tensor, n_species: int) -> list[Tensor]:
    """1 for the beads of each species, else 0, shaped to multiply a field (*batch, *any, particle)."""
    count = checks.integer("n_species", n_species, 1)
    if not isinstance(labels, Tensor) or labels.shape != chain.masses.shape:
        shape = tuple(labels.shape) if isinstance(labels, Tensor) else checks.shown(labels)
        raise checks.fail("labels", f"be a tensor of shape {tuple(chain.masses.shape)} like the masses", shape)
    checks.first_bad("labels", f"be 0 to {count - 1}", labels, (labels < 0) | (labels >= count), "particle")
    return [chain.align((labels == i).to(field), field) for i in range(count)]
