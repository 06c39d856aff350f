"""A model of a few hundred numbers, whatever the number of bands, never negative and exact at early times by its form.

The odds of finding energy of band s in band r rather than still in s are those of two waves of an effective medium that beat
and decay, times the exponential of a smooth function of place, distance and time:

    T[s, r](t) = o_sr / (own_s + sum_r' o_sr'),   o_sr = D_sr(t) exp(p(u, v, tau)),   own_s = exp(q(s, tau)).

D is second-order perturbation theory, damped: a wave of frequency w and decay g scatters into one of w', g' with

    D = c w w' (h(w - w') - h(w + w')),   h(x) = (1 - exp(-G t) (cos x t + G sin(x t) / x)) / (x^2 + G^2),   G = g + g',

which starts as t^4 and ends as a Lorentzian. w and g are those of the self-consistent Born approximation, summed over the
tones of the receiving band. p and q are polynomials of Legendre, of the mean wavenumber u, the logarithm v of the distance
in units of the decay, and a clock tau = sqrt(t) / (sqrt(t) + sqrt(t0)) that shows 1 at infinity. Their coefficients are all
that is fitted: a logistic regression, by Levenberg's and Marquardt's method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.certificate import CertificateError, nonnegative
from torchchain.master.fits import linear_weights
from torchchain.master.memory import ORDERS, MemoryModel, checked_order, fit_memory
from torchchain.master.model import Embedding, TransferModel
from torchchain.master.proof import Certificate
from torchchain.master.records import Fit, Fitted, Progress, Recipe, ReducedModel
from torchchain.master.sample import Sample, block_weights
from torchchain.threads import single_blas_thread

LADDER = ((4, 3, 6), (6, 4, 8), (8, 5, 10), (8, 6, 12), (10, 7, 20), (14, 10, 20))
"""Degrees in place, distance and time that are tried one after the other."""
CLOCK = 10.0
"""t0 of the clock tau."""
FLOOR = 0.05
"""The odds' first guess stays above this share of its envelope: where waves have beaten to rest, others have come."""
LARGEST_EXPONENT = 60.0
TONES = 8
"""Tones of a receiving band that are summed over; of more, as many spread evenly."""
RIDGE = 1.0
"""Against coefficients that the data do not tell, which would run away between the strengths of a family."""
FIT_TIMES = 48
BEYOND = (1.5, 2.5, 5.0, 10.0, 30.0, 100.0, 1000.0)
"""Times after the last, in units of it, at which what has not settled is to have come nearer to Pi."""
SERIES = 0.1
"""Up to this time D is summed in powers of t, beyond as it stands: differences of cosines lose digits at first."""
SERIES_ORDER = 14
STEPS = 60
WIDTH = 0.8
"""Decay rates in D, relative to the Born approximation's: with the distance in these units the rest is smoothest."""


@dataclass(frozen=True, eq=False)
class Waves:
    """The waves of an effective medium: frequencies and decay rates of amplitudes, per unit time.

    Attributes:
        source_frequency, source_decay: of the tone of each source, (band,).
        tone_frequency, tone_decay: of tones in each receiving band, (band, tone).
        coupling: c, the variance of the disorder for each tone.
    """

    source_frequency: Tensor
    source_decay: Tensor
    tone_frequency: Tensor
    tone_decay: Tensor
    coupling: Tensor

    @classmethod
    def of(cls, scene: Scene, strength: float | None = None) -> Waves:
        """The waves of a scene's chains, in the self-consistent Born approximation.

        Args:
            scene: with one tone in each band.
            strength: standard deviation of the masses, and of the contacts if they vary too; None for the scene's.
        """
        if strength is None:
            other = scene.stiffness_disorder
            strength = math.hypot(scene.disorder.strength, 0.0 if other is None else other.strength)
        strength = checks.number("strength", strength, above=0)
        n, bands = scene.n_particles, scene.n_bands
        width = n // 2 // bands
        inside = np.arange(width) if width <= TONES else (np.arange(TONES) + 0.5) * width / TONES - 0.5
        tones = np.arange(bands)[:, None] * width + inside + 1
        source = _poles(2 * np.sin(np.pi / n * np.array(scene.tones, dtype=float)), strength)
        receiver = _poles(2 * np.sin(np.pi / n * tones), strength)
        coupling = strength**2 / n * width / len(inside)
        found = (source.real, -WIDTH * source.imag, receiver.real, -WIDTH * receiver.imag)
        frequency, decay, others, other_decay = (torch.from_numpy(value.copy()) for value in found)
        return cls(frequency, decay, others, other_decay, torch.tensor(coupling, dtype=torch.float64))

    def tensors(self) -> dict[str, Tensor]:
        return {
            "source_frequency": self.source_frequency, "source_decay": self.source_decay,
            "tone_frequency": self.tone_frequency, "tone_decay": self.tone_decay, "coupling": self.coupling,
        }  # fmt: skip


