"""Exact evolution by superposing all normal modes (Eqs. 20-28)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchchain.chain import Chain
from torchchain.evolvers import phase
from torchchain.evolvers.method import Advance, Method, Trajectory
from torchchain.excitation import State
from torchchain.spectrum import NormalModes, modes_of, normal_modes


def modal_amplitudes(chain: Chain, state: State, modes: NormalModes) -> tuple[Tensor, Tensor]:
    """Displacement and velocity in the basis of the modes, each (*batch, *any, mode); S^-1 = S^T M (Eq. 18)."""
    masses = chain.align(chain.masses, state.displacement)
    return (
        change_basis(masses * state.displacement, modes.shapes),
        change_basis(masses * state.velocity, modes.shapes),
    )


def change_basis(field: Tensor, basis: Tensor) -> Tensor:
    """field @ basis, (*batch, *any, y), from a field (*batch, *any, x) and one basis (*batch, x, y) per chain.

    The axes between are rows of a single product: broadcasting would copy the basis for each of them.
    """
    batch = basis.shape[:-2]
    rows = field.reshape(*batch, -1, field.shape[-1])
    return (rows @ basis).reshape(*field.shape[:-1], basis.shape[-1])


def align_modes(chain: Chain, shapes: Tensor, field: Tensor) -> Tensor:
    """Mode shapes (*batch, particle, mode) with axes of length 1 where a ``field`` (*batch, *any, x) has more."""
    batch = len(chain.batch_shape)
    return shapes.reshape(*chain.batch_shape, *[1] * (field.ndim - batch - 1), *shapes.shape[-2:])


def modal_motion(chain: Chain, state: State, modes: NormalModes) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """From times to position and speed of every mode at each, (*batch, *any, time, mode) (Eq. 20).

    Times at which rounding has blurred the phases warn, and far beyond raise; see :func:`phase.check`.
    """
    displacement, velocity = (z[..., None, :] for z in modal_amplitudes(chain, state, modes))
    frequency = chain.align(modes.frequencies, state.displacement)[..., None, :]
    moves = state.velocity.requires_grad or bool((state.velocity != 0).any())
    displaced = state.displacement.requires_grad or bool((state.displacement != 0).any())

    def motion(times: Tensor) -> tuple[Tensor, Tensor]:
        t = times.to(state.displacement)[:, None]
        phase.check(times, modes.frequencies, torch.promote_types(frequency.dtype, t.dtype))
        angle = frequency * t
        cosine = angle.cos()
        position = speed = torch.zeros_like(displacement)
        if displaced:
            position = cosine * displacement
            speed = (-frequency * angle.sin()) * displacement
        if moves:
            # sin(w t) / w, which is t for the zero mode of a periodic chain (Eq. 21 divides by its w = 0)
            position = position + (t * torch.sinc(angle / math.pi)) * velocity
            speed = speed + cosine * velocity
        shape = torch.broadcast_shapes(position.shape, angle.shape)
        return position.expand(shape), speed.expand(shape)

    return motion


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
    options={"modes": "NormalModes of the chain, where they are at hand"},
)
