"""Where the energy of a state is: in space, in wavenumber, in bands, and on average over infinite time."""

from torchchain.energy.bands import band_of, bin_energy, center_tones, check_bands
from torchchain.energy.kicked import kicked, kicked_band_energy
from torchchain.energy.modal_bands import modal_band_energy
from torchchain.energy.space import (
    DEFINITIONS,
    EnergyMatrices,
    energy_center,
    energy_matrices,
    energy_width,
    kinetic_energy,
    particle_energy,
    potential_energy,
    total_energy,
)
from torchchain.energy.start_energy import StartEnergy, excited, start_energy
from torchchain.energy.wavenumber import (
    band_energy,
    basis_fraction,
    long_time_band_energy,
    wavenumber_energy,
    wavenumber_energy_matrix,
    zero_wavenumber_share,
)

__all__ = [
    "DEFINITIONS", "EnergyMatrices", "StartEnergy", "band_energy", "band_of", "basis_fraction", "bin_energy", "center_tones",
    "check_bands", "energy_center", "energy_matrices", "energy_width", "excited", "kicked", "kicked_band_energy", "kinetic_energy", "long_time_band_energy",
    "modal_band_energy", "particle_energy", "potential_energy", "start_energy", "total_energy", "wavenumber_energy",
    "wavenumber_energy_matrix", "zero_wavenumber_share",
]  # fmt: skip
