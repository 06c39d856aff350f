"""The fit of the compact model: a logistic regression on all times at once, by Levenberg's and Marquardt's method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.compact import (
    LARGEST_EXPONENT,
    CompactModel,
    checked_degrees,
    clock_of,
    n_coefficients,
    polynomials,
    shapes,
    terms,
)
from torchchain.master.fits import linear_weights
from torchchain.master.model import TransferModel
from torchchain.master.records import Fit, Fitted, Progress, Recipe, ReducedModel
from torchchain.master.sample import Sample, block_weights
from torchchain.master.waves import Waves, first_odds
from torchchain.threads import single_blas_thread

LADDER = ((4, 3, 6), (6, 4, 8), (8, 5, 10), (8, 6, 12), (10, 7, 20), (14, 10, 20))
"""Degrees in place, distance and time that are tried one after the other."""
RIDGE = 1.0
"""Against coefficients that the data do not tell, which would run away between the strengths of a family."""
FIT_TIMES = 48
BEYOND = (1.5, 2.5, 5.0, 10.0, 30.0, 100.0, 1000.0)
"""Times after the last, in units of it, at which what has not settled is to have come nearer to Pi."""
STEPS = 60


@dataclass(frozen=True, eq=False)
class Regression:
    """One logistic regression: data, weights and everything that does not change while its coefficients do.

    Attributes:
        odds: first odds D with 1 for the own band, [source, time, receiver].
        shape: polynomials of place and distance, of a source's own band last, [source, receiver, term].
        clock: polynomials of time, (time, degree).
        held: which products of the two are coefficients, bool (term, degree).
        data: T, [source, time, receiver].
        weight: of each time, (time,), the inverse of its error.
    """

    odds: np.ndarray
    shape: np.ndarray
    clock: np.ndarray
    held: np.ndarray
    data: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(
        cls, waves: Waves, degrees: tuple[int, int, int], times: Tensor, data: Tensor, weight: np.ndarray
    ) -> Regression:
        n = len(waves.source_frequency)
        eye = torch.eye(n, dtype=torch.float64)
        odds = first_odds(waves, times, torch.arange(n)) * (1 - eye[:, None]) + eye[:, None]
        first, own = shapes(waves, degrees)
        shape = torch.cat([first * (1 - eye)[..., None], own * eye[..., None]], dim=-1)
        held = np.zeros((shape.shape[-1], degrees[2] + 1), dtype=bool)
        row = 0
        for part in terms(degrees):
            heads = list(dict.fromkeys(entry[:-1] for entry in part))
            for entry in part:
                held[row + heads.index(entry[:-1]), entry[-1]] = True
            row += len(heads)
        clock = polynomials(clock_of(times), degrees[2])
        return cls(odds.numpy(), shape.numpy(), clock.numpy(), held, data.numpy(), weight)

    def predicted(self, coefficients: np.ndarray) -> np.ndarray:
        """T [source, time, receiver] for coefficients as a (term, degree) table."""
        exponent = np.clip(self.shape @ (coefficients @ self.clock.T), -LARGEST_EXPONENT, LARGEST_EXPONENT)
        moved = self.odds * np.exp(exponent).transpose(0, 2, 1)
        return moved / moved.sum(-1, keepdims=True)

    def misfit(self, coefficients: np.ndarray) -> tuple[float, np.ndarray]:
        """Weighted sum of squares with the ridge, and what was predicted."""
        found = self.predicted(coefficients)
        return float((((found - self.data) * self.weight[:, None]) ** 2).sum() + RIDGE * (coefficients**2).sum()), found

    def normal(self, found: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and right-hand side of the linearized problem, over the coefficients that are held."""
        size, degree = self.held.shape
        squares, pull = np.zeros((len(self.clock), size, size)), np.zeros((size, degree))
        for i, weight in enumerate(self.weight):
            slope = self._slope(found[:, i], weight)
            squares[i] = slope.T @ slope
            pull += np.outer(slope.T @ ((self.data[:, i] - found[:, i]) * weight).ravel(), self.clock[i])
        matrix = np.einsum("tab,tc,td->acbd", squares, self.clock, self.clock, optimize=True)
        held = self.held.ravel()
        matrix = matrix.reshape(len(held), -1)[np.ix_(held, held)]
        return matrix + RIDGE * np.eye(len(matrix)), (pull - RIDGE * coefficients).ravel()[held]

    def _slope(self, found: np.ndarray, weight: float) -> np.ndarray:
        """Derivative of one time's T by the exponents' terms, (source receiver, term)."""
        mean = np.matmul(found[:, None], self.shape)
        return ((self.shape - mean) * (found * weight)[..., None]).reshape(found.size, -1)

    def table(self, held: np.ndarray) -> np.ndarray:
        """Coefficients as a table, zeros where none is."""
        table = np.zeros(self.held.shape)
        table[self.held] = held
        return table


