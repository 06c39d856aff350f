"""One name for chains and networks: ``tc.evolve``, ``tc.normal_modes`` and the energies take either."""

from __future__ import annotations

from typing import Any, overload

from torch import Tensor

from torchchain import checks, evolvers
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy import wavenumber
from torchchain.modes import spectrum
from torchchain.modes.spectrum import NormalModes
from torchchain.network import bands
from torchchain.network import wavenumber as network_wavenumber
from torchchain.network.evolvers import begin
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
        UnstableError: for a network whose prestress makes it unstable.

    Warns:
        LinearityWarning: for linear contacts of a chain that the start would open (elongation 1, the initial overlap).
        UnitsWarning: for masses of a chain whose mean is far from 1.

    >>> import torchchain as tc
    >>> chain = tc.Chain(tc.Disorder(strength=0.1).masses(16, 2, seed=0))
    >>> tc.evolve(chain, tc.impulse(chain, site=8), [0.0, 1.0, 2.0]).velocity.shape
    torch.Size([2, 3, 16])
    """
    if isinstance(chain, Network):
        return begin(chain, state, method, **options)(checks.times("times", times).to(state.displacement.device))
    return evolvers.evolve(chain, state, times, method, **options)


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
        FieldError: for a damped system, or a network too large to decompose.
        DecompositionError, UnstableError: for modes that fail the check, or a network that its prestress makes unstable,
            naming the lowest squared frequency.

    Warns:
        FloppyWarning: for zero modes of a network besides the rigid motions of the whole, counting them.

    >>> import torch, torchchain as tc
    >>> tc.normal_modes(tc.Chain(torch.ones(4, dtype=torch.float64))).frequencies.round(decimals=4)
    tensor([0.0000, 1.4142, 1.4142, 2.0000], dtype=torch.float64)
    """
    return network_modes(chain) if isinstance(chain, Network) else spectrum.normal_modes(chain)


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
