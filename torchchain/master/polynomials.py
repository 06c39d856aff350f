"""The polynomials of Legendre of place, distance and time in the exponents of a model's odds, and the exponentials themselves."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchchain import checks

CLOCK = 10.0
"""t0 of the clock tau."""
LARGEST_EXPONENT = 60.0  # natural logarithm of a factor of the odds


def checked_degrees(degrees: Any) -> tuple[int, int, int]:
    """Degrees of the polynomials in place, distance and time."""
    if not isinstance(degrees, (tuple, list)) or len(degrees) != 3:
        raise checks.FieldTypeError(f"degrees must be three integers, got {checks.shown(degrees)}")
    place, distance, time = (checks.integer("degrees", degree, 1, 40) for degree in degrees)
    return place, distance, time


class Terms(NamedTuple):
    """The products of polynomials in p, by their degrees in (u, v, tau), and in q, by those in (s, tau).

    Those with i / I + j / J + k / K <= 1: a simplex, since what is fine in place is coarse in time.

    Attributes:
        heads: (i, j) of p, in order; those of q, in order, are 0 to I.
        held: which heads, those of p and then those of q, have a coefficient with a polynomial in tau, bool (term, degree);
            coefficients are in the order of its rows.
    """

    heads: tuple[tuple[int, int], ...]
    held: np.ndarray


@functools.lru_cache(maxsize=16)
def terms(degrees: tuple[int, int, int]) -> Terms:
    """Those of these degrees in place, distance and time."""
    place, distance, time = degrees
    found = {(i, j): i / place + j / distance for i in range(place + 1) for j in range(distance + 1)}
    found = {head: share for head, share in found.items() if share <= 1 + 1e-9}
    shares = np.array([*found.values(), *(i / place for i in range(place + 1))])
    return Terms(tuple(found), np.arange(time + 1) <= np.floor(time * (1 - shares) + 1e-9)[:, None])


def n_coefficients(degrees: Sequence[int]) -> int:
    """Fitted numbers of a model of these degrees; they do not depend on the number of bands."""
    return int(terms(checked_degrees(list(degrees))).held.sum())


def carried(coefficients: np.ndarray, degrees: tuple[int, int, int], others: tuple[int, int, int]) -> np.ndarray:
    """Coefficients of the same polynomials for other degrees: those of products that are new are 0."""
    before, now = (
        [([*each.heads, *range(place + 1)][row], k) for row, k in np.argwhere(each.held).tolist()]
        for place, each in ((degrees[0], terms(degrees)), (others[0], terms(others)))
    )
    known = dict(zip(before, coefficients.tolist(), strict=True))
    return np.array([known.get(entry, 0.0) for entry in now])


def clock_of(times: Tensor) -> Tensor:
    """tau, 0 at the start and 1 at infinity."""
    root = times.sqrt()
    return torch.where(times.isinf(), torch.ones_like(root), root / (root + math.sqrt(CLOCK)))


def polynomials(x: Tensor, degree: int) -> Tensor:
    """Legendre polynomials on [0, 1] of degree 0 to ``degree``, on a last axis of their own."""
    y = 2 * x - 1
    found = [torch.ones_like(y), y]
    for n in range(1, degree):
        found.append(((2 * n + 1) * y * found[-1] - n * found[-2]) / (n + 1))
    return torch.stack(found[: degree + 1], dim=-1)


def of_pairs(place: Tensor, distance: Tensor, degrees: tuple[int, int, int]) -> Tensor:
    """Products of polynomials of places and distances in [0, 1], on a last axis, (..., term)."""
    u, v = polynomials(place, degrees[0]), polynomials(distance, degrees[1])
    return torch.stack([u[..., i] * v[..., j] for i, j in terms(degrees).heads], dim=-1)


def shapes(distance: Tensor, degrees: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Polynomials of place and distance for each pair, [source, receiver, term], and of place, [source, 1, term].

    Args:
        distance: in [0, 1], [source, receiver].
        degrees: in place, distance and time.
    """
    n = len(distance)
    band = torch.arange(n, dtype=distance.dtype, device=distance.device) / max(n - 1, 1)
    return of_pairs((band[:, None] + band) / 2, distance, degrees), polynomials(band, degrees[0])[:, None]


def power(shape: Tensor, times: Tensor, coefficients: Tensor, held: np.ndarray) -> Tensor:
    """exp of the polynomials, [source, time, receiver], from shapes [source, receiver, term]; times may be infinite."""
    rows, columns = (torch.from_numpy(each).to(coefficients.device) for each in held.nonzero())
    table = coefficients.new_zeros(held.shape).index_put((rows, columns), coefficients)
    clock = polynomials(clock_of(times), held.shape[1] - 1)
    exponent = torch.einsum("srp,pt->str", shape, table @ clock.T)
    return exponent.clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT).exp()


def factors(
    parts: tuple[Tensor, Tensor], own: Tensor, times: Tensor, coefficients: Tensor, degrees: tuple[int, int, int]
) -> Tensor:
    """What the odds of each pair are multiplied by, exp(p), of a source's own band exp(q), [source, time, receiver].

    Args:
        parts: of :func:`shapes`.
        own: 1 for the source's own band, else 0, [source, 1, receiver].
        times: may be infinite, (time,).
        coefficients: of :func:`terms`, (term,).
        degrees: in place, distance and time.
    """
    heads, held = terms(degrees)
    count = int(held[: len(heads)].sum())
    between = power(parts[0], times, coefficients[:count], held[: len(heads)])
    return between * (1 - own) + power(parts[1], times, coefficients[count:], held[len(heads) :]) * own
