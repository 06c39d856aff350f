"""Normal equations of the logistic regressions, without forming a derivative by every coefficient.

With the share T[s, r](t) of source s in band r, all that is fitted is in the exponents of its odds,

    p(s, r, t) = sum_ak c_ak x_sr,a P_k(tau(t)),    x_sr,a = e_s L_i(u) L_j(v),    a = (i, j),

and, of what stays, q(s, t) = sum_bk c_bk y_s,b P_k(tau(t)). As shares depend on p - q alone, the derivatives of T by the
coefficients of one P_k are

    f_sr (x_sr, -y_s) - F_sr m_s,    m_s = sum_r f_sr (x_sr, -y_s),

with F = T and f the part of it that is in the exponent's odds. In sums of products of two of them over s and r, products of
Legendre polynomials are sums of single ones of up to twice their degrees, which are fewer by far than the products: so much
for the largest part; the others have s alone in common.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from torchchain.master.polynomials import terms


@dataclass(frozen=True, eq=False)
class Products:
    """What products of polynomials of given degrees are made of; they depend on the degrees alone.

    Attributes:
        doubled: (i, j) of the single polynomials that products of two terms of p are sums of, (single, 2).
        sums: how much of each is in which product, (single, pair), pairs being those of the upper triangle.
        index: where in a (pair, pair of P_k) table the matrix (coefficient, coefficient) has its entries.
    """

    doubled: np.ndarray
    sums: np.ndarray
    index: np.ndarray


@functools.lru_cache(maxsize=16)
def products(degrees: tuple[int, int, int]) -> Products:
    """The products of polynomials of these degrees in place, distance and time."""
    heads, held = terms(degrees)
    place, distance = np.array(heads).T
    one, two = np.triu_indices(len(heads))
    of_place = _linear(degrees[0])[place[one], place[two]]
    whole = np.einsum("pk,pl->pkl", of_place, _linear(degrees[1])[distance[one], distance[two]])
    doubled = np.argwhere((whole != 0).any(0))
    # p with p in its upper triangle, p with q, q with q in its upper triangle
    size, first = len(held), len(heads)
    last = size - first
    pair = np.empty((size, size), dtype=np.int64)
    pair[:first, :first] = _triangle(first)
    pair[:first, first:] = len(one) + np.arange(first * last).reshape(first, last)
    pair[first:, :first] = pair[:first, first:].T
    pair[first:, first:] = len(one) + first * last + _triangle(last)
    term, time = held.nonzero()
    times = _triangle(held.shape[1])
    index = pair[term[:, None], term] * (times.max() + 1) + times[time[:, None], time]
    return Products(doubled, np.ascontiguousarray(whole[:, doubled[:, 0], doubled[:, 1]].T), index)


def _triangle(size: int) -> np.ndarray:
    """The number of each pair in the upper triangle, (size, size), either way."""
    number = np.empty((size, size), dtype=np.int64)
    one, two = np.triu_indices(size)
    number[one, two] = number[two, one] = np.arange(len(one))
    return number


def _linear(degree: int) -> np.ndarray:
    """L_i L_j as sums of L_k, (i, j, k): 0 but for k = |i - j|, |i - j| + 2, ..., i + j."""
    x, weight = legendre.leggauss(2 * degree + 1)
    values = legendre.legvander(x, 2 * degree)
    found = np.einsum("xi,xj,xk,x->ijk", values[:, : degree + 1], values[:, : degree + 1], values, weight)
    i, j, k = np.indices(found.shape)
    found[((i + j + k) % 2 == 1) | (k > i + j) | (k < abs(i - j))] = 0
    return found * (np.arange(2 * degree + 1) + 0.5)


def _paired(columns: np.ndarray) -> np.ndarray:
    """Products of two columns, of the upper triangle, (row, pair)."""
    one, two = np.triu_indices(columns.shape[1])
    return columns[:, one] * columns[:, two]


class Equations:
    """The normal equations of regressions that share their polynomials.

    Args:
        between: x, (source, band, term); where the band has no odds of its own, anything.
        own: y, (source, term).
        clock: P_k of the times, (time, degree).
        degrees: in place, distance and time.
    """

    def __init__(self, between: np.ndarray, own: np.ndarray, clock: np.ndarray, degrees: Sequence[int]) -> None:
        place, distance, time = degrees
        self._products = products((place, distance, time))
        self._between, self._own, self._clock = between, own, clock
        heads, self._held = terms((place, distance, time))
        size = between[..., heads.index((0, 0))]  # e
        u, v = (between[..., heads.index(head)] / size for head in ((1, 0), (0, 1)))
        i, j = self._products.doubled.T
        single = legendre.legvander(u, 2 * place)[..., i] * legendre.legvander(v, 2 * distance)[..., j]
        self._single = (single * (size**2)[..., None]).reshape(-1, len(i))
        self._pairs_of_own, self._pairs_of_times = _paired(own), _paired(clock)

    def matrix(self, odds: np.ndarray, shares: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Sum of products of two derivatives, weighted, (coefficient, coefficient).

        Args:
            odds, shares: f and F, (source, time, band).
            weight: (source, time).
        """
        one, two = np.triu_indices(self._between.shape[-1])
        heavy, times = weight[..., None] ** 2 * odds, odds.shape[1]
        d, e = heavy * odds, heavy * shares
        whole = ((weight[..., None] * shares) ** 2).sum(-1)
        sums = np.matmul(np.concatenate([odds, d, e], axis=1), self._between)
        mean, near, far = sums[:, :times], sums[:, times : 2 * times], sums[:, 2 * times :]
        moved, all_d, all_e = odds.sum(-1), d.sum(-1), e.sum(-1)
        upper = d.transpose(1, 0, 2).reshape(times, -1) @ self._single @ self._products.sums
        twice = np.matmul((far - whole[..., None] / 2 * mean).transpose(1, 2, 0), mean.transpose(1, 0, 2))
        upper -= (twice + twice.transpose(0, 2, 1))[:, one, two]
        mixed = near - moved[..., None] * far - (all_e - moved * whole)[..., None] * mean
        mixed = -np.matmul(mixed.transpose(1, 2, 0), self._own).reshape(times, -1)
        lower = (all_d - 2 * moved * all_e + moved**2 * whole).T @ self._pairs_of_own
        table = np.concatenate([upper, mixed, lower], axis=1).T @ self._pairs_of_times
        return table.ravel()[self._products.index]

    def pull(self, odds: np.ndarray, shares: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Sum of derivatives times a force, (..., coefficient).

        Args:
            odds, shares: f and F, (source, time, band).
            force: of each share, (..., source, time, band).
        """
        mean, moved = np.matmul(odds, self._between), odds.sum(-1)
        forced = force * odds
        total = (force * shares).sum(-1)  # (..., source, time)
        rows = np.moveaxis(forced, -2, -3).reshape(*force.shape[:-3], force.shape[-2], -1)
        first = rows @ self._between.reshape(-1, self._between.shape[-1])
        first -= np.einsum("...st,stp->...tp", total, mean)
        second = -np.swapaxes(forced.sum(-1) - total * moved, -1, -2) @ self._own
        table = np.swapaxes(np.concatenate([first, second], axis=-1), -1, -2) @ self._clock
        return table[..., self._held]
