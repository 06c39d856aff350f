"""Networks in one, two and three dimensions: lattices and packings, their modes, motion and wave energy."""

from torchchain.network.evolvers import METHODS, evolve
from torchchain.network.lattices import Lattice, dispersion, lattice
from torchchain.network.modes import (
    FloppyWarning,
    NetworkModes,
    Softness,
    UnstableError,
    check_stability,
    components,
    normal_modes,
    rigid_motions,
    softness,
)
from torchchain.network.networks import Network
from torchchain.network.packings import Packing, packing, rattlers, subnetwork, without_rattlers
from torchchain.network.trajectories import NetworkTrajectory
from torchchain.network.verlet import grain_energy

__all__ = [
    "METHODS",
    "FloppyWarning",
    "Lattice",
    "Network",
    "NetworkModes",
    "NetworkTrajectory",
    "Packing",
    "Softness",
    "UnstableError",
    "check_stability",
    "components",
    "dispersion",
    "evolve",
    "grain_energy",
    "lattice",
    "normal_modes",
    "packing",
    "rattlers",
    "rigid_motions",
    "softness",
    "subnetwork",
    "without_rattlers",
]
