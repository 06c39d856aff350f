"""Velocity Verlet: one force per step, any chain."""

from __future__ import annotations

from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.evolvers import symplectic
from torchchain.evolvers.method import Advance, Method

VERLET = symplectic.Composition(opening=(0.0, 0.5), middle=(), closing=(1.0, 0.5), limit=2.0, default=0.1)


def start(chain: Chain, state: State, step: float | None = None) -> Advance:
    """See the registry entry below."""
    return symplectic.start(chain, state, VERLET, "verlet", step)


METHOD = Method(
    name="verlet",
    start=start,
    summary="velocity Verlet (Swope et al. 1982); damping by the explicit midpoint rule for half a step before and after",
    order="2; the phase error of a mode grows as w^3 step^2 t / 24",
    conserves="a nearby energy exactly, so that the energy of linear chains only swings, by (w step)^2 / 4; momentum; "
    "kept and dissipated energy together when damped",
    stability="w_max step < 2, which also keeps linear damped chains from growing if M^-1 D step < 2; "
    "Hertz contacts: w_max grows with the fourth root of the overlap, and the energy is watched",
    cost="one force per step, N each; no memory beyond the states",
    cannot="keep phases: their error grows with time; order 2 once damped Hertz contacts open (it is 1 then)",
    contacts=("linear", "hertz"),
    candidate=True,
    single_precision=True,
    compiled=True,
    traced=False,
    order_in_step=2,
    phase_error=1 / 24,
    energy_error=1 / 4,
    forces_per_step=1,
    stability_limit=VERLET.limit,
    damped=True,
    options={"step": "largest step; outputs are reached by equal steps of at most that (default 0.1 / w_max)"},
)
