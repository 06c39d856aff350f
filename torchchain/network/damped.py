"""Exact motion of small networks with dashpots, by matrix exponentials."""

from __future__ import annotations

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.evolvers.damped import by_exponentials
from torchchain.evolvers.method import Advance, Method
from torchchain.network.modes import check_stability
from torchchain.network.networks import Network
from torchchain.network.trajectories import NetworkTrajectory

MOST_UNKNOWNS = 3000


def start(network: Network, state: State) -> Advance:
    """See the registry entry below."""
    n, c = network.n_particles, network.n_components
    if n * c > MOST_UNKNOWNS:
        raise checks.fail("network", f"have at most {MOST_UNKNOWNS} unknowns for method 'damped' (use 'verlet')", n * c)
    check_stability(network)
    # In (W y, dy/dt) with y = M^1/2 u both blocks of the generator are of size W, which keeps exponentials accurate.
    top = network.squared_frequency_bound().clamp(min=1e-300).sqrt().to(network.masses)[..., None, None]
    root = network.masses.sqrt().repeat_interleave(c, dim=-1)
    weight = root[..., :, None] * root[..., None, :]
    stiffness, damping = network.stiffness_matrix() / weight, network.damping_matrix() / weight
    one = torch.eye(n * c).to(stiffness).expand_as(stiffness)
    matrix = torch.cat([torch.cat([0 * one, top * one], -1), torch.cat([-stiffness / top, -damping], -1)], -2)
    field = network.align(network.masses.sqrt(), state.displacement)
    batch = len(network.batch_shape)
    top = top.reshape(*network.batch_shape, *[1] * (state.displacement.ndim - batch - 1))
    y = torch.cat([(field * state.displacement).flatten(-2) * top, (field * state.velocity).flatten(-2)], -1)
    members = y.shape[batch:-1]
    y = y.reshape(*network.batch_shape, -1, 2 * n * c)
    propagate = by_exponentials(matrix, y)
    initial = network.energy(state.displacement, state.velocity)

    def advance(times: Tensor) -> NetworkTrajectory:
        z = propagate(times).reshape(*network.batch_shape, *members, len(times), 2, n, c)
        u, v = (part / field.unsqueeze(-3) for part in z.unbind(-3))
        u = u / top[..., None, None]
        return NetworkTrajectory(times, u, v, dissipated=initial[..., None] - network.energy(u, v))

    return advance


METHOD = Method(
    name="damped",
    start=start,
    summary="matrix exponentials of the first-order form, one for each different interval between outputs",
    order="exact",
    conserves="momentum; energy kept and dissipated together",
    stability="unconditional; networks that are not stable are refused",
    cost="about 20 (2 n c)^3 for each different interval, (2 n c)^2 per output time; (2 n c)^2 memory",
    cannot="contacts that open, more than some thousand unknowns",
    damped=True,
    candidate=True,
    matrices=24,
    most_unknowns=MOST_UNKNOWNS,
)
