"""Models with memory that are never negative: a proof for the whole time axis.

T(t) = Pi + sum_m A_m f_m(t) is a sum of exponentials, real and damped oscillations. On an interval of the time axis it is a
Taylor polynomial and a remainder bounded by its poles; a polynomial lies above the smallest of its coefficients in
Bernstein's basis (Bernstein 1912; Cargo and Shisha 1966), which close in on it as the interval is cut in two. Beyond some
time Pi is larger than all that still decays. So finitely many intervals bound T from below at every t >= 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.master.memory import MemoryModel, poles_of
from torchchain.master.model import TransferModel
from torchchain.master.proof import ROUNDING, Certificate

DEGREE = 16  # of the Taylor polynomials
REMAINDER = 1e-15  # of them, as a share of the energy
MOST_INTERVALS = 20_000
DEEPEST, MOST_ROWS = 40, 10**5
"""Halvings of an interval, and pieces of some intervals, before the proof is given up."""
NUMBERS = 2**17
"""Taylor coefficients of all entries in the intervals that are looked at together."""


class CertificateError(ValueError):
    """A model that was to be certified is not what its certificate says.

    Attributes:
        nearest: what came nearest to it and its certificate, if anything did.
    """

    def __init__(self, message: str, nearest: tuple[MemoryModel, Certificate] | None = None) -> None:
        super().__init__(message)
        self.nearest = nearest


@dataclass(frozen=True, eq=False)
class Exponentials:
    """y_e(t) = level_e + Re sum_m weight[m, e] exp(pole_m t), for many entries e at once.

    Attributes:
        level: (entry,).
        weight: complex, (pole, entry).
        pole: complex, (pole,), real parts not positive.
    """

    level: np.ndarray
    weight: np.ndarray
    pole: np.ndarray

    @classmethod
    def of(cls, model: MemoryModel) -> Exponentials:
        """The transfer of a model, entries [source, receiver] in a row; without its damping, which only lowers it."""
        single = len(model.decay)
        amplitudes = model.amplitudes.detach().double().cpu().numpy().reshape(len(model.amplitudes), -1)
        pairs = amplitudes[single::2] - 1j * amplitudes[single + 1 :: 2]
        weight = np.concatenate([amplitudes[:single] + 0j, pairs])
        return cls(model.basis.double().cpu().numpy().ravel(), weight, poles_of(model).exponents)

    @classmethod
    def of_embedding(cls, model: TransferModel) -> Exponentials:
        """The transfer of a model with rates, from the eigenvalues of its linear differential equation.

        Raises:
            CertificateError: where these do not say what the model does: growing, or no basis of eigenvectors.
        """
        with torch.no_grad():
            parts = model.embedding()
        generator = parts.generator.double().cpu().numpy()
        poles, right = np.linalg.eig(generator)
        scale = max(float(np.abs(generator).max()), 1e-300)
        if float(poles.real.max()) > 1e-10 * scale:
            raise CertificateError(f"model must not grow, got exp({float(poles.real.max()):.3g} t)")
        left = np.linalg.pinv(right)
        error = float(np.abs(right * poles @ left - generator).max())
        if not error <= 1e-9 * scale:
            raise CertificateError(f"rates must have a basis of eigenvectors, got an error of {error:.2g}")
        start, readout = parts.start.double().cpu().numpy(), parts.readout.double().cpu().numpy()
        weight = np.einsum("sm,mr->msr", start @ right, left @ readout).reshape(len(poles), -1)
        rests = np.abs(poles) <= 1e-10 * scale
        return cls(
            weight[rests].sum(0).real, weight[~rests], np.minimum(poles[~rests].real, 0) + 1j * poles[~rests].imag
        )

    def taylor(self, start: np.ndarray, length: np.ndarray) -> np.ndarray:
        """Taylor coefficients about every start, (interval,), in units of its length, (entry, interval, degree + 1)."""
        orders = np.arange(DEGREE + 1)
        factorials = np.array([math.factorial(k) for k in orders], dtype=float)
        powers = (self.pole[:, None, None] * length[:, None]) ** orders / factorials
        moved = np.exp(self.pole[:, None] * start)[..., None] * powers
        found = (self.weight.T @ moved.reshape(len(self.pole), -1)).real.reshape(-1, *moved.shape[1:])
        found[..., 0] += self.level[:, None]
        return found

    def size(self, start: float) -> np.ndarray:
        """sum_m |weight| exp(Re pole t): what still moves at a time, (entry,)."""
        return np.abs(self.weight).T @ np.where(self.pole.real == 0, 1.0, np.exp(self.pole.real * min(start, 1e300)))


_BERNSTEIN = np.array(
    [[math.comb(k, i) / math.comb(DEGREE, i) for k in range(DEGREE + 1)] for i in range(DEGREE + 1)]
)  # coefficients in powers to coefficients in Bernstein's basis: all weights in [0, 1], no cancellation
_LEFT = np.array([[math.comb(k, i) / 2.0**k for k in range(DEGREE + 1)] for i in range(DEGREE + 1)])
"""De Casteljau's halving: Bernstein coefficients of the left half; the right half's are the mirror image."""
_RIGHT = _LEFT[::-1, ::-1]


def certify(model: TransferModel) -> Certificate:
    """Bounds of T(t) for every t >= 0.

    A few hundred products of small matrices; no time is sampled. The bounds contain the rounding of the evaluation.

    Args:
        model: with memory; with rates, whose eigenvalues are taken as exact; or one with a ``certificate`` by construction.

    Returns:
        A certificate, which ``holds`` or not. ``lower`` is a bound in either case, close where it holds.

    Example:
        >>> rates = torch.tensor([[-0.3, 0.3], [0.1, -0.1]], dtype=torch.float64)
        >>> certify(tc.RateModel(rates, torch.zeros(2))).holds
        True
    """
    checks.instance("model", model, TransferModel)
    given = getattr(model, "certificate", None)
    if isinstance(given, Certificate):
        return given
    if not isinstance(model, MemoryModel):
        return _certify_rates(model)
    return _bounded(Exponentials.of(model), _row_sums_off(model.basis, model.amplitudes))


def _row_sums_off(basis: Tensor, amplitudes: Tensor) -> float:
    """Largest distance of a row sum of T from 1, at any time."""
    if not bool(basis.any()):  # damped chains
        return math.inf
    return float((amplitudes.detach().double().sum(-1).abs().sum(0) + (basis.double().sum(-1) - 1).abs()).max())


def _certify_rates(model: TransferModel) -> Certificate:
    """As for models with memory; no proof where rates grow or lack eigenvectors."""
    try:
        parts = Exponentials.of_embedding(model)
    except CertificateError:
        return Certificate(-math.inf, math.inf, math.inf, math.inf, 0)
    return _bounded(parts, math.inf if bool(model.damping.any()) else model.conservation_defect)


def _bounded(parts: Exponentials, conservation_defect: float) -> Certificate:
    """Bounds of a sum of exponentials over all intervals of the time axis."""
    edges, tail = proof_edges(parts)
    lower = float((parts.level - parts.size(tail)).min())
    upper = float((parts.level + parts.size(tail)).max())
    start, length = np.array(edges[:-1]), np.diff(edges)
    together = max(1, NUMBERS // (len(parts.level) * (DEGREE + 1)))
    for first in range(0, len(start), together):
        these = slice(first, first + together)
        low, high = _bounds(parts, start[these], length[these])
        lower, upper = min(lower, low), max(upper, high)
    return Certificate(lower, upper, conservation_defect, tail, len(edges) - 1)


def verify(model: TransferModel, certificate: Certificate) -> None:
    """Prove a model's certificate again.

    Raises:
        CertificateError: if the model's energies go lower or higher, or rows are further from 1, than the certificate says.
    """
    checks.instance("certificate", certificate, Certificate)
    found = certify(model)
    for name in ("lower", "upper", "conservation_defect"):
        said, now = getattr(certificate, name), getattr(found, name)
        worse = said - now if name == "lower" else now - said
        if not (now == said or worse <= ROUNDING):
            raise CertificateError(f"certificate must hold for its model: {name} {said:.3g}, got {now:.3g}")


def proof_edges(parts: Exponentials) -> tuple[list[float], float]:
    """Ends of intervals on which the Taylor remainder is below REMAINDER, up to the time where Pi outweighs the rest."""
    edges, size = [0.0], np.abs(parts.weight)
    speed = np.abs(parts.pole)[:, None] ** (DEGREE + 1)
    factorial = float(math.factorial(DEGREE + 1))
    slack = np.maximum(parts.level, 0) + ROUNDING / 4
    if bool((size[parts.pole.real == 0].sum(0) > slack).any()):  # what never decays is never outweighed
        return edges, math.inf
    while len(edges) <= MOST_INTERVALS:
        now = size * np.exp(parts.pole.real * edges[-1])[:, None]
        if bool((now.sum(0) <= slack).all()):
            break
        fastest = max(float((now * speed).sum(0).max()), 1e-300)
        edges.append(edges[-1] + (REMAINDER * factorial / fastest) ** (1 / (DEGREE + 1)))
    return edges, edges[-1]


def _bounds(parts: Exponentials, start: np.ndarray, length: np.ndarray) -> tuple[float, float]:
    """Lower and upper bound of all entries in some intervals of these starts and lengths, (interval,)."""
    reach = np.abs(parts.pole)[:, None] * length
    series = sum(reach**k / math.factorial(k) for k in range(DEGREE + 1))
    growth = np.exp(parts.pole.real[:, None] * start) * series
    size = np.abs(parts.level)[:, None] + np.abs(parts.weight).T @ growth
    extra = (REMAINDER + 8 * np.finfo(float).eps * size).ravel()
    rows = (parts.taylor(start, length) @ _BERNSTEIN).reshape(-1, DEGREE + 1)
    interval = np.tile(np.arange(len(start)), len(parts.level))
    high, low = float((rows.max(1) + extra).max()), math.inf
    for deep in range(DEEPEST + 1):
        found = rows.min(1) - extra
        # values of T itself are the ends: where one is negative, no proof can come
        ends = np.minimum(rows[:, 0], rows[:, -1]) - extra
        given_up = np.isin(interval, interval[ends < -ROUNDING])
        if deep == DEEPEST or len(rows) > MOST_ROWS:
            given_up[:] = True
        open_ = (found < -ROUNDING) & ~given_up
        low = min(low, float(found[~open_].min(initial=math.inf)))
        if not open_.any():
            break
        rows, extra, interval = rows[open_], np.tile(extra[open_], 2), np.tile(interval[open_], 2)
        rows = np.concatenate([rows @ _LEFT, rows @ _RIGHT])
    return low, high
