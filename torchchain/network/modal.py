"""Exact motion of small networks by their normal modes."""

from __future__ import annotations

from dataclasses import replace

from torchchain import checks
from torchchain.chain import State
from torchchain.evolvers.method import Advance
from torchchain.evolvers.modes import METHOD as CHAINS
from torchchain.evolvers.modes import superposed
from torchchain.network.modes import MOST_UNKNOWNS, NetworkModes, normal_modes
from torchchain.network.networks import Network
from torchchain.network.trajectories import NetworkTrajectory


def start(network: Network, state: State, modes: NetworkModes | None = None) -> Advance:
    """See the registry entry below."""
    modes = normal_modes(network) if modes is None else modes
    checks.instance("modes", modes, NetworkModes)
    if tuple(modes.shapes.shape[-3:-1]) != (network.n_particles, network.n_components):
        raise checks.fail("modes", "be those of the network", f"shapes {tuple(modes.shapes.shape)}")
    return superposed(network, state, modes, NetworkTrajectory)


METHOD = replace(
    CHAINS,
    start=start,
    stability="unconditional; networks that are not stable are refused",
    cost="(n c)^3 once for n particles of c components, (n c)^2 per output time; (n c)^2 memory",
    cannot="damping, contacts that open, more than some thousand unknowns",
    matrices=12,
    most_unknowns=MOST_UNKNOWNS,
    options={"modes": "NetworkModes of the network, where they are at hand"},
)
