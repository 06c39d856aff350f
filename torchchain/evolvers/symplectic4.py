"""A fourth-order symplectic composition with a small error constant."""

from __future__ import annotations

from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.evolvers import symplectic
from torchchain.evolvers.method import Advance, Method

# The position extended Forest-Ruth-like algorithm of I. P. Omelyan, I. M. Mryglod and R. Folk, Comput. Phys. Commun.
# 146 (2002) 188-202. On these chains it is more accurate at equal cost than the other fourth-order compositions tried:
# Yoshida, Suzuki, and S6 and SRKN6b of S. Blanes and P. C. Moan, J. Comput. Appl. Math. 142 (2002) 313-330.
XI, LAMBDA, CHI = 0.1786178958448091, -0.2123418310626054, -0.06626458266981849

PEFRL = symplectic.Composition(
    opening=(XI, 0.5 - LAMBDA),
    middle=((CHI, LAMBDA), (1 - 2 * (CHI + XI), LAMBDA), (CHI, 0.5 - LAMBDA)),
    closing=(XI, 0.0),
    limit=2.98944,
    default=0.4,
)


def start(chain: Chain, state: State, step: float | None = None) -> Advance:
    """See the registry entry below."""
    return symplectic.start(chain, state, PEFRL, "symplectic4", step)


METHOD = Method(
    name="symplectic4",
    start=start,
    summary="the position extended Forest-Ruth-like composition (Omelyan, Mryglod and Folk 2002), four forces per step",
    order="4; the phase error of a mode grows as 6e-5 w^5 step^4 t",
    conserves="a nearby energy exactly, so that the energy of linear chains only swings; momentum",
    stability="w_max step < 2.98944, where the trace of its step on an oscillator first leaves [-2, 2]; "
    "Hertz contacts: w_max grows with the fourth root of the overlap, and the energy is watched",
    cost="four forces per step, N each; no memory beyond the states",
    cannot="damping (its negative substeps would amplify); order 4 once Hertz contacts open (it is about 2.5 then)",
    contacts=("linear", "hertz"),
    candidate=True,
    single_precision=True,
    compiled=True,
    traced=False,
    order_in_step=4,
    phase_error=6e-5,
    energy_error=3.4e-3,
    forces_per_step=4,
    stability_limit=PEFRL.limit,
    options={"step": "largest step; outputs are reached by equal steps of at most that (default 0.4 / w_max)"},
)