def solve(regressions: Sequence[Any], mixing: np.ndarray, start: np.ndarray | None = None, progress: Any = None) -> tuple[np.ndarray, dict[str, Any]]:  # fmt: skip
    """Levenberg's and Marquardt's method for several regressions whose coefficients are mixtures of common ones.

    Args:
        regressions: of the same degrees, each a :class:`Regression` or like one.
        mixing: weight of each of the common sets of coefficients in each regression, (regression, set).
        start: (set, coefficient); zero if None.
        progress: called with 1 after each step.

    Returns:
        (set, coefficient), and a report: converged, steps, misfit in units of the error.
    """
    sets, size = mixing.shape[1], int(regressions[0].held.sum())
    found = np.zeros((sets, size)) if start is None else start.copy()

    def misfits(found: np.ndarray) -> tuple[float, list[np.ndarray]]:
        each = [r.misfit(r.table(c)) for r, c in zip(regressions, mixing @ found, strict=True)]
        return sum(value for value, _ in each), [predicted for _, predicted in each]

    now, predicted = misfits(found)
    damping, converged, steps = 1.0, False, 0
    while steps < STEPS:
        steps += 1
        matrix, pull = np.zeros((sets, size, sets, size)), np.zeros((sets, size))
        for r, c, p, m in zip(regressions, mixing @ found, predicted, mixing, strict=True):
            part, force = r.normal(p, r.table(c))
            matrix += m[:, None, None, None] * m[None, None, :, None] * part[None, :, None, :]
            pull += np.outer(m, force)
        square = matrix.reshape(sets * size, -1)
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
    count = sum(r.data.size for r in regressions)
    return found, {"converged": converged, "steps": steps, "misfit": math.sqrt(now / count)}


def refitted(problem: Regression, model: CompactModel, means: Sequence[np.ndarray]) -> list[CompactModel]:
    """The models of other data like the problem's, by one step of Gauss and Newton each, for error bars.

    Args:
        problem: that the model was fitted to.
        model: its solution.
        means: T at the problem's times, [source, time, receiver], of ensembles drawn again.
    """
    table = problem.table(model.coefficients.detach().double().cpu().numpy())
    found = problem.predicted(table)
    matrix, rest = problem.normal(found, table)
    inverse = np.linalg.inv(matrix)
    models = []
    for mean in means:
        pull = np.zeros(problem.held.shape)
        for i, weight in enumerate(problem.weight):
            change = ((mean[:, i] - problem.data[:, i]) * weight).ravel()
            pull += np.outer(problem._slope(found[:, i], weight).T @ change, problem.clock[i])
        step = inverse @ (pull[problem.held] + rest)
        tensors = model.tensors()
        tensors["coefficients"] = tensors["coefficients"] + torch.from_numpy(step).to(tensors["coefficients"])
        models.append(CompactModel(**tensors))
    return models


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
    distance: Tensor | None = None,
) -> Regression:  # fmt: skip
    """The regression of an ensemble's transfer at some of its times, and at infinity if that is known.

    Args:
        waves: of the scene.
        degrees: of the polynomials.
        times, mean, long_time: (time,), [source, time, receiver], [source, receiver].
        distance: expected total variation of two ensembles at each time, (time,); None to count errors relative to how far
            energy has moved.
    """
    mean, times = mean.double(), times.double()
    picked = chosen_times(times)
    if distance is None:
        distance = 0.01 * (mean - torch.eye(len(mean), dtype=mean.dtype)[:, None]).abs().sum(-1).mean(0) / 2
    spread = distance[picked].double()
    spread = spread.clamp(min=max(1e-5 * float(spread.max()), 1e-300))
    times, data = times[picked], mean[:, picked]
    if long_time is not None:
        # of what has not settled by the end, a share of 1 / t may be left: no time beyond the data is without a tie
        left = float((data[:, -1] - long_time).abs().sum(-1).mean()) / 2
        later = times.new_tensor([*BEYOND, math.inf])
        late = (0.7 * spread[-1]).square() + (left / later).square()
        times = torch.cat([times, times[-1] * later])
        data = torch.cat([data, long_time.double()[:, None].expand(-1, len(later), -1)], dim=1)
        spread = torch.cat([spread, late.sqrt()])
    # a time's error in each energy, from the total variation: B energies of error sigma are sigma B / sqrt(pi) apart
    weight = len(mean) / math.sqrt(math.pi) / spread.numpy()
    return Regression.of(waves, degrees, times, data, weight)


