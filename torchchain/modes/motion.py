"""States in the basis of the normal modes, and their motion (Eqs. 18-21)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.modes import phase


def modal_amplitudes(system: Any, state: State, modes: Any) -> tuple[Tensor, Tensor]:
    """Displacement and velocity in the basis of the modes, each (*batch, *any, mode); S^-1 = S^T M (Eq. 18).

    Args:
        system: a chain, or a network.
        state: of it.
        modes: of it, with shapes (*batch, particle, mode), or (*batch, particle, component, mode) of a network.
    """
    batch, masses = len(system.batch_shape), system.align(system.masses, state.displacement)
    basis, first = modes.shapes.flatten(batch, -2), batch + 1 - modes.shapes.ndim
    displacement, velocity = ((masses * x).flatten(first) for x in (state.displacement, state.velocity))
    return change_basis(displacement, basis), change_basis(velocity, basis)


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


def _sinc(angle: Tensor) -> Tensor:
    """sin(x) / x, whose derivatives at 0 torch has of the first order only."""
    if not (angle.requires_grad or checks.is_transformed(angle)):
        return torch.sinc(angle / math.pi)
    rest = angle == 0
    elsewhere = torch.sinc(torch.where(rest, 1.0, angle) / math.pi)
    return torch.where(rest, 1 - angle.square() / 6, elsewhere)


def modal_motion(system: Any, state: State, modes: Any) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """From times to position and speed of every mode at each, (*batch, *any, time, mode) (Eq. 20).

    Takes what :func:`modal_amplitudes` does.

    Times at which rounding has blurred the phases warn, and far beyond raise; see :func:`phase.check`.
    """
    displacement, velocity = (z[..., None, :] for z in modal_amplitudes(system, state, modes))
    batch = system.batch_shape
    frequency = modes.frequencies.reshape(*batch, *[1] * (displacement.ndim - len(batch) - 1), displacement.shape[-1])
    displaced, moves = (
        field.requires_grad or checks.is_transformed(field) or checks.first(field != 0) is not None
        for field in (state.displacement, state.velocity)
    )

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
            position = position + (t * _sinc(angle)) * velocity
            speed = speed + cosine * velocity
        if not (displaced or moves):
            position = speed = position * angle  # at every time
        return position, speed

    return motion
