"""One name for chains and networks: ``tc.evolve``, ``tc.normal_modes`` and the energies take either."""

from __future__ import annotations

from typing import Any, overload

from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy import space, wavenumber
from torchchain.evolvers import evolved
from torchchain.modes import spectrum
from torchchain.modes.spectrum import NormalModes
from torchchain.network import bands
from torchchain.network import energy as network_space
from torchchain.network import evolvers as networks
from torchchain.network import wavenumber as network_wavenumber
from torchchain.network.lattices import Lattice
from torchchain.network.modes import NetworkModes
from torchchain.network.modes import normal_modes as network_modes
from torchchain.network.networks import Network


def evolve(chain: Chain | Network, state: State, times: Any, method: str = "modes", **options: Any) -> Trajectory:
    """States of a chain or a network at the given times.

    Args:
        chain: a chain or a network, masses (*batch, particle).
        state: the start at time 0, (*batch, *any, particle), and with an axis (component) behind it for a network.
        times: (time,), in units of the travel time of sound over one particle; increasing, not negative.
        method: a name in ``METHODS`` (of chains) or ``torchchain.network.METHODS``; each entry states its order, stability,
            cost and limits.
        options: the method's own.

    Returns:
        Trajectory with displacement and velocity (*batch, *any, time, particle), and (component) for a network.

    Raises:
        FieldError, FieldTypeError: for times, a method, an option or a system that the method cannot treat.

    Warns:
        LinearityWarning: for linear contacts of a chain that the start would open (elongation 1, the initial overlap).
        UnitsWarning: for masses of a chain whose mean is far from 1.

    >>> import torchchain as tc
    >>> chain = tc.Chain(tc.Disorder(strength=0.1).masses(16, 2, seed=0))
    >>> tc.evolve(chain, tc.impulse(chain, site=8), [0.0, 1.0, 2.0]).velocity.shape
    torch.Size([2, 3, 16])
    """
    if isinstance(chain, Network):
        return networks.evolve(chain, state, times, method, **options)
    return evolved(chain, state, times, method, options, stacklevel=4)


@overload
def normal_modes(chain: Chain) -> NormalModes: ...


@overload
def normal_modes(chain: Network) -> NetworkModes: ...


def normal_modes(chain: Chain | Network) -> NormalModes | NetworkModes:
    """Normal modes of a chain (linear, or linearized) or of a network, checked for residual and orthogonality.

    Args:
        chain: a chain or a network, undamped; Hertz contacts are taken at the initial overlap.

    Returns:
        NormalModes with frequencies (*batch, mode), ascending, and shapes with shapes^T M shapes = 1; NetworkModes for a
        network.

    Raises:
        FieldError: for a damped system.
        DecompositionError, UnstableError: for modes that fail the check, or a network that its prestress makes unstable.

    >>> import torch, torchchain as tc
    >>> tc.normal_modes(tc.Chain(torch.ones(4, dtype=torch.float64))).frequencies.round(decimals=4)
    tensor([0.0000, 1.4142, 1.4142, 2.0000], dtype=torch.float64)
    """
    return network_modes(chain) if isinstance(chain, Network) else spectrum.normal_modes(chain)


def particle_energy(chain: Chain | Network, trajectory: Trajectory, definition: str | None = None) -> Tensor:
    """Total energy of every particle of a chain (Eq. 36) or a network, (*batch, time, particle).

    Args:
        chain: a chain or a network.
        trajectory: its states in time.
        definition: "site", -F u / 2 besides the kinetic energy (Eq. 36), or "bond", half of the energy of each of a
            particle's contacts (Eq. A3). None: "site" for a chain, "bond" for a network.

    Raises:
        FieldError: for states of another system, or "site" for Hertz contacts.

    >>> import torch, torchchain as tc
    >>> network = tc.lattice("triangular", (4, 4))
    >>> kick = torch.zeros(16, 2, dtype=torch.float64)
    >>> kick[0, 0] = 1.0
    >>> path = tc.evolve(network, tc.State(torch.zeros_like(kick), kick), [0.0, 1.0])
    >>> tc.particle_energy(network, path).sum(-1)
    tensor([0.5000, 0.5000], dtype=torch.float64)
    """
    if isinstance(chain, Network):
        return network_space.particle_energy(chain, trajectory, "bond" if definition is None else definition)
    return space.particle_energy(chain, trajectory, "site" if definition is None else definition)


def kinetic_energy(chain: Chain | Network, trajectory: Trajectory) -> Tensor:
    """Kinetic energy of every particle of a chain (Eq. 30) or a network, (*batch, time, particle).

    Example:
        >>> ring = tc.Chain(tc.Disorder(strength=0.2).masses(32, 1, seed=0))
        >>> path = tc.evolve(ring, tc.standing_wave(ring, tone=3), [0.0, 5.0])
        >>> tc.kinetic_energy(ring, path).shape
        torch.Size([1, 2, 32])
    """
    return (network_space if isinstance(chain, Network) else space).kinetic_energy(chain, trajectory)