def fit_compact(
    rates: Tensor, waves: Waves, degrees: tuple[int, int, int], times: Tensor, mean: Tensor,
    long_time: Tensor | None = None, distance: Tensor | None = None, near: CompactModel | None = None,
    progress: Callable[[int], Any] | None = None,
) -> tuple[CompactModel, dict[str, Any]]:  # fmt: skip
    """A compact model of a measured transfer; deterministic, a second for 32 bands.

    Args:
        rates: Q of the linear procedure, kept for comparison.
        near: a model of the same degrees to start from.
        progress: called with 1 after each step.
        waves, degrees, times, mean, long_time, distance: see :func:`regression`.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=20))
        >>> model, report = fit_compact(
        ...     torch.zeros(8, 8, dtype=torch.float64), Waves.of(transfer.scene), (6, 4, 8), transfer.times,
        ...     transfer.mean, transfer.long_time)
        >>> model.n_parameters
        109
    """
    degrees = checked_degrees(degrees)
    problem = regression(waves, degrees, times, mean, long_time, distance)
    start = None
    if near is not None and near.degrees_ == degrees:
        start = near.coefficients.detach().double().cpu().numpy()[None]
    found, report = solve([problem], np.ones((1, 1)), start, progress)
    model = CompactModel(
        rates=rates, degrees=torch.tensor(degrees, dtype=torch.float64), coefficients=torch.from_numpy(found[0]),
        **waves.tensors(),
    )  # fmt: skip
    return model, report | {"degrees": list(degrees)}


@dataclass(frozen=True)
class CompactSettings:
    """Settings of the logistic regression.

    Attributes:
        degrees: in place, distance and time; None for the smallest that reach the ensemble's own error.
    """

    degrees: tuple[int, int, int] | None = None

    def __post_init__(self) -> None:
        if self.degrees is not None:
            object.__setattr__(self, "degrees", checked_degrees(self.degrees))


@dataclass(frozen=True)
class CompactReport:
    """Whether the regression ended by itself, its steps, the root mean square misfit in units of the error, and the degrees."""

    converged: bool
    steps: int
    misfit: float
    degrees: tuple[int, int, int]


def check_scene(scene: Scene | None) -> None:
    """Raise for chains that the model is not made for: the waves of its first odds are those of undamped, linear rings."""
    if scene is None:
        raise checks.fail("transfer", "be of chains of a scene for model 'compact'", "energies without one")
    wanted: dict[str, Any] = {"lattice": None, "boundary": "periodic", "damping": 0.0}
    for name, value in wanted.items():
        if getattr(scene, name) != value:
            raise checks.fail(name, f"be {value} for model 'compact'", getattr(scene, name))
    if not scene.disorder.strength > 0:
        raise checks.fail("disorder.strength", "be above 0 for model 'compact'", scene.disorder.strength)
    if scene.n_bands < 2 or len(scene.tones) != scene.n_bands:
        raise checks.fail("n_bands", "be at least 2, with one tone each, for model 'compact'", scene.n_bands)


def _fit(sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Progress) -> Fitted:
    check_scene(sample.scene)
    assert sample.scene is not None, "checked"
    rates = torch.einsum("t,str->sr", linear_weights(sample.times, recipe.window), sample.mean)
    with single_blas_thread():
        model, told = fit_compact(
            rates, Waves.of(sample.scene), recipe.settings.degrees, sample.times, sample.mean, sample.long_time,
            sample.distance, near if isinstance(near, CompactModel) else None, progress,
        )  # fmt: skip
    return model, CompactReport(told["converged"], told["steps"], told["misfit"], model.degrees_)


def replicas(transfer: BandTransfer, recipe: Recipe, model: CompactModel, repeats: Tensor) -> Iterator[CompactModel]:
    """Models of ensembles in which the blocks are repeated, (replica, block), by one step from the model each."""
    sample = Sample.of(transfer)
    assert sample.scene is not None, "the fit has checked it"
    problem = regression(
        Waves.of(sample.scene), model.degrees_, sample.times, sample.mean, sample.long_time, sample.distance
    )
    weights, picked = block_weights(transfer, repeats), chosen_times(sample.times)
    means = torch.einsum("ab,bstr->astr", weights, transfer.block_mean[:, :, picked])
    late = transfer.block_long_time
    if late is not None:
        ends = torch.einsum("ab,bsr->asr", weights, late)[:, :, None].expand(-1, -1, len(BEYOND) + 1, -1)
        means = torch.cat([means, ends], dim=2)
    slope = linear_weights(sample.times, recipe.window)
    rates = torch.einsum("ab,bsr->asr", weights, torch.einsum("t,bstr->bsr", slope, transfer.block_mean))
    with single_blas_thread():
        found = refitted(problem, model, list(means.double().numpy()))
    for other, slopes in zip(found, rates, strict=True):
        yield CompactModel(**other.tensors() | {"rates": slopes.clone()})


def _rungs(n_times: int) -> list[CompactSettings]:
    """The degrees that so many times can tell apart, the smallest at least."""
    return [CompactSettings(degrees) for degrees in LADDER if degrees == LADDER[0] or 2 * degrees[2] <= n_times]


COMPACT = ReducedModel(
    "compact", "odds of damped beats times exponentials of polynomials: a few hundred numbers, never negative", CompactModel,
    (Fit("logistic", "logistic regression on all times", _fit, settings=CompactSettings, report=CompactReport),),
    lambda n_bands, damped, settings: n_coefficients(settings.degrees or LADDER[0]), climbed_by="logistic", default=True,
    needs_long_time=True, needs_strength=True, rungs=_rungs, check_scene=check_scene, windows=(1.0, 5.0, 50.0), replicas=replicas,
)  # fmt: skip
