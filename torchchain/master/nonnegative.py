"""The fit of a model with memory whose energies are never negative: least squares under constraints that its proof finds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain import checks
from torchchain.master.certificate import CertificateError, Exponentials, certify, proof_edges
from torchchain.master.memory import MemoryModel, packed, poles_of
from torchchain.master.projection import Poles
from torchchain.master.proof import Certificate

ONSET = 4
"""Derivatives at t = 0, from the zeroth, that are exact: T(t) = I + O(t^4), as for a chain released from rest."""
MARGIN = 1e-3
"""A fitted energy stays above this share of its long-time value, so that the proof needs no fine intervals."""
ROUNDS = 60  # of fit and proof, at most
GRID = (12, 36)
"""Times in each of the proof's intervals where constraints are looked for, until the proof succeeds."""
CUTS = (1e-6, 1e-5, 3e-7, 3e-5)
"""Combinations of functions smaller than this share of the largest, in units of the error, are not fitted. With more of them
the fit is nearer, and to keep it from negative energies costs more: the first that works nearly as well as without, or the nearest."""
NEARLY = 1.1
"""Root mean square misfit that will do, over that of the fit that may be negative, which is there in any case."""
SLOWEST = 0.5
"""Decay rates are at least this over the last time: what is slower the data do not tell from what never decays."""
LATER = 0.1
"""Weight of times beyond the data, where a model is to go to Pi, relative to the last."""
EARLY_DECAY = (1.5,)
EARLY_PAIRS = ((0.4, 0.8), (0.7, 1.5), (1.0, 2.5), (1.5, 3.5), (2.0, 4.5))
"""Decay and frequency of functions for the first collisions: two waves beat at up to the sum of two frequencies, 4."""
LARGEST_AMPLITUDES = 1000.0
"""Of a fit, sum_m |A_m| of a pair of bands: above it rounding grows, and what is fitted is noise."""


@dataclass(frozen=True, eq=False)
class Space:
    """The functions of time that a fit combines: those of fixed poles that vanish at t = 0 with ONSET - 1 derivatives.

    Attributes:
        poles: theirs.
        start: coefficients of one function that is 1 at t = 0 and has no slope there, (function,).
        free: coefficients of functions orthonormal over the times of the fit, (function, direction).
    """

    poles: Poles
    start: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, poles: Poles, times: np.ndarray, weight: np.ndarray, cut: float) -> Space:
        """Directions whose weighted functions are below ``cut`` of the largest are left out."""
        zero = np.zeros(1)
        onset = np.concatenate([_functions(poles, zero, k) for k in range(ONSET)])
        onset /= np.linalg.norm(onset, axis=1, keepdims=True)
        first = np.zeros(ONSET)
        first[0] = 1 / np.linalg.norm(_functions(poles, zero))
        start = np.linalg.pinv(onset) @ first
        vanishing = np.linalg.svd(onset)[2][ONSET:].T
        functions = _functions(poles, times) * weight[:, None]
        _, scale, right = np.linalg.svd(functions @ vanishing, full_matrices=False)
        held = scale > cut * scale[0]
        return cls(poles, start, vanishing @ (right[held].T / scale[held]))


def _functions(poles: Poles, times: np.ndarray, derivative: int = 0) -> np.ndarray:
    """f_m or one of its derivatives, (time, function)."""
    values, single = np.exp(times[:, None] * poles.exponents) * poles.exponents**derivative, len(poles.decay)
    pairs = values[:, single:]
    pairs = np.stack([pairs.real, pairs.imag], axis=-1).reshape(len(times), -1)
    return np.concatenate([values[:, :single].real, pairs], axis=1)


