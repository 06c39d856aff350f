"""Exact motion of small networks by their normal modes."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.evolvers.method import Advance
from torchchain.evolvers.modes import METHOD as CHAINS
from torchchain.modes import phase
from torchchain.network.modes import MOST_UNKNOWNS, NetworkModes, normal_modes
from torchchain.network.networks import Network
from torchchain.network.trajectories import NetworkTrajectory


def amplitudes(network: Network, state: State, modes: NetworkModes) -> tuple[Tensor, Tensor]:
    """Coordinates and speeds of the modes, shapes^T M u and shapes^T M v, each (*batch, *any, mode)."""
    masses = network.align(network.masses, state.displacement)
    flat = _aligned(network, modes.shapes, state.displacement).flatten(-3, -2)
    momenta = [(masses * x).flatten(-2)[..., None, :] for x in (state.displacement, state.velocity)]
    return (momenta[0] @ flat)[..., 0, :], (momenta[1] @ flat)[..., 0, :]


def _aligned(network: Network, values: Tensor, field: Tensor) -> Tensor:
    """Values (*batch, particle, component, mode) shaped to multiply a field (*batch, *any, particle, component)."""
    batch = len(network.batch_shape)
    return values.reshape(*network.batch_shape, *[1] * (field.ndim - batch - 2), *values.shape[batch:])


def start(network: Network, state: State, modes: NetworkModes | None = None) -> Advance:
    """See the registry entry below."""
    if modes is None:
        modes = normal_modes(network)
    checks.instance("modes", modes, NetworkModes)
    if tuple(modes.shapes.shape[-3:-1]) != (network.n_particles, network.n_components):
        raise checks.fail("modes", "be those of the network", f"shapes {tuple(modes.shapes.shape)}")
    coordinate, speed = (x[..., None, :] for x in amplitudes(network, state, modes))
    shapes = _aligned(network, modes.shapes, state.displacement).flatten(-3, -2).mT
    batch = len(network.batch_shape)
    w = modes.frequencies
    w = w.reshape(*w.shape[:-1], *[1] * (state.displacement.ndim - batch - 2), 1, w.shape[-1])

    def advance(times: Tensor) -> NetworkTrajectory:
        phase.check(times, modes.frequencies, modes.frequencies.dtype)
        t = times.to(w)[:, None]
        angle = w * t
        sine, cosine = angle.sin(), angle.cos()
        integral = torch.where(w == 0, t, sine / torch.where(w == 0, 1.0, w))  # a zero mode drifts
        unflat = (network.n_particles, network.n_components)
        displacement = (coordinate * cosine + speed * integral) @ shapes
        velocity = (speed * cosine - coordinate * w * sine) @ shapes
        return NetworkTrajectory(times, displacement.unflatten(-1, unflat), velocity.unflatten(-1, unflat))

    return advance


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
