"""Networks in one, two and three dimensions: lattices and packings, their modes, motion and wave energy."""

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

__all__ = [
    "FloppyWarning",
    "Lattice",
    "Network",
    "NetworkModes",
    "Packing",
    "Softness",
    "UnstableError",
    "check_stability",
    "components",
    "dispersion",
    "lattice",
    "normal_modes",
    "packing",
    "rattlers",
    "rigid_motions",
    "softness",
    "subnetwork",
    "without_rattlers",
]
