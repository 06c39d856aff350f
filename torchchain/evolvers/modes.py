"""Exact evolution by superposing all normal modes (Eqs. 20-28)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers.method import Advance, Method
from torchchain.modes.motion import change_basis, modal_motion
from torchchain.modes.spectrum import NormalModes, modes_of, normal_modes


def start(chain: Chain, state: State, modes: NormalModes | None = None) -> Advance:
    """See the registry entry below."""
    modes = normal_modes(chain) if modes is None else modes_of(chain, modes)
    return superposed(chain, state, modes, Trajectory)


def superposed(system: Any, state: State, modes: Any, trajectory: type[Trajectory]) -> Advance:
    """The evolution of a chain or a network by its modes; its states in time are a kind of trajectory."""
    motion, batch = modal_motion(system, state, modes), len(system.batch_shape)
    back, unknowns = modes.shapes.flatten(batch, -2).mT, modes.shapes.shape[batch:-1]

    def advance(times: Tensor) -> Trajectory:
        position, speed = (change_basis(z, back).unflatten(-1, unknowns) for z in motion(times))
        return trajectory(times, position, speed)

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
