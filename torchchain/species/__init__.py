"""Mixtures of species: their chains, the energy of each species, and complex modes of damped ones."""

from torchchain.species.damped_modes import DampedModes, damped_modes
from torchchain.species.energy import species_band_energy, species_energy, species_waves
from torchchain.species.mixtures import (
    ARRANGEMENTS,
    MixedChain,
    Mixture,
    Species,
    diatomic_frequencies,
    hertz_stiffness,
)

__all__ = [
    "ARRANGEMENTS", "DampedModes", "MixedChain", "Mixture", "Species", "damped_modes", "diatomic_frequencies", "hertz_stiffness",
    "species_band_energy", "species_energy", "species_waves",
]  # fmt: skip
