"""Exact evolution of linear chains with contact damping: the quadratic eigenvalue problem of Eq. 14."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers.method import Advance, Method
from torchchain.modes import phase
from torchchain.modes.motion import align_modes, modal_amplitudes
from torchchain.modes.spectrum import NormalModes, normal_modes


class NearDefectiveWarning(UserWarning):
    """A chain so close to critical damping of a mode that its eigenvectors are too nearly parallel to be used."""


class PropagationError(RuntimeError):
    """A damped chain whose propagator gained energy."""


def generator(frequencies: Tensor, damping: Tensor) -> Tensor:
    """G of d/dt (w q, dq/dt) = G (w q, dq/dt) for modal amplitudes q, (*batch, 2 mode, 2 mode).

    In these variables the squared length is twice the energy, G is skew without damping and its symmetric part never
    positive with it, so that no state ever grows.

    Args:
        frequencies: w > 0 of the undamped modes, (*batch, mode).
        damping: the damping matrix between them, S^T D S, (*batch, mode, mode).
    """
    zero, w = torch.zeros_like(damping), torch.diag_embed(frequencies)
    return torch.cat([torch.cat([zero, w], dim=-1), torch.cat([-w, -damping], dim=-1)], dim=-2)


def undamped(chain: Chain) -> tuple[NormalModes, Tensor]:
    """Normal modes of the chain without its damping, and the :func:`generator` of all but the rigid motion of a ring."""
    modes = normal_modes(replace(chain, damping=0.0))
    rigid = int(chain.is_free)
    rate = chain.elongation(modes.shapes[..., rigid:].mT)
    return modes, generator(modes.frequencies[..., rigid:], rate @ (chain.contact_damping[..., :, None] * rate.mT))


def start(chain: Chain, state: State) -> Advance:
    """See the registry entry below."""
    modes, matrix = undamped(chain)
    rigid = int(chain.is_free)
    shapes, w = modes.shapes[..., rigid:], modes.frequencies[..., rigid:]
    n_modes = w.shape[-1]

    # The rigid motion of a periodic chain is undamped, and apart from the rest (Eq. 14's double eigenvalue 0).
    coordinate, speed = (z[..., None, :] for z in modal_amplitudes(chain, state, modes))
    frequency = chain.align(w, state.displacement)[..., None, :]
    initial = torch.cat([frequency * coordinate[..., rigid:], speed[..., rigid:]], dim=-1)
    shapes, rigid_shape = (align_modes(chain, s, state.displacement).mT for s in (shapes, modes.shapes[..., :rigid]))
    propagate = _propagator(matrix, initial.reshape(*matrix.shape[:-2], -1, 2 * n_modes))
    initial_energy = initial.square().sum(-1) / 2
    slack = 1 + torch.finfo(matrix.dtype).eps ** 0.5

    def advance(times: Tensor) -> Trajectory:
        phase.check(times, w, w.dtype)
        z = propagate(times.to(matrix)).reshape(*initial.shape[:-2], len(times), 2 * n_modes)
        energy = z.square().sum(-1) / 2
        where = checks.first(~(energy.detach() <= slack * initial_energy.detach()))
        if where is not None:
            raise PropagationError(
                f"a damped chain must not gain energy, got {energy[where].item():.6g} from "
                f"{initial_energy[where[:-1]].item():.6g} at time {times[where[-1]].item():g}{checks.position(where[:-1])}"
            )
        displacement = (z[..., :n_modes] / frequency) @ shapes
        velocity = z[..., n_modes:] @ shapes
        if rigid:
            t = times.to(matrix)[:, None]
            displacement = displacement + (coordinate[..., :1] + speed[..., :1] * t) @ rigid_shape
            velocity = velocity + speed[..., :1] @ rigid_shape
        return Trajectory(times, displacement, velocity, initial_energy - energy if chain.is_damped else None)

    return advance


def _propagator(matrix: Tensor, initial: Tensor) -> Callable[[Tensor], Tensor]:
    """exp(G t) y as a function of times (time,), from G (*batch, x, x) and y (*batch, member, x) to (*batch, member, time, x).

    By eigenvectors where these are well conditioned, by matrix exponentials for the rest of the batch.
    """
    batch, (members, size) = matrix.shape[:-2], initial.shape[-2:]
    matrix, initial = matrix.reshape(-1, size, size), initial.reshape(-1, members, size)
    values, vectors = torch.linalg.eig(matrix)
    inverse = torch.linalg.inv_ex(vectors)[0]
    with torch.no_grad():
        condition = torch.linalg.matrix_norm(vectors) * torch.linalg.matrix_norm(inverse) / size
        residual = torch.linalg.matrix_norm((vectors * values[:, None, :]) @ inverse - matrix)
        residual = residual / torch.linalg.matrix_norm(matrix)
        eps = torch.finfo(matrix.dtype).eps
        good = (condition < eps ** (-1 / 3)) & (residual < 40 * eps * size**0.5 * condition)
        if not bool(good.all()):
            shown = torch.where(good, 0, condition.nan_to_num(torch.inf))
            where = tuple(int(i) for i in (shown.reshape(batch) == shown.amax()).nonzero()[0])
            warnings.warn(
                f"eigenvectors of {int((~good).sum())} of {len(good)} damped chains are too nearly parallel, with condition "
                f"numbers up to {shown.amax().item():.1e}{checks.position(where)}: near critical damping of a mode these "
                "chains go by matrix exponentials from one output time to the next",
                NearDefectiveWarning,
                stacklevel=5,
            )
    if bool(good.all()):
        spectral, by_steps = _by_eigenvectors(values, vectors, inverse, initial), None
    else:
        spectral = _by_eigenvectors(values[good], vectors[good], inverse[good], initial[good])
        by_steps = by_exponentials(matrix[~good], initial[~good])

    def propagate(times: Tensor) -> Tensor:
        result = spectral(times)
        if by_steps is not None:
            merged = result.new_empty(len(good), *result.shape[1:])
            result = merged.index_put((good,), result).index_put((~good,), by_steps(times))
        return result.reshape(*batch, members, len(times), size)

    return propagate


def _by_eigenvectors(values: Tensor, vectors: Tensor, inverse: Tensor, initial: Tensor) -> Callable[[Tensor], Tensor]:
    """y(t) = Re V exp(L t) V^-1 y."""
    weights = (initial.to(inverse) @ inverse.mT)[:, :, None, :]
    real_parts = torch.cat([vectors.real, -vectors.imag], dim=-1).mT[:, None]

    def propagate(times: Tensor) -> Tensor:
        z = weights * torch.exp(values[:, None, None, :] * times[:, None])
        return torch.cat([z.real, z.imag], dim=-1) @ real_parts

    return propagate


def by_exponentials(matrix: Tensor, initial: Tensor) -> Callable[[Tensor], Tensor]:
    """One matrix exponential per interval of a new length, one product per output time."""
    now, y = 0.0, initial
    length, exponential = 0.0, torch.eye(matrix.shape[-1]).to(matrix).expand_as(matrix)

    def propagate(times: Tensor) -> Tensor:
        nonlocal now, y, length, exponential
        series = []
        for time in times.tolist():
            interval = time - now
            if abs(interval - length) > 1e-9 * interval:
                length, exponential = interval, torch.linalg.matrix_exp(matrix * interval)
            y = y @ exponential.mT
            # Equally spaced times differ by rounding; the first order makes up for it.
            y = y + (interval - length) * (y @ matrix.mT)
            series.append(y)
            now = time
        return torch.stack(series, dim=-2)

    return propagate


METHOD = Method(
    name="damped",
    start=start,
    summary="eigenvectors of the first-order form of Eq. 14 in the basis of the undamped modes; matrix exponentials "
    "where these vectors are nearly parallel",
    order="exact; the phase error grows as w t eps times the condition number of the eigenvectors, checked",
    conserves="momentum; never gains energy, which is checked",
    stability="unconditional",
    cost="25 (2N)^3 once, (2N)^2 per output time, members alike; (2N)^2 complex memory",
    cannot="Hertz contacts, chains of more than some hundred particles; derivatives at degenerate eigenvalues "
    "(the ordered chain)",
    damped=True,
    candidate=True,
    matrices=48,
    decomposition=(9.3e-7, 1.4e-8),
)
