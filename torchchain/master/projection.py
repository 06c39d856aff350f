"""Variable projection: a few decay rates and frequencies shared by all pairs of bands, and their amplitudes.

Golub and Pereyra, SIAM J. Numer. Anal. 10, 413 (1973), with the simplification of Kaufman, BIT 15, 49 (1975): for given
rates the best amplitudes are a linear problem, so that only the few rates are searched for. The search grows function
by function: the best one of a grid is added to those found, then all are polished together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import optimize

SLOWEST, FASTEST = 1e-4, 6.0
"""Decay rates and frequencies, per unit time."""
SLOWEST_TURN = 1e-2
FEW_STEPS, MANY_STEPS = 15, 150
"""Of the search, after a function was added and at the end."""

Order = tuple[int, int]
"""Numbers of exponentials and of pairs."""


@dataclass(frozen=True, eq=False)
class Poles:
    """g of the exponentials, g and w of the pairs exp(-g t) cos(w t), exp(-g t) sin(w t), per unit time."""

    decay: np.ndarray
    pair_decay: np.ndarray
    pair_frequency: np.ndarray

    @property
    def order(self) -> Order:
        return len(self.decay), len(self.pair_decay)

    @property
    def logarithms(self) -> np.ndarray:
        """What is searched, within its bounds."""
        low = np.concatenate([np.full(sum(self.order), SLOWEST), np.full(self.order[1], SLOWEST_TURN)])
        every = np.concatenate([self.decay, self.pair_decay, self.pair_frequency])
        return np.log(np.clip(every, low * 1.01, FASTEST / 1.01))

    @classmethod
    def of(cls, logarithms: np.ndarray, order: Order) -> Poles:
        return cls(*np.split(np.exp(logarithms), [order[0], sum(order)]))

    def with_exponential(self, g: float) -> Poles:
        return Poles(np.append(self.decay, g), self.pair_decay, self.pair_frequency)

    def with_pair(self, g: float, w: float) -> Poles:
        return Poles(self.decay, np.append(self.pair_decay, g), np.append(self.pair_frequency, w))

    def functions(self, times: np.ndarray) -> np.ndarray:
        """f_m at each time, (time, function): the exponentials, then cosine and sine of every pair."""
        t = times[:, None]
        envelope, angle = np.exp(-self.pair_decay * t), self.pair_frequency * t
        pairs = np.stack([envelope * np.cos(angle), envelope * np.sin(angle)], axis=-1)
        return np.concatenate([np.exp(-self.decay * t), pairs.reshape(len(times), -1)], axis=1)

    def slopes(self, times: np.ndarray) -> np.ndarray:
        """t f_m at each time, (time, function), of which the derivatives to all rates and frequencies are sums."""
        return times[:, None] * self.functions(times)


NO_POLES = Poles(np.empty(0), np.empty(0), np.empty(0))


@dataclass(frozen=True, eq=False)
class Projection:
    """Energies beyond what stays, D(t) = sum_m A_m f_m(t), with sum_m A_m f_m(0) = D(0) held exactly.

    Attributes:
        times: (time,).
        data: D, (row, entry).
        at_zero: D(0) = I - Pi, (entry,).
        rows: combinations of times of which the data are the values, (row, time); None for the times themselves.
    """

    times: np.ndarray
    data: np.ndarray
    at_zero: np.ndarray
    rows: np.ndarray | None = None

    def _seen(self, functions: np.ndarray) -> np.ndarray:
        return functions if self.rows is None else self.rows @ functions

    def amplitudes(self, poles: Poles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Best amplitudes (function, entry), the misfit (row, entry), and an orthonormal basis of what is free."""
        functions, start = self._seen(poles.functions(self.times)), _at_start(poles.order)
        free = functions[:, 1:] - functions[:, :1] * start[1:]  # the first function takes up the constraint
        rest = self.data - functions[:, :1] * self.at_zero
        if free.shape[1] == 0:
            return self.at_zero[None], rest, free
        left, scale, right = np.linalg.svd(free, full_matrices=False)
        held = scale > 1e-6 * scale[0]
        left = left[:, held]
        part = left.T @ rest
        best = (right[held].T / scale[held]) @ part
        return np.vstack([self.at_zero - start[1:] @ best, best]), rest - left @ part, left

    def jacobian(self, poles: Poles) -> np.ndarray:
        """Derivative of the misfit to the logarithms of rates and frequencies, (misfit, parameter)."""
        a, _, left = self.amplitudes(poles)
        f = self._seen(poles.slopes(self.times))
        f = f - left @ (left.T @ f)
        single, pairs = poles.order
        columns = [-g * f[:, i, None] * a[i] for i, g in enumerate(poles.decay)]
        turns = []
        for j in range(pairs):
            c, s = single + 2 * j, single + 2 * j + 1
            columns.append(-poles.pair_decay[j] * (f[:, c, None] * a[c] + f[:, s, None] * a[s]))
            turns.append(poles.pair_frequency[j] * (f[:, c, None] * a[s] - f[:, s, None] * a[c]))
        return -np.stack([column.ravel() for column in (*columns, *turns)], axis=1)

    def polished(self, poles: Poles, steps: int) -> tuple[Poles, float, bool]:
        """The poles of the least misfit nearby, half its square, and whether the search ended by itself."""
        order = poles.order
        low = np.log(np.concatenate([np.full(sum(order), SLOWEST), np.full(order[1], SLOWEST_TURN)]))
        found = optimize.least_squares(
            lambda p: self.amplitudes(Poles.of(p, order))[1].ravel(), poles.logarithms,
            jac=lambda p: self.jacobian(Poles.of(p, order)), bounds=(low, np.log(FASTEST)),
            ftol=1e-6, xtol=1e-6, gtol=1e-12, max_nfev=steps,
        )  # fmt: skip
        return Poles.of(found.x, order), float(found.cost), bool(found.success)

    def grown(self, poles: Poles, order: Order) -> list[Poles]:
        """The poles with one more function of each sort that the order lacks, the best of a grid."""
        single, pairs = order[0] - len(poles.decay), order[1] - len(poles.pair_decay)
        if not len(poles.decay):
            g = min(self._decays, key=lambda g: float(np.square(self.amplitudes(poles.with_exponential(g))[1]).sum()))
            return [poles.with_exponential(g)]
        first = self._seen(poles.functions(self.times))[:, :1]
        _, rest, left = self.amplitudes(poles)

        def gain(columns: np.ndarray) -> np.ndarray:
            """Squared misfit explained by each group of functions, from (row, group, member)."""
            columns = columns - (left @ (left.T @ columns.reshape(len(columns), -1))).reshape(columns.shape)
            product = np.einsum("tgm,tgn->gmn", columns, columns)
            size = np.trace(product, axis1=1, axis2=2)[:, None, None]
            part = np.einsum("tgm,te->gme", columns, rest, optimize=True)
            best = np.linalg.solve(product + 1e-9 * size * np.eye(product.shape[-1]), part)
            return np.sum(part * best, axis=(1, 2))

        found = []
        if single > 0:
            found.append(poles.with_exponential(self._decays[int(gain(self._exponentials - first[:, :, None]).argmax())]))
        if pairs > 0:
            turning = self._turning - first[:, :, None] * np.array([1.0, 0.0])
            for place in _peaks(gain(turning).reshape(len(self._decays), -1))[:3]:
                found.append(poles.with_pair(self._decays[place[0]], self._frequencies[place[1]]))
        return found

    @cached_property
    def _decays(self) -> np.ndarray:
        return np.geomspace(max(2 * SLOWEST, 1 / self.times[-1]), 2.0, 14)

    @cached_property
    def _frequencies(self) -> np.ndarray:
        return np.geomspace(0.03, 1.5, 18)

    @cached_property
    def _exponentials(self) -> np.ndarray:
        """(row, exponential, 1)."""
        return self._seen(np.exp(-np.outer(self.times, self._decays)))[:, :, None]

    @cached_property
    def _turning(self) -> np.ndarray:
        """Cosine and sine of every decay rate and frequency, (row, pair, 2)."""
        g, w = (x.ravel() for x in np.meshgrid(self._decays, self._frequencies, indexing="ij"))
        both = Poles(np.empty(0), g, w).functions(self.times)
        return self._seen(both).reshape(-1, len(g), 2)


def _at_start(order: Order) -> np.ndarray:
    """f_m(0)."""
    return np.concatenate([np.ones(order[0]), np.tile([1.0, 0.0], order[1])])


def _peaks(values: np.ndarray) -> list[tuple[int, int]]:
    """Places of the values that no neighbor exceeds, the largest first."""
    around = np.pad(values, 1, constant_values=-np.inf)
    near = np.max([np.roll(around, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)[1:-1, 1:-1]
    places = np.argwhere(values >= near)
    return sorted(((int(i), int(j)) for i, j in places), key=lambda place: -values[place])


def search(problem: Projection, order: Order, near: Poles = NO_POLES, progress: Callable[[int], Any] | None = None) -> tuple[Poles, bool]:
    """The poles of an order: those nearby polished, or grown function by function from them; deterministic.

    Returns:
        The poles, and whether the last search ended by itself.
    """
    poles = near
    while poles.order != order:
        tries = [problem.polished(other, FEW_STEPS) for other in problem.grown(poles, order)]
        poles = min(tries, key=lambda found: found[1])[0]
        if progress is not None:
            progress(1)
    poles, _, ended = problem.polished(poles, MANY_STEPS)
    return poles, ended
