"""One name for chains and networks: ``tc.evolve`` and ``tc.normal_modes`` take either."""

from __future__ import annotations

from typing import Any, overload

from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers import evolved
from torchchain.modes import spectrum
from torchchain.modes.spectrum import NormalModes
from torchchain.network import evolvers as networks
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
