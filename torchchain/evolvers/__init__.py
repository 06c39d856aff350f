"""Ways to evolve a chain in time, one method a file, one registry."""

from __future__ import annotations

from typing import Any

from torchchain import checks
from torchchain.chain import amplitude, scaling
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers import chebyshev, compositions, damped, modes, ode, tridiagonal
from torchchain.evolvers.method import METHODS, Advance, Method, chosen, register_method

for _method in (
    modes.METHOD, tridiagonal.METHOD, chebyshev.METHOD, *compositions.METHODS, damped.METHOD, *ode.METHODS
):  # fmt: skip
    register_method(_method)

__all__ = ["METHODS", "Advance", "Method", "Trajectory", "evolve", "register_method", "start"]


def evolve(chain: Chain, state: State, times: Any, method: str = "modes", **options: Any) -> Trajectory:
    """What :func:`torchchain.evolve` is for chains; its warnings name the line that has called that."""
    advance = start(chain, state, method, **options)
    amplitude.warn_if_nonlinear(chain, state, amplitude.DEVIATION_WHERE_OPEN, stacklevel=4)
    scaling.warn_if_unscaled(chain, stacklevel=4)
    return advance(checks.times("times", times).to(state.displacement.device))


def start(chain: Chain, state: State, method: str, **options: Any) -> Advance:
    """The start of an evolution whose times come in windows; see :class:`Method`."""
    checks.instance("chain", chain, Chain)
    entry = chosen(METHODS, chain, state, method, options)
    n = chain.n_particles
    if state.displacement.shape[-1] != n:
        raise checks.fail("state", f"have {n} particles like the chain", state.displacement)
    chain.align(chain.masses, state.displacement)
    if chain.boundary not in entry.boundaries:
        raise checks.fail("boundary", f"be {' or '.join(entry.boundaries)} for method '{method}'", repr(chain.boundary))
    if chain.contact not in entry.contacts:
        raise checks.fail("contact", f"be {' or '.join(entry.contacts)} for method '{method}'", repr(chain.contact))
    traced = (chain.masses, chain.contact_stiffness, chain.contact_damping, state.displacement, state.velocity)
    if not entry.traced and any(checks.is_transformed(values) for values in traced):
        raise checks.fail(
            "method", "be 'modes' or 'chebyshev' under torch.func (backward() goes through others)", method
        )
    return entry.start(chain, state, **options)
