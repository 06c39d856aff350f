"""Mixtures of species: their chains, the energy of each species, and complex modes of damped ones."""

from torchchain.species.damped_modes import DampedModes, damped_modes
from torchchain.species.energy import species_band_energy, species_energy
from torchchain.species.mixtures import ARRANGEMENTS, Mixture, Species, diatomic_frequencies

__all__ = [
    "ARRANGEMENTS", "DampedModes", "Mixture", "Species", "damped_modes", "diatomic_frequencies", "species_band_energy",
    "species_energy",
]  # fmt: skip