def _poles(frequency: np.ndarray, strength: float) -> np.ndarray:
    """Complex frequencies z = w / sqrt(mu(Re z)) of waves of the ordered chain's frequency w, imaginary parts below 0.

    The effective mass mu = 1 + xi^2 z^2 g with the local response g = 1 / sqrt(e (e - 4)), e = z^2 mu, Im g > 0, of the
    infinite chain; by damped iteration. In weak disorder -Im z = xi^2 sin(k/2) tan(k/2), half of Born's decay rate.
    """
    z, mu = frequency + 0j, np.full(frequency.shape, 1 + 1e-3j)
    for _ in range(400):
        squared = z.real**2
        g = 1 / np.sqrt(squared * mu * (squared * mu - 4))
        mu = 0.6 * mu + 0.4 * (1 + strength**2 * squared * np.where(g.imag < 0, -g, g))
        z = 0.6 * z + 0.4 * frequency / np.sqrt(mu)
    return np.where(z.imag > 0, z.conj(), z)


def checked_degrees(degrees: Any) -> tuple[int, int, int]:
    """Degrees of the polynomials in place, distance and time."""
    if not isinstance(degrees, (tuple, list)) or len(degrees) != 3:
        raise checks.FieldTypeError(f"degrees must be three integers, got {checks.shown(degrees)}")
    place, distance, time = (checks.integer("degrees", degree, 1, 40) for degree in degrees)
    return place, distance, time


def _highest(share: float, degree: int) -> int:
    return math.floor(degree * (1 - share) + 1e-9)


def terms(degrees: Sequence[int]) -> tuple[list[tuple[int, int, int]], list[tuple[int, int]]]:
    """The products of polynomials in p, by their degrees in (u, v, tau), and in q, by those in (s, tau).

    Those with i / I + j / J + k / K <= 1: a simplex, since what is fine in place is coarse in time.
    """
    place, distance, time = degrees
    p = [
        (i, j, k)
        for i in range(place + 1)
        for j in range(distance + 1)
        if i / place + j / distance <= 1 + 1e-9
        for k in range(_highest(i / place + j / distance, time) + 1)
    ]
    return p, [(i, k) for i in range(place + 1) for k in range(_highest(i / place, time) + 1)]


def n_coefficients(degrees: Sequence[int]) -> int:
    """Fitted numbers of a model of these degrees; they do not depend on the number of bands."""
    p, q = terms(checked_degrees(degrees))
    return len(p) + len(q)


