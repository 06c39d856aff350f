"""Networks in one, two and three dimensions: lattices and packings, their modes, motion and wave energy."""

from torchchain.network.bands import (
    BandWaves,
    ShellBands,
    band_energy,
    band_waves,
    long_time_band_energy,
    shell_bands,
)
from torchchain.network.disorder import diluted, disordered, displaced, mixture
from torchchain.network.energy import (
    bond_energy,
    distances,
    energy_front,
    energy_radius,
    energy_spread,
    kinetic_energy,
    particle_energy,
    radial_profile,
    total_energy,
)
from torchchain.network.evolvers import METHODS, begin
from torchchain.network.lattices import Lattice, dispersion, lattice
from torchchain.network.modes import (
    FloppyWarning,
    NetworkModes,
    Softness,
    UnstableError,
    check_stability,
    components,
    rigid_motions,
    softness,
)
from torchchain.network.networks import Network
from torchchain.network.packing_bands import PackingBands, band_starts, packing_band_energy, packing_bands
from torchchain.network.packings import Packing, packing, rattlers, subnetwork, without_rattlers
from torchchain.network.plane_waves import plane_wave
from torchchain.network.spectra import (
    Spectrum,
    born_rate,
    density_from_moments,
    density_of_states,
    ordered_density,
    spectral_moments,
    structure_factor,
)
from torchchain.network.systems import evolve, normal_modes
from torchchain.network.trajectories import NetworkTrajectory
from torchchain.network.verlet import grain_energy
from torchchain.network.wavenumber import (
    PlaneWaveEnergy,
    Zone,
    box_wavevectors,
    plane_wave_energy,
    shell_energy,
    transform,
    wavenumber_energy,
    zone,
)

__all__ = [
    "METHODS",
    "BandWaves",
    "FloppyWarning",
    "Lattice",
    "Network",
    "NetworkModes",
    "NetworkTrajectory",
    "Packing",
    "PackingBands",
    "PlaneWaveEnergy",
    "ShellBands",
    "Softness",
    "Spectrum",
    "UnstableError",
    "Zone",
    "band_energy",
    "band_starts",
    "band_waves",
    "begin",
    "bond_energy",
    "born_rate",
    "box_wavevectors",
    "check_stability",
    "components",
    "density_from_moments",
    "density_of_states",
    "diluted",
    "disordered",
    "dispersion",
    "displaced",
    "distances",
    "energy_front",
    "energy_radius",
    "energy_spread",
    "evolve",
    "grain_energy",
    "kinetic_energy",
    "lattice",
    "long_time_band_energy",
    "mixture",
    "normal_modes",
    "ordered_density",
    "packing",
    "packing_band_energy",
    "packing_bands",
    "particle_energy",
    "plane_wave",
    "plane_wave_energy",
    "radial_profile",
    "rattlers",
    "rigid_motions",
    "shell_bands",
    "shell_energy",
    "softness",
    "spectral_moments",
    "structure_factor",
    "subnetwork",
    "total_energy",
    "transform",
    "wavenumber_energy",
    "without_rattlers",
    "zone",
]
