"""The methods that step in time by symplectic compositions: velocity Verlet and one of fourth order."""

from __future__ import annotations

from functools import partial

from torchchain.evolvers.method import Method
from torchchain.evolvers.symplectic import Composition, start

VERLET = Composition(opening=(0.0, 0.5), middle=(), closing=(1.0, 0.5), limit=2.0, default=0.1)

# The position extended Forest-Ruth-like algorithm of I. P. Omelyan, I. M. Mryglod and R. Folk, Comput. Phys. Commun.
# 146 (2002) 188-202. On these chains it is more accurate at equal cost than the other fourth-order compositions tried:
# Yoshida, Suzuki, and S6 and SRKN6b of S. Blanes and P. C. Moan, J. Comput. Appl. Math. 142 (2002) 313-330.
XI, LAMBDA, CHI = 0.1786178958448091, -0.2123418310626054, -0.06626458266981849

PEFRL = Composition(
    opening=(XI, 0.5 - LAMBDA),
    middle=((CHI, LAMBDA), (1 - 2 * (CHI + XI), LAMBDA), (CHI, 0.5 - LAMBDA)),
    closing=(XI, 0.0),
    limit=2.98944,
    default=0.4,
)

METHODS = (
    Method(
        name="verlet",
        start=partial(start, VERLET, "verlet"),
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
    ),
    Method(
        name="symplectic4",
        start=partial(start, PEFRL, "symplectic4"),
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
    ),
)