class CompactModel(TransferModel):
    """T[s, r](t) = o_sr / (own_s + sum o_sr'): odds of a damped beat times the exponential of polynomials (see the module).

    For every t >= 0 and any coefficients no entry is negative, every row adds up to 1, T(0) = I, and T(t) - I starts as t^4.

    Args:
        rates: Q [source, receiver] of the linear procedure at short times, for comparison.
        degrees: of the polynomials in place, distance and time, (3,).
        coefficients: of :func:`terms`, p first, (term,).
        waves: as tensors of :class:`Waves`.
    """

    kind: ClassVar[str] = "compact"
    axes: ClassVar[dict[str, tuple[str, ...]]] = {
        "rates": ("band", "band"), "degrees": ("degree",), "coefficients": ("term",), "source_frequency": ("band",),
        "source_decay": ("band",), "tone_frequency": ("band", "tone"), "tone_decay": ("band", "tone"), "coupling": (),
    }  # fmt: skip
    rates_meaning: ClassVar[str] = MemoryModel.rates_meaning

    def __init__(
        self, rates: Tensor, degrees: Tensor, coefficients: Tensor, source_frequency: Tensor, source_decay: Tensor,
        tone_frequency: Tensor, tone_decay: Tensor, coupling: Tensor,
    ) -> None:  # fmt: skip
        super().__init__()
        rates = checks.real_tensor("rates", rates)
        if rates.ndim != 2 or rates.shape[0] != rates.shape[1] or not rates.numel():
            raise checks.fail("rates", "be a square matrix", f"shape {tuple(rates.shape)}")
        degrees = checks.real_tensor("degrees", degrees)
        self.degrees_ = checked_degrees([int(value) for value in degrees.flatten()])
        self.register_buffer("_rates", rates.detach().clone())
        self._rates: Tensor
        found = {
            "source_frequency": (source_frequency, (len(rates),)), "source_decay": (source_decay, (len(rates),)),
            "tone_frequency": (tone_frequency, (len(rates), *tone_frequency.shape[1:2])),
            "tone_decay": (tone_decay, (len(rates), *tone_frequency.shape[1:2])), "coupling": (coupling, ()),
            "coefficients": (coefficients, (n_coefficients(self.degrees_),)),
        }  # fmt: skip
        for name, (value, shape) in found.items():
            value = checks.real_tensor(name, value).to(rates)
            if tuple(value.shape) != shape or 0 in shape:
                raise checks.fail(name, f"have shape {shape}", f"shape {tuple(value.shape)}")
            if name != "coefficients":
                checks.first_bad(name, "be positive", value, ~(value > 0), "band")
            self.register_buffer(name, value.detach().clone())
        self.source_frequency: Tensor
        self.source_decay: Tensor
        self.tone_frequency: Tensor
        self.tone_decay: Tensor
        self.coupling: Tensor
        self.coefficients: Tensor
        place, own = _shapes(self)
        self._place, self._own = place, own  # not part of the file: they follow from the waves

    @property
    def rates(self) -> Tensor:
        return self._rates

    @property
    def basis(self) -> Tensor:  # type: ignore[override]
        """Pi [source, receiver], T at infinite time."""
        return self._at(self._rates.new_full((1,), math.inf))[:, 0]

    @property
    def damping(self) -> Tensor:  # type: ignore[override]
        """None, [band]."""
        return torch.zeros_like(self._rates[0])

    @property
    def words(self) -> str:
        return f"degrees {self.degrees_}, {self.n_parameters} fitted numbers"

    @property
    def n_bands(self) -> int:
        return len(self._rates)

    @property
    def n_parameters(self) -> int:
        return len(self.coefficients)

    @property
    def conservation_defect(self) -> float:
        """Rows are divided by their sum."""
        return 0.0

    @property
    def certificate(self) -> Certificate:
        """By construction, for every t >= 0."""
        eps = torch.finfo(self._rates.dtype).eps
        return Certificate(0.0, 1.0 + 2 * self.n_bands * eps, 2 * self.n_bands * eps, 0.0, 0)

    def tensors(self) -> dict[str, Tensor]:
        names = ("source_frequency", "source_decay", "tone_frequency", "tone_decay", "coupling", "coefficients")
        degrees = self._rates.new_tensor(self.degrees_)
        return {"rates": self.rates, "degrees": degrees, **{name: getattr(self, name) for name in names}}

    def _apply(self, fn: Any, recurse: bool = True) -> CompactModel:
        super()._apply(fn, recurse)
        self._place, self._own = fn(self._place), fn(self._own)
        return self

    def _at(self, times: Tensor, sources: Tensor | None = None) -> Tensor:
        """T at times that may be infinite, (source, time, receiver), of all sources or some, by number."""
        sources = torch.arange(self.n_bands, device=times.device) if sources is None else sources
        odds = first_odds(self, times, sources)
        clock = _polynomials(_clock(times), self.degrees_[2])
        p, q = terms(self.degrees_)
        moved = odds * _power(self._place[sources], clock, self.coefficients[: len(p)], p)
        own = _power(self._own[sources], clock, self.coefficients[len(p) :], q)[:, :, 0]
        mask = torch.nn.functional.one_hot(sources, self.n_bands).to(moved)[:, None]
        moved = moved * (1 - mask) + own[:, :, None] * mask
        return moved / moved.sum(-1, keepdim=True)

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        if initial.requires_grad:
            return torch.einsum("...s,str->...tr", initial, self._at(times))
        used = (initial.reshape(-1, self.n_bands) != 0).any(0).nonzero()[:, 0]  # other sources have nothing to give
        return torch.einsum("...s,str->...tr", initial[..., used], self._at(times, used))

    def as_memory(self, order: tuple[int, int] = (4, 6), span: float = 1e3) -> MemoryModel:
        """The nearest model with memory, certified: exponentials for whoever needs a linear differential equation.

        Args:
            order: numbers of exponentials and of pairs, or the next smaller ones with which a model is never negative.
            span: last time at which the two are compared.

        Raises:
            CertificateError: if there is none of any order.
        """
        times = torch.cat([
            torch.linspace(0.25, 5, 20, dtype=torch.float64), torch.logspace(math.log10(5.3), math.log10(span), 90, dtype=torch.float64),
        ])  # fmt: skip
        with torch.no_grad():
            mean = self.double()._at(times) if self._rates.dtype != torch.float64 else self._at(times)
            basis = self.basis
        order = checked_order(order, len(times))
        for smaller in (order, *(known for known in ORDERS[::-1] if sum(known) < sum(order))):
            tensors, _ = fit_memory(times, mean, basis, smaller)
            try:
                return nonnegative(MemoryModel(rates=self.rates, **tensors), times, mean)[0]
            except CertificateError as error:
                reason = error
        raise reason

    def embedding(self) -> Embedding:
        """That of the nearest model with memory (:meth:`as_memory`): these odds obey no linear equation of their own."""
        return self.as_memory().embedding()


