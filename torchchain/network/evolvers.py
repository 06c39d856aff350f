"""Ways to move a network in time, one registry."""

from __future__ import annotations

from typing import Any

from torchchain import checks
from torchchain.chain import State
from torchchain.chain.states import Trajectory
from torchchain.evolvers.method import Advance, Method
from torchchain.network import chebyshev, damped, modal, verlet
from torchchain.network.networks import Network

METHODS: dict[str, Method] = {
    entry.name: entry for entry in (modal.METHOD, chebyshev.METHOD, verlet.METHOD, damped.METHOD)
}


def evolve(network: Network, state: State, times: Any, method: str = "modes", **options: Any) -> Trajectory:
    """States of the network at the given times.

    >>> import torch
    >>> from torchchain.chain import State
    >>> from torchchain.network import lattice
    >>> ring = lattice("triangular", (4, 4))
    >>> kick = torch.zeros(16, 2, dtype=torch.float64)
    >>> kick[0, 0] = 1.0
    >>> evolve(ring, State(torch.zeros_like(kick), kick), [0.0, 1.0], "chebyshev").velocity.shape
    torch.Size([2, 16, 2])

    Args:
        network: masses (*batch, particle).
        state: the start at time 0, (*batch, *any, particle, component).
        times: (time,), increasing, not negative.
        method: a name in ``METHODS``; each entry states its order, stability, cost and limits.
        options: the method's own.

    Returns:
        Trajectory with displacement and velocity (*batch, *any, time, particle, component).

    Raises:
        FieldError, FieldTypeError: for times, a method, an option or a network that the method cannot treat.
        UnstableError: for a network whose prestress makes it unstable.
    """
    return begin(network, state, method, **options)(checks.times("times", times).to(state.displacement.device))


def begin(network: Network, state: State, method: str, **options: Any) -> Advance:
    """The start of an evolution whose times come in windows.

    Args:
        network, state, method, options: as for :func:`evolve`.

    Returns:
        A function of increasing windows of times (time,), which gives their NetworkTrajectory.

    Example:
        >>> sheet = tc.lattice("triangular", (4, 4))
        >>> advance = tc.network.begin(sheet, tc.network.plane_wave(sheet, (1, 0)), "modes")
        >>> tuple(advance(torch.tensor([0.0, 1.0], dtype=torch.float64)).velocity.shape)
        (2, 16, 2)
    """
    checks.instance("network", network, Network)
    checks.instance("state", state, State)
    entry = METHODS[checks.choice("method", method, METHODS)]
    checks.known_keys(f"options of method '{method}'", options, entry.options)
    network.check_state(state.displacement)
    if network.is_damped and not entry.damped:
        others = ", ".join(name for name, m in METHODS.items() if m.damped)
        raise checks.fail("damping", f"be zero for method '{method}' (methods with damping: {others})", "more")
    return entry.start(network, state, **options)
