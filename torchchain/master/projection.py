"""Variable projection: a few decay rates and frequencies shared by all pairs of bands, and their amplitudes.

Golub and Pereyra, SIAM J. Numer. Anal. 10, 413 (1973), with the simplification of Kaufman, BIT 15, 49 (1975): for given
rates the best amplitudes are a linear problem, so that only the few rates are searched for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

SLOWEST, FASTEST = 1e-4, 6.0
"""Decay rates and frequencies, per unit time."""
SLOWEST_TURN = 1e-2  # frequency of a pair, per unit time
FEW_STEPS, MANY_STEPS = 40, 150
"""Of the search, from every start and from the best of what they found."""
RANDOM_STARTS = 3

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
    def exponents(self) -> np.ndarray:
        """-g of the exponentials and -g + i w of the pairs, complex."""
        return np.concatenate([-self.decay + 0j, -self.pair_decay + 1j * self.pair_frequency])

    @property
    def least(self) -> np.ndarray:
        """Lower bounds of the search, (parameter,)."""
        return np.concatenate([np.full(sum(self.order), SLOWEST), np.full(self.order[1], SLOWEST_TURN)])

    @property
    def logarithms(self) -> np.ndarray:
        """What is searched, within its bounds."""
        every = np.concatenate([self.decay, self.pair_decay, self.pair_frequency])
        return np.log(np.clip(every, self.least * 1.01, FASTEST / 1.01))

    @classmethod
    def of(cls, logarithms: np.ndarray, order: Order) -> Poles:
        return cls(*np.split(np.exp(logarithms), [order[0], sum(order)]))

    def functions(self, times: np.ndarray) -> np.ndarray:
        """f_m at each time, (time, function): the exponentials, then cosine and sine of every pair."""
        t = times[:, None]
        envelope, angle = np.exp(-self.pair_decay * t), self.pair_frequency * t
        pairs = np.stack([envelope * np.cos(angle), envelope * np.sin(angle)], axis=-1)
        return np.concatenate([np.exp(-self.decay * t), pairs.reshape(len(times), -1)], axis=1)

    def slopes(self, times: np.ndarray) -> np.ndarray:
        """t f_m at each time, (time, function), of which the derivatives to all rates and frequencies are made."""
        return times[:, None] * self.functions(times)


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
        found = scipy.optimize.least_squares(
            lambda p: self.amplitudes(Poles.of(p, order))[1].ravel(), poles.logarithms,
            jac=lambda p: self.jacobian(Poles.of(p, order)), bounds=(np.log(poles.least), np.log(FASTEST)),
            ftol=1e-6, xtol=1e-6, gtol=1e-12, max_nfev=steps,
        )  # fmt: skip
        return Poles.of(found.x, order), float(found.cost), bool(found.success)


def _at_start(order: Order) -> np.ndarray:
    """f_m(0)."""
    return np.concatenate([np.ones(order[0]), np.tile([1.0, 0.0], order[1])])


def _starts(order: Order, end: float) -> Iterator[Poles]:
    """Poles to start from: ladders of frequencies with as fast a decay and fast or slow exponentials, and random ones."""
    single, pairs = order
    for lowest, slow, fast in ((0.06, 0.3, 2.0), (0.02, 0.01, 1.0)):
        frequency = np.geomspace(lowest, 0.3, pairs)
        decay = np.geomspace(slow, fast, single) if single > 1 else np.array([fast / 2])
        yield Poles(decay, frequency, frequency)
    random = np.random.Generator(np.random.Philox(key=np.array(order, dtype=np.uint64)))
    for _ in range(RANDOM_STARTS):
        g = np.exp(random.uniform(np.log(max(2 * SLOWEST, 1 / end)), np.log(1.5), single + pairs))
        yield Poles(g[:single], g[single:], np.exp(random.uniform(np.log(0.03), 0.0, pairs)))


def search(
    problem: Projection, order: Order, near: Poles | None = None, progress: Callable[[int], Any] | None = None
) -> tuple[Poles, bool]:
    """The poles of an order with the least misfit: near those given, or from several starts; deterministic.

    Returns:
        The poles, and whether the last search ended by itself.
    """
    if near is None or near.order != order:
        tries = []
        for start in _starts(order, float(problem.times[-1])):
            tries.append(problem.polished(start, FEW_STEPS))
            if progress is not None:
                progress(1)
        near = min(tries, key=lambda found: found[1])[0]
    poles, _, ended = problem.polished(near, MANY_STEPS)
    return poles, ended