def _clock(times: Tensor) -> Tensor:
    root = times.sqrt()
    return torch.where(times.isinf(), torch.ones_like(root), root / (root + math.sqrt(CLOCK)))


def _polynomials(x: Tensor, degree: int) -> Tensor:
    """Legendre polynomials on [0, 1] of degree 0 to ``degree``, on a last axis of their own."""
    y = 2 * x - 1
    found = [torch.ones_like(y), y]
    for n in range(1, degree):
        found.append(((2 * n + 1) * y * found[-1] - n * found[-2]) / (n + 1))
    return torch.stack(found[: degree + 1], dim=-1)


def _shapes(waves: CompactModel | Waves, degrees: tuple[int, int, int] | None = None) -> tuple[Tensor, Tensor]:
    """Polynomials of place and distance for each pair, [source, receiver, term], and of place, [source, 1, term]."""
    degrees = waves.degrees_ if isinstance(waves, CompactModel) else degrees
    assert degrees is not None, "given with plain waves"
    n = len(waves.source_frequency)
    band = torch.arange(n, dtype=waves.source_frequency.dtype, device=waves.source_frequency.device) / max(n - 1, 1)
    off = ~torch.eye(n, dtype=torch.bool, device=band.device)
    far = (waves.tone_frequency.mean(1) - waves.source_frequency[:, None]).abs()
    far = torch.asinh(far / (waves.source_decay[:, None] + waves.tone_decay.mean(1)))
    low, high = (far[off].min(), far[off].max()) if n > 1 else (far.min(), far.max())
    far = ((far - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)
    place = _polynomials((band[:, None] + band) / 2, degrees[0])
    distance = _polynomials(far, degrees[1])
    p, _ = terms(degrees)
    pairs = list(dict.fromkeys((i, j) for i, j, _ in p))
    first = torch.stack([place[..., i] * distance[..., j] for i, j in pairs], dim=-1)
    own = _polynomials(band, degrees[0])
    return first, own[:, None]


def _power(shape: Tensor, clock: Tensor, coefficients: Tensor, index: list[Any]) -> Tensor:
    """exp of the polynomials, [source, time, receiver], from shapes [source, receiver, term] and clock [time, degree]."""
    heads = list(dict.fromkeys(entry[:-1] for entry in index))
    place = {head: i for i, head in enumerate(heads)}
    table = coefficients.new_zeros(len(heads), clock.shape[-1])
    rows = torch.tensor([place[entry[:-1]] for entry in index], device=table.device)
    columns = torch.tensor([entry[-1] for entry in index], device=table.device)
    table = table.index_put((rows, columns), coefficients)
    exponent = torch.einsum("srp,pt->str", shape, table @ clock.T)
    return exponent.clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT).exp()


