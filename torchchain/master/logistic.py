"""The fit of the compact model: a logistic regression on all times at once, by Levenberg's and Marquardt's method."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchchain.master.compact import CompactModel
from torchchain.master.normal import Equations
from torchchain.master.polynomials import (
    LARGEST_EXPONENT,
    carried,
    checked_degrees,
    clock_of,
    polynomials,
    shapes,
    terms,
)
from torchchain.master.waves import Waves, all_odds
from torchchain.threads import kept_property

RIDGE = 1.0
"""Against coefficients that the data do not tell, which would run away between the strengths of a family."""
FIT_TIMES = 48  # times, at most, that are fitted
BEYOND = (1.5, 2.5, 5.0, 10.0, 30.0, 100.0, 1000.0)
"""Times after the last, in units of it, at which what has not settled is to have come nearer to Pi."""
STEPS = 60  # of Gauss and Newton, at most
FIRST_DAMPING = 1e-4
"""Of the method's first step: from zero coefficients, too, steps of Gauss and Newton lead down."""


@dataclass(frozen=True, eq=False)
class Regression:
    """One logistic regression: data, weights and everything that does not change while its coefficients do.

    Attributes:
        odds: first odds D with 1 for the own band, [source, time, receiver].
        shape: polynomials of place and distance, of a source's own band last, [source, receiver, term].
        clock: polynomials of time, (time, degree).
        degrees: in place, distance and time.
        data: T, [source, time, receiver].
        weight: of each source and time, [source, time], the inverse of its error.
    """

    odds: np.ndarray
    shape: np.ndarray
    clock: np.ndarray
    degrees: tuple[int, int, int]
    data: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(
        cls, waves: Waves, degrees: tuple[int, int, int], times: Tensor, data: Tensor, weight: np.ndarray
    ) -> Regression:
        odds, _ = all_odds(waves, times, torch.arange(len(waves.source_frequency)))
        return cls.of_odds(odds, shapes(waves.distances, degrees), degrees, times, data, weight)

    @classmethod
    def of_odds(
        cls, odds: Tensor, parts: tuple[Tensor, Tensor], degrees: tuple[int, int, int], times: Tensor, data: Tensor,
        weight: np.ndarray, **more: Any,
    ) -> Self:  # fmt: skip
        """From first odds [source, time, receiver] and the polynomials of pairs and of the own band, as of ``shapes``.

        ``more`` is what a class of regressions knows beyond them.
        """
        first, own = parts
        eye = torch.eye(len(odds), dtype=torch.float64)
        shape = torch.cat([first * (1 - eye)[..., None], own * eye[..., None]], dim=-1)
        clock = polynomials(clock_of(times), degrees[2])
        weight = np.broadcast_to(weight, data.shape[:2])
        return cls(odds.numpy(), shape.numpy(), clock.numpy(), degrees, data.numpy(), weight, **more)

    @property
    def held(self) -> np.ndarray:
        """Which products of shapes and clock are coefficients, bool (term, degree)."""
        return terms(self.degrees).held

    @kept_property
    def equations(self) -> Equations:
        """The linearized problem."""
        size, bands = len(terms(self.degrees).heads), np.arange(len(self.odds))
        between = self.shape[..., :size].copy()
        between[bands, bands, 0] = 1.0  # any: what stays has odds of another kind
        return Equations(between, self.shape[bands, bands, size:], self.clock, self.degrees)

    def _multiplied(self, coefficients: np.ndarray) -> np.ndarray:
        """The odds times their exponentials, [source, time, receiver], for coefficients as a (term, degree) table."""
        exponent = np.clip(self.shape @ (coefficients @ self.clock.T), -LARGEST_EXPONENT, LARGEST_EXPONENT)
        return self.odds * np.exp(exponent).transpose(0, 2, 1)

    def predicted(self, coefficients: np.ndarray) -> np.ndarray:
        """T [source, time, receiver] for coefficients as a (term, degree) table."""
        moved = self._multiplied(coefficients)
        return moved / moved.sum(-1, keepdims=True)

    def misfit(self, coefficients: np.ndarray) -> tuple[float, np.ndarray]:
        """Weighted sum of squares with the ridge, and what was predicted."""
        found = self.predicted(coefficients)
        missed = (self._bands(found) - self.data) * self.weight[..., None]
        return float((missed**2).sum() + RIDGE * (coefficients**2).sum()), found

    def normal(self, found: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and right-hand side of the linearized problem, over the coefficients that are held."""
        bands = self._bands(found)
        matrix = self.equations.matrix(self._moved(found), bands, self.weight)
        matrix.flat[:: len(matrix) + 1] += RIDGE
        return matrix, self.pull(found, self.data - bands) - RIDGE * coefficients[self.held]

    def pull(self, found: np.ndarray, missed: np.ndarray) -> np.ndarray:
        """Right-hand side of what is missed, (..., source, time, receiver), over the coefficients that are held."""
        return self.equations.pull(self._moved(found), self._bands(found), missed * self.weight[..., None] ** 2)

    def _bands(self, found: np.ndarray) -> np.ndarray:
        """What of the predicted shares is in each band, [source, time, receiver]."""
        return found

    def _moved(self, found: np.ndarray) -> np.ndarray:
        """What has left its source's own band, or tone."""
        moved, bands = found.copy(), np.arange(len(found))
        moved[bands, :, bands] = 0.0
        return moved

    @property
    def size(self) -> int:
        """Coefficients."""
        return int(self.held.sum())

    def guided(self, guide: np.ndarray) -> Regression:
        """The regression for what is to be added to known coefficients, which are multiplied into its odds."""
        return replace(self, odds=self._multiplied(self.table(guide)))

    def table(self, held: np.ndarray) -> np.ndarray:
        """Coefficients as a table, zeros where none is."""
        table = np.zeros(self.held.shape)
        table[self.held] = held
        return table


def solve(
    regressions: Sequence[Any], mixing: np.ndarray, start: np.ndarray | None = None, progress: Any = None,
    stiffness: np.ndarray | None = None,
) -> tuple[np.ndarray, dict[str, Any]]:  # fmt: skip
    """Levenberg's and Marquardt's method for several regressions whose coefficients are mixtures of common ones.

    Args:
        regressions: of the same degrees, each a :class:`Regression` or like one.
        mixing: weight of each of the common sets of coefficients in each regression, (regression, set).
        start: (set, coefficient); zero if None, and where it leads nowhere.
        progress: called with 1 after each step.
        stiffness: against each of the sets, (set,), beside the ridge; none if None.

    Returns:
        (set, coefficient), and a report: converged, steps, misfit in units of the error.
    """
    sets, size = mixing.shape[1], regressions[0].size
    found = np.zeros((sets, size)) if start is None else start.copy()
    stiff = (np.zeros(sets) if stiffness is None else stiffness)[:, None]

    def misfits(found: np.ndarray) -> tuple[float, list[np.ndarray]]:
        each = [r.misfit(r.table(c)) for r, c in zip(regressions, mixing @ found, strict=True)]
        bent = float((stiff * found**2).sum())
        return bent + sum(value for value, _ in each), [predicted for _, predicted in each]

    now, predicted = misfits(found)
    damping, converged, steps = FIRST_DAMPING, False, 0
    while steps < STEPS:
        steps += 1
        square, pull = _joint(regressions, mixing, found, predicted, stiff)
        diagonal = square.diagonal().copy()
        better = math.inf
        while damping < 1e12:
            square.flat[:: len(square) + 1] = diagonal * (1 + damping) + 1e-12
            moved = found + np.linalg.solve(square, pull.ravel()).reshape(sets, size)
            better, ahead = misfits(moved)
            if better < now:
                break
            damping *= 8
        if progress is not None:
            progress(1)
        if not better < now:
            converged = True  # no step leads further down
            break
        gained, now, found, predicted = now - better, better, moved, ahead
        damping = max(damping / 8, 1e-9)
        if gained < 1e-3 * now:
            converged = True
            break
    if (
        start is not None and now > misfits(np.zeros_like(found))[0]
    ):  # lost: exponents so large that nothing changes with them
        return solve(regressions, mixing, None, progress, stiffness)
    count = sum(r.data.size for r in regressions)
    return found, {"converged": converged, "steps": steps, "misfit": math.sqrt(now / count)}


def _joint(
    regressions: Sequence[Regression],
    mixing: np.ndarray,
    found: np.ndarray,
    predicted: Sequence[np.ndarray],
    stiff: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and right-hand side, (set, coefficient), of the linearized problem of all regressions."""
    sets, size = found.shape
    matrix, pull = np.zeros((sets, size, sets, size)), np.zeros((sets, size))
    for r, c, p, m in zip(regressions, mixing @ found, predicted, mixing, strict=True):
        part, force = r.normal(p, r.table(c))
        matrix += m[:, None, None, None] * m[None, None, :, None] * part[None, :, None, :]
        pull += np.outer(m, force)
    square = matrix.reshape(sets * size, -1)
    square.flat[:: len(square) + 1] += np.broadcast_to(stiff, found.shape).ravel()
    return square, pull - stiff * found


def stepped(
    regressions: Sequence[Regression], mixing: np.ndarray, found: np.ndarray, drawn: Sequence[np.ndarray],
    stiffness: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Coefficients for other data like the regressions', by one step of Gauss and Newton each, for error bars.

    Args:
        regressions, mixing: see :func:`solve`.
        found: its solution, (set, coefficient).
        drawn: for each regression T at its times of ensembles drawn again, [replica, source, time, receiver].

    Returns:
        (replica, set, coefficient).
    """
    predicted = [r.predicted(r.table(c)) for r, c in zip(regressions, mixing @ found, strict=True)]
    stiff = (np.zeros(len(found)) if stiffness is None else stiffness)[:, None]
    square, rest = _joint(regressions, mixing, found, predicted, stiff)
    pulls = np.repeat(rest[None], len(drawn[0]), axis=0)
    for r, p, m, data in zip(regressions, predicted, mixing, drawn, strict=True):
        pulls += m[:, None] * r.pull(p, data - r.data)[:, None]
    return found + np.linalg.solve(square, pulls.reshape(len(pulls), -1).T).T.reshape(pulls.shape)


def chosen_times(times: Tensor) -> Tensor:
    """Indices of at most about FIT_TIMES of the times above 0: the early ones, and later ones spread evenly in log t."""
    later = (times > 0).nonzero()[:, 0]
    if len(later) <= FIT_TIMES:
        return later
    early = later[times[later] <= 3][: FIT_TIMES // 4]
    if len(early):
        early = later[torch.linspace(0, int((times[later] <= 3).sum()) - 1, FIT_TIMES // 4).round().long()]
    first = float(times[early[-1]]) if len(early) else float(times[later[0]])
    wanted = torch.logspace(math.log10(first), math.log10(float(times[-1])), FIT_TIMES - len(early), dtype=times.dtype)
    near = torch.searchsorted(times, wanted).clamp(max=len(times) - 1)
    return torch.cat([early, near]).unique()


def regression(
    waves: Waves, degrees: tuple[int, int, int], times: Tensor, mean: Tensor, long_time: Tensor | None = None,
    distance: Tensor | None = None, left: Tensor | None = None,
) -> Regression:  # fmt: skip
    """The regression of an ensemble's transfer at its :func:`fit_points`.

    Args:
        waves: of the scene.
        degrees: of the polynomials.
        times, mean, long_time, distance, left: see :func:`fit_points`.
    """
    return Regression.of(waves, degrees, *fit_points(times, mean, long_time, distance, left))


def fit_points(
    times: Tensor,
    mean: Tensor,
    long_time: Tensor | None = None,
    distance: Tensor | None = None,
    left: Tensor | None = None,
) -> tuple[Tensor, Tensor, np.ndarray]:
    """What a regression is held to: some of the times, and infinity if it is known; the transfer there; its weights.

    Args:
        times, mean, long_time: (time,), [source, time, receiver], [source, receiver].
        distance: expected total variation of two ensembles at each time, (time,); None to count errors relative to how far
            energy has moved.
        left: of damped chains, the share of the energy of each source that is left, [source, time]; the mean is of shares
            of it, the distance of all the energy.
    """
    mean, times = mean.double(), times.double()
    picked = chosen_times(times)
    if distance is None:
        distance = 0.01 * (mean - torch.eye(len(mean), dtype=mean.dtype)[:, None]).abs().sum(-1).mean(0) / 2
    spread = distance[picked].double()
    spread = spread.clamp(min=max(1e-9 * float(spread.max()), 1e-300))
    times, data = times[picked], mean[:, picked]
    if long_time is not None:
        # of what has not settled by the end, a share of 1 / t may be left: no time beyond the data is without a tie
        apart = float((data[:, -1] - long_time).abs().sum(-1).mean()) / 2
        later = times.new_tensor([*BEYOND, math.inf])
        late = (0.7 * spread[-1]).square() + (apart / later).square()
        times = torch.cat([times, times[-1] * later])
        data = torch.cat([data, long_time.double()[:, None].expand(-1, len(later), -1)], dim=1)
        spread = torch.cat([spread, late.sqrt()])
    # a time's error in each energy, from the total variation: B energies of error sigma are sigma B / sqrt(pi) apart
    weight = len(mean) / math.sqrt(math.pi) / spread.numpy()
    if left is not None:
        weight = weight * left[:, picked].numpy()
    return times, data, weight


def fit_compact(
    rates: Tensor, waves: Waves, degrees: tuple[int, int, int], times: Tensor, mean: Tensor,
    long_time: Tensor | None = None, distance: Tensor | None = None, left: Tensor | None = None,
    near: CompactModel | None = None, progress: Callable[[int], Any] | None = None,
) -> tuple[CompactModel, dict[str, Any]]:  # fmt: skip
    """A compact model of a measured transfer; deterministic, a second for 32 bands.

    Args:
        rates: Q of the linear procedure, kept for comparison.
        near: a model to start from, of these degrees or others.
        progress: called with 1 after each step.
        waves, degrees, times, mean, long_time, distance, left: see :func:`regression`.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=20))
        >>> model, report = fit_compact(
        ...     torch.zeros(8, 8, dtype=torch.float64), Waves.of(transfer.scene), (6, 4, 8), transfer.times,
        ...     transfer.mean, transfer.long_time)
        >>> model.n_parameters
        109
    """
    degrees = checked_degrees(degrees)
    problem = regression(waves, degrees, times, mean, long_time, distance, left)
    start = None
    if near is not None:
        start = carried(near.coefficients.detach().double().cpu().numpy(), near.degrees_, degrees)[None]
    found, report = solve([problem], np.ones((1, 1)), start, progress)
    model = CompactModel(
        rates=rates, degrees=torch.tensor(degrees, dtype=torch.float64), coefficients=torch.from_numpy(found[0]),
        **waves.tensors(),
    )  # fmt: skip
    return model, report