def nonnegative(
    model: MemoryModel, times: Tensor, mean: Tensor | None = None, distance: Tensor | None = None
) -> tuple[MemoryModel, Certificate]:
    """The nearest model with the same poles whose energies are never negative, and which starts as exactly as a chain.

    Weighted least squares for the amplitudes under T(t) >= 0 at every t, T(t) = I + O(t^4) and row sums of 1: convex, by
    cutting planes. Each round adds the deepest negative energies to the constraints; the dual problem is one of
    nonnegative least squares (Lawson and Hanson 1974). Functions for the first collisions, EARLY_PAIRS, are added to the
    model's poles. Deterministic.

    Args:
        model: its poles, basis Pi and damping are kept.
        times: of the fit, (time,).
        mean: T that is fitted, [source, time, receiver]; None for the model's own.
        distance: expected total variation of two ensembles at each time, (time,), whose inverse is the weight of a time; None
            to count each time relative to how far energy has moved by then.

    Returns:
        The model and its certificate, which holds.

    Raises:
        CertificateError: if no such model was found, with the lowest energy of the best.
    """
    checks.instance("model", model, MemoryModel)
    times = checks.times("times", times).to(model.basis)
    with torch.no_grad():
        mean = model.transfer(times) if mean is None else checks.real_tensor("mean", mean).to(model.basis)
    basis = model.basis.clamp(min=0)
    conserves = bool(basis.any())
    basis = basis / basis.sum(-1, keepdim=True) if conserves else basis
    eye = torch.eye(len(basis), dtype=basis.dtype)
    if distance is None:
        distance = (mean - eye[:, None]).abs().sum(-1).mean(0) / 2
    spread = distance.double().numpy()
    weight = np.where(times.numpy() > 0, 1 / np.maximum(spread, 1e-5 * spread.max()), 0.0)
    # beyond the data nothing but Pi is known: without it slow functions would go anywhere there
    beyond = float(times[-1]) * np.geomspace(1.25, 100, 16)
    grid, weight = np.concatenate([times.numpy(), beyond]), np.concatenate([weight, np.full(16, LATER * weight[-1])])
    rest = torch.cat([mean - basis[:, None], torch.zeros(len(basis), 16, len(basis), dtype=basis.dtype)], dim=1).numpy()
    slowest = SLOWEST / float(times[-1])
    poles, early = poles_of(model), np.array(EARLY_PAIRS)
    poles = Poles(
        np.concatenate([np.maximum(poles.decay, slowest), EARLY_DECAY]),
        np.concatenate([np.maximum(poles.pair_decay, slowest), early[:, 0]]),
        np.concatenate([poles.pair_frequency, early[:, 1]]),
    )

    def built(amplitudes: np.ndarray) -> MemoryModel:
        return MemoryModel(rates=model.rates, damping=model.damping, **packed(basis, poles, amplitudes))

    weighted = _functions(poles, grid) * weight[:, None]
    wanted = rest.transpose(1, 0, 2).reshape(len(grid), -1) * weight[:, None]

    def misfit(amplitudes: np.ndarray) -> float:
        return float(np.linalg.norm(weighted @ amplitudes.reshape(len(amplitudes), -1) - wanted))

    failed: tuple[MemoryModel, Certificate] | None = None
    best: tuple[float, MemoryModel, Certificate] | None = None
    for cut in CUTS:
        space = Space.of(poles, grid, weight, cut)
        free = _least_squares(space, grid, weight, rest, (eye - basis).numpy())
        if float(np.abs(free).sum(0).max()) > LARGEST_AMPLITUDES:
            continue
        if conserves:
            _balance(free)
        edges, _ = proof_edges(Exponentials.of(built(free)))
        for points in GRID:
            try:
                found = built(_lifted(space, free, basis.numpy(), _refined(edges, points), conserves))
            except (RuntimeError, ValueError):  # nonnegative least squares did not end, or ended in no number
                continue
            certificate = certify(found)
            if certificate.holds:
                off = misfit(found.amplitudes.numpy())
                if best is None or off < best[0]:
                    best = off, found, certificate
                break
            if failed is None or certificate.lower > failed[1].lower:
                failed = found, certificate
        if best is not None and best[0] <= NEARLY * misfit(free):
            break
    if best is not None:
        return best[1:]
    lowest = -math.inf if failed is None else failed[1].lower
    raise CertificateError(f"model must have no negative energy, got {lowest:.3g} at best", failed)


