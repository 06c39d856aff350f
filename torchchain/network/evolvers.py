"""Ways to move a network in time, one registry."""

from __future__ import annotations

from typing import Any

from torchchain import checks
from torchchain.chain import State
from torchchain.evolvers.method import Advance, Method, chosen
from torchchain.network import chebyshev, damped, modal, verlet
from torchchain.network.networks import Network

METHODS: dict[str, Method] = {
    entry.name: entry for entry in (modal.METHOD, chebyshev.METHOD, verlet.METHOD, damped.METHOD)
}


def begin(network: Network, state: State, method: str, **options: Any) -> Advance:
    """The start of an evolution whose times come in windows.

    Args:
        network: masses (*batch, particle).
        state: the start at time 0, (*batch, *any, particle, component).
        method: a name in ``METHODS``; each entry states its order, stability, cost and limits.
        options: the method's own.

    Returns:
        A function of increasing windows of times (time,), which gives their NetworkTrajectory.

    Example:
        >>> sheet = tc.lattice("triangular", (4, 4))
        >>> advance = tc.network.begin(sheet, tc.network.plane_wave(sheet, (1, 0)), "modes")
        >>> tuple(advance(torch.tensor([0.0, 1.0], dtype=torch.float64)).velocity.shape)
        (2, 16, 2)
    """
    checks.instance("network", network, Network)
    entry = chosen(METHODS, network, state, method, options)
    network.check_state(state.displacement)
    return entry.start(network, state, **options)