def first_odds(waves: CompactModel | Waves, times: Tensor, sources: Tensor) -> Tensor:
    """D [source, time, receiver], positive, of some sources; times may be infinite."""
    w, g = waves.source_frequency[sources][:, None, None, None], waves.source_decay[sources][:, None, None, None]
    other, decay = waves.tone_frequency[:, :, None], waves.tone_decay[:, :, None]  # [receiver, tone, time]
    rate = g + decay
    size = waves.coupling * w * other
    slow, fast = (w - other).abs(), w + other
    finite = times.isfinite()
    t = torch.where(finite, times, torch.zeros_like(times))
    beat = _response(slow, rate, t) - _response(fast, rate, t)
    beat = torch.where(t < SERIES, _early(slow, fast, rate, t.clamp(max=SERIES)), beat)
    late = 1 / (slow**2 + rate**2) - 1 / (fast**2 + rate**2)
    beat = torch.where(finite, beat, late)
    # t^4 w w' / 6 at first, and a Lorentzian in the end
    squared = t**2
    rise = squared**2 * w * other / 6 / ((1 + squared * fast**2 / 12) * (1 + squared * (slow**2 + rate**2) / 2))
    ending = 4 * w * other / (fast**2 * (slow**2 + rate**2))
    least = FLOOR * torch.where(finite, rise, ending)
    beat = size * (beat + (beat**2 + 4 * least**2).sqrt()) / 2
    return beat.sum(2).transpose(1, 2)