def _least_squares(
    space: Space, times: np.ndarray, weight: np.ndarray, data: np.ndarray, at_zero: np.ndarray
) -> np.ndarray:
    """Amplitudes [function, source, receiver] nearest to the data [source, time, receiver]."""
    functions = _functions(space.poles, times)
    rest = data.transpose(1, 0, 2).reshape(len(times), -1) - np.outer(functions @ space.start, at_zero.ravel())
    best = np.linalg.lstsq(functions @ space.free * weight[:, None], rest * weight[:, None], rcond=None)[0]
    return (np.outer(space.start, at_zero.ravel()) + space.free @ best).reshape(-1, *at_zero.shape)


def _balance(amplitudes: np.ndarray) -> None:
    """Row sums of zero to the last digit, at the expense of each source's own band."""
    for _ in range(2):
        np.einsum("mss->ms", amplitudes)[...] -= amplitudes.sum(-1)


def _refined(edges: list[float], points: int) -> np.ndarray:
    """Times above 0, so many in each of the proof's intervals."""
    inside = [np.linspace(a, b, points, endpoint=False) for a, b in pairwise(edges)]
    return np.unique(np.concatenate([*inside, np.geomspace(1e-3, 1, 8 * points)]))[1:]


def _lifted(space: Space, amplitudes: np.ndarray, basis: np.ndarray, grid: np.ndarray, conserves: bool) -> np.ndarray:
    """Amplitudes nearest to the given ones with T >= 0 on a grid of times, by cutting planes.

    Every pair of different bands is a problem of its own: what it gains, the source's own band loses.
    """
    directions = np.concatenate([_functions(space.poles, grid), _functions(space.poles, np.zeros(1), ONSET)])
    level = np.concatenate([np.ones(len(grid)), [0.0]])
    result = amplitudes.copy()
    for source in range(len(basis)):
        energies = directions @ amplitudes[:, source] + np.outer(level, basis[source])
        # first energies are c t^4, with c of the fit, late ones Pi: half the harmonic mean of the two
        onset = np.minimum(np.abs(energies[-1]) / math.factorial(ONSET), basis[source])
        ratio = np.outer(grid**4, onset) / np.maximum(basis[source], 1e-300)
        margin = MARGIN * np.vstack([basis[source] * ratio / (1 + ratio), onset * math.factorial(ONSET)])
        for band in np.flatnonzero((energies < 0.5 * margin).any(0)):
            if band != source:
                push = _push(directions @ space.free, margin[:, band] - energies[:, band], margin[:, band])
                result[:, source, band] += space.free @ push
    if conserves:
        _balance(result)
    return result


def _push(directions: np.ndarray, short: np.ndarray, margin: np.ndarray) -> np.ndarray:
    """The smallest x with directions @ x >= short, (direction,), to half the margin."""
    cuts = np.zeros(0, dtype=int)
    push = np.zeros(directions.shape[1])
    for _ in range(ROUNDS):
        missing = short - directions @ push
        deepest = missing > 0.5 * margin
        deepest[1:-2] &= (missing[1:-2] >= missing[:-3]) & (missing[1:-2] >= missing[2:-1])
        new = np.flatnonzero(deepest)
        if not len(new):
            break
        cuts = np.union1d(cuts, new)
        # Lawson and Hanson's least distance programming
        rows = directions[cuts]
        size = np.linalg.norm(rows, axis=1)
        needed = short[cuts] / size
        scale = np.abs(needed).max()
        system = np.vstack([(rows / size[:, None]).T, needed / scale])
        target = np.zeros(len(system))
        target[-1] = 1.0
        multipliers, _ = scipy.optimize.nnls(system, target, maxiter=100 * len(cuts))
        rest = target - system @ multipliers
        if not rest[-1] > 0:  # the constraints contradict each other
            break
        push = scale * (system[:-1] @ multipliers) / rest[-1]
        cuts = cuts[multipliers > 0]
    return push
