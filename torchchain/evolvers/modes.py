"""Exact evolution by superposing all normal modes (Eqs. 20-28)."""

from __future__ import annotations

from torch import Tensor

from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers.method import Advance, Method
from torchchain.modes.motion import change_basis, modal_motion
from torchchain.modes.spectrum import NormalModes, modes_of, normal_modes


def start(chain: Chain, state: State, modes: NormalModes | None = None) -> Advance:
    """See the registry entry below."""
    modes = normal_modes(chain) if modes is None else modes_of(chain, modes)
    motion, back = modal_motion(chain, state, modes), modes.shapes.mT

    def advance(times: Tensor) -> Trajectory:
        position, speed = motion(times)
        return Trajectory(times, change_basis(position, back), change_basis(speed, back))

    return advance


METHOD = Method(
    name="modes",
    start=start,
    summary="all normal modes by batched eigen-decomposition, then a sum over modes at each time",
    order="exact; the phase error grows as w t eps",
    conserves="energy of every mode",
    stability="unconditional",
    cost="N^3 once, N^2 per output time; N^2 memory",
    cannot="damping, Hertz contacts, chains of more than some thousand particles",
    candidate=True,
    matrices=8,
    options={"modes": "NormalModes of the chain, where they are at hand"},
)