def _response(x: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """h(x): what obeys h'' + 2 G h' + (G^2 + x^2) h = 1 from rest."""
    return (1 - torch.exp(-rate * t) * (torch.cos(x * t) + rate * t * torch.sinc(x * t / math.pi))) / (x**2 + rate**2)


def _early(slow: Tensor, fast: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """h(slow) - h(fast) in powers of t from t^4, where the two begin to differ."""
    result = torch.zeros_like(slow * t)
    pairs = []
    for x in (slow, fast):
        derivatives = [torch.ones_like(x * rate), -2 * rate + 0 * x]
        for _ in range(4, SERIES_ORDER + 1):
            derivatives.append(-2 * rate * derivatives[-1] - (rate**2 + x**2) * derivatives[-2])
        pairs.append(derivatives)
    for order in range(4, SERIES_ORDER + 1):
        result = result + (pairs[0][order - 2] - pairs[1][order - 2]) * t**order / math.factorial(order)
    return result


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
        first, own = _shapes(waves, degrees)
        shape = torch.cat([first * (1 - eye)[..., None], own * eye[..., None]], dim=-1)
        held = np.zeros((shape.shape[-1], degrees[2] + 1), dtype=bool)
        row = 0
        for part in terms(degrees):
            heads = list(dict.fromkeys(entry[:-1] for entry in part))
            for entry in part:
                held[row + heads.index(entry[:-1]), entry[-1]] = True
            row += len(heads)
        clock = _polynomials(_clock(times), degrees[2])
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


def solve(regressions: Sequence[Regression], mixing: np.ndarray, start: np.ndarray | None = None, progress: Any = None) -> tuple[np.ndarray, dict[str, Any]]:  # fmt: skip
    """Levenberg's and Marquardt's method for several regressions whose coefficients are mixtures of common ones.

    Args:
        regressions: of the same degrees.
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


@dataclass(frozen=True, eq=False)
class CompactFamily:
    """Compact models for a range of strengths xi: the coefficients are polynomials of sqrt(xi), the waves those of xi itself.

    Any coefficients make a model that is never negative and conserves energy, so every strength in between has one.

    Attributes:
        scene: of the ensembles, but for the strength of the disorder.
        lowest, highest: strengths of the ensembles that the family was fitted to.
        degrees: of the polynomials in place, distance and time.
        coefficients: (set, term), of Chebyshev's polynomials in sqrt(xi) from the zeroth.
        rates: Q of the linear procedure, for comparison, [source, receiver].
    """

    scene: Scene
    lowest: float
    highest: float
    degrees: tuple[int, int, int]
    coefficients: Tensor
    rates: Tensor

    @property
    def n_parameters(self) -> int:
        return self.coefficients.numel()

    def at(self, strength: float) -> CompactModel:
        """The model at a strength above 0: below the lowest with the lowest's coefficients, for D is proportional to xi^2.

        Raises:
            FieldError: above the highest.
        """
        strength = checks.number("strength", strength, above=0, at_most=self.highest * (1 + 1e-12))
        sets = torch.from_numpy(_sets(max(strength, self.lowest), self.lowest, self.highest, len(self.coefficients)))
        return CompactModel(
            rates=self.rates, degrees=torch.tensor(self.degrees, dtype=torch.float64),
            coefficients=sets.to(self.coefficients) @ self.coefficients,
            **_of_strength(self.scene, strength).tensors(),
        )  # fmt: skip


def _sets(strength: float, lowest: float, highest: float, count: int) -> np.ndarray:
    """Chebyshev's polynomials in sqrt(xi), (set,)."""
    span = max(math.sqrt(highest) - math.sqrt(lowest), 1e-12)
    x = 2 * (math.sqrt(strength) - math.sqrt(lowest)) / span - 1
    return np.cos(np.arange(count) * math.acos(min(1.0, max(-1.0, x))))


def _of_strength(scene: Scene, strength: float) -> Waves:
    """Waves of a scene with another strength of its masses' disorder."""
    other = scene.stiffness_disorder
    return Waves.of(scene, math.hypot(strength, 0.0 if other is None else other.strength))


def fit_compact_family(
    scenes: Sequence[Scene], times: Sequence[Tensor], means: Sequence[Tensor], long_times: Sequence[Tensor | None],
    distances: Sequence[Tensor | None], rates: Tensor, degrees: tuple[int, int, int] = (9, 6, 13), sets: int = 5,
    progress: Callable[[int], Any] | None = None,
) -> tuple[CompactFamily, dict[str, Any]]:  # fmt: skip
    """One family from ensembles that differ in the strength of their masses' disorder, all fitted at once.

    Args:
        scenes, times, means, long_times, distances: of each ensemble, see :func:`regression`.
        rates: kept for comparison.
        sets: coefficients of the polynomial in the strength, fewer than there are ensembles, or as many.

    Raises:
        FieldError: for too few ensembles, or if two have the same strength.
    """
    degrees = checked_degrees(degrees)
    strengths = [scene.disorder.strength for scene in scenes]
    if len(set(strengths)) < len(strengths) or not strengths or min(strengths) <= 0:
        raise checks.fail("scenes", "have different strengths of disorder above 0", strengths)
    sets = checks.integer("sets", sets, 1, len(scenes))
    lowest, highest = min(strengths), max(strengths)
    problems = [
        regression(_of_strength(scene, scene.disorder.strength), degrees, t, mean, late, distance)
        for scene, t, mean, late, distance in zip(scenes, times, means, long_times, distances, strict=True)
    ]
    mixing = np.stack([_sets(strength, lowest, highest, sets) for strength in strengths])
    found, report = solve(problems, mixing, progress=progress)
    family = CompactFamily(scenes[0], lowest, highest, degrees, torch.from_numpy(found), rates)
    return family, report | {"degrees": list(degrees), "strengths": strengths, "sets": sets}


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