def total_energy(chain: Chain | Network, trajectory: Trajectory) -> Tensor:
    """Energy of a whole chain (Eq. 41) or network relative to its state of rest, (*batch, time).

    Example:
        >>> ring = tc.Chain(tc.Disorder(strength=0.2).masses(32, 1, seed=0))
        >>> path = tc.evolve(ring, tc.standing_wave(ring, tone=3), [0.0, 5.0])
        >>> energy = tc.total_energy(ring, path)[0]
        >>> bool((energy[1] / energy[0] - 1).abs() < 1e-12)
        True
    """
    return (network_space if isinstance(chain, Network) else space).total_energy(chain, trajectory)


def bond_energy(chain: Chain | Network, trajectory: Trajectory) -> Tensor:
    """Energy stored in every contact of a chain or bond of a network, (*batch, time, contact | bond).

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> motion = tc.evolve(sheet, tc.network.plane_wave(sheet, (2, 0)), [0.0, 5.0])
        >>> tc.bond_energy(sheet, motion).shape  # three bonds a particle
        torch.Size([2, 192])
    """
    if isinstance(chain, Network):
        return network_space.bond_energy(chain, trajectory)
    space.checked(chain, trajectory)
    return checks.finite("energy of trajectory", chain.contact_energy(trajectory.displacement), "contact")


def wavenumber_energy(chain: Chain | Network, trajectory: Trajectory, definition: str = "site") -> Tensor:
    """Energy at every wavenumber of a chain (Eq. 43), or at every wavevector and polarization of a lattice.

    Returns:
        (*batch, time, wavenumber) of a chain, see :func:`torchchain.energy.wavenumber_energy`; (*batch, time, wavevector,
        polarization) of a lattice, see :func:`torchchain.network.wavenumber_energy`.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> motion = tc.evolve(sheet, tc.network.plane_wave(sheet, (2, 0)), [0.0, 5.0])
        >>> tc.wavenumber_energy(sheet, motion).shape
        torch.Size([2, 64, 2])
    """
    if isinstance(chain, Network):
        _only_site(definition)
        return network_wavenumber.wavenumber_energy(_lattice(chain), trajectory)
    return wavenumber.wavenumber_energy(chain, trajectory, definition)


def band_energy(
    chain: Chain | Network,
    trajectory: Trajectory,
    n_bands: int = 32,
    normalize: bool = True,
    definition: str = "site",
) -> Tensor:
    """Energy in each band: of |k| on a chain (Eqs. 44-46), of |q| and polarization on a periodic lattice.

    Args:
        chain: a chain of linear contacts with an even number of particles, or a periodic lattice; packings have
            :func:`torchchain.network.plane_wave_energy`.
        trajectory: its states in time.
        n_bands: B; on a lattice shells times polarizations, longitudinal ones first.
        normalize: divide by the total energy.
        definition: of a chain, see :func:`torchchain.energy.wavenumber_energy`; "site" on a lattice.

    Returns:
        (*batch, time, band).

    Raises:
        FieldError: if the bands do not divide the wavenumbers, or a state to be normalized has no energy.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> motion = tc.evolve(sheet, tc.network.plane_wave(sheet, (2, 0)), [0.0, 5.0])
        >>> float(tc.band_energy(sheet, motion, n_bands=6)[0, 1].round(decimals=6))  # all in the second longitudinal shell
        1.0
    """
    if isinstance(chain, Network):
        _only_site(definition)
        return bands.band_energy(_lattice(chain), trajectory, n_bands, normalize)
    return wavenumber.band_energy(chain, trajectory, n_bands, normalize, definition)


def long_time_band_energy(
    chain: Chain | Network,
    state: State,
    n_bands: int = 32,
    normalize: bool = True,
    modes: Any = None,
    definition: str = "site",
) -> Tensor:
    """Infinite-time average of :func:`band_energy`, (*batch, *any, band), exactly, from the modes: no time stepping.

    Args:
        chain: an undamped chain of linear contacts, or a periodic lattice.
        state: its start, (*batch, *any, particle), and (component) for a lattice.
        n_bands, normalize, definition: as for :func:`band_energy`.
        modes: the system's :func:`normal_modes`, where they are at hand.

    Example:
        >>> ring = tc.Chain(tc.Disorder(strength=0.2).masses(32, 1, seed=0))
        >>> tc.long_time_band_energy(ring, tc.standing_wave(ring, tone=3), n_bands=4).shape
        torch.Size([1, 4])
    """
    if isinstance(chain, Network):
        _only_site(definition)
        return bands.long_time_band_energy(_lattice(chain), state, n_bands, normalize, modes)
    return wavenumber.long_time_band_energy(chain, state, n_bands, normalize, modes, definition)


def _lattice(network: Network) -> Lattice:
    if not isinstance(network, Lattice):
        raise checks.FieldTypeError(
            "network must be a lattice for its wavevectors (use torchchain.network.plane_wave_energy for a packing), "
            f"got a {type(network).__name__}"
        )
    return network


def _only_site(definition: str) -> None:
    checks.choice("definition of a lattice's wavenumber energy", definition, ("site",))
