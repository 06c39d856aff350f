"""Rates from short times: Eq. 50, and the linear and nonlinear procedures of Section 3.5."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain import checks

WINDOW = (0.5, 2.0)
"""First and last time of the straight lines of procedure L, in travel times of sound over one particle."""


class FitWarning(UserWarning):
    """Some entries of a fit did not converge.

    Example:
        >>> import warnings
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=4), method="modes")
        >>> with warnings.catch_warnings(record=True) as told:
        ...     warnings.simplefilter("always")
        ...     _ = tc.calibrate(transfer, method="nonlinear")
        >>> any(issubclass(warning.category, tc.FitWarning) for warning in told)
        True
    """


@dataclass(frozen=True)
class AnalyticReport:
    """q0 of Eq. 50 and its standard error.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40)
        >>> report = tc.calibrate(tc.band_transfer(scene, method="modes"), method="analytic", bootstrap=0).calibration.report.fit
        >>> 0 < report.q0_stderr < report.q0
        True
    """

    q0: float
    q0_stderr: float


@dataclass(frozen=True)
class NonlinearReport:
    """Pairs of bands (source, receiver), counted from 1, in which the fit did not converge.

    Example:
        >>> tc.master.NonlinearReport(unconverged=((1, 2),))
        NonlinearReport(unconverged=((1, 2),))
    """

    unconverged: tuple[tuple[int, int], ...]


def checked_window(window: tuple[float, float] | list[float]) -> tuple[float, float]:
    """First and last time of a fit, if they are two times in order."""
    if not isinstance(window, (tuple, list)) or len(window) != 2:
        raise checks.FieldTypeError(f"window must be two times, got {checks.shown(window)}")
    begin = checks.number("window", window[0], at_least=0)
    return begin, checks.number("window", window[1], above=begin)


def within(times: Tensor, window: tuple[float, float], at_least: int) -> Tensor:
    """Which times lie in the window; an error if fewer than ``at_least`` do."""
    inside = (times >= window[0] - 1e-9) & (times <= window[1] + 1e-9)
    if int(inside.sum()) < at_least:
        raise checks.fail(
            "window", f"hold at least {at_least} of the transfer's times", f"{int(inside.sum())} in {window}"
        )
    return inside


def linear_rates(times: Tensor, mean: Tensor, free: Tensor, window: tuple[float, float]) -> Tensor:
    """Slope of a straight line through the energies in the window, per free energy of the source (procedure L).

    Args:
        times: (time,).
        mean: [source, time, receiver].
        free: share of the energy of each source that can move, 1 - Psi, [source].
        window: first and last time.

    Returns:
        Q [source, receiver]. Rows sum to zero to rounding, because the energies sum to 1 at every time.
    """
    inside = within(times, window, 2)
    change = mean[:, inside] - mean[:, inside][:, :1]  # exactly zero where nothing moves, whatever the free share
    return torch.einsum("t,str->sr", linear_weights(times, window)[inside], change) / free[:, None]


def linear_weights(times: Tensor, window: tuple[float, float]) -> Tensor:
    """Weight of every time, (time,), in the slope of the straight line through the values in the window."""
    inside = within(times, window, 2)
    t = torch.where(inside, times - times[inside].mean(), 0.0)
    return t / t.square().sum()


def linear_delay(times: Tensor, mean: Tensor, window: tuple[float, float]) -> Tensor:
    """t0 of Section 3.5, scalar: where the lines of procedure L, drawn back from the window, reach the start.

    The mean over the sources' own bands, each weighted with its loss rate; no less than a hundredth of the window's
    beginning or end.
    """
    inside = within(times, window, 2)
    t = times[inside] - times[inside].mean()
    own = mean[:, inside].diagonal(dim1=0, dim2=2).T  # [source, time]
    slope = (own @ t) / t.square().sum()
    lost = own.mean(-1) - 1 - slope * times[inside].mean()  # the line at time 0, minus the start
    return (-(lost * slope).sum() / slope.square().sum().clamp(min=1e-300)).clamp(min=0.01 * window[1], max=window[1])


def profile(n_bands: int) -> Tensor:
    """sin^2(pi min(s, r) / (2 B)) off the diagonal, minus the row sum on it: Eq. 50 for q0 = 1, [source, receiver]."""
    band = torch.arange(1, n_bands + 1, dtype=torch.float64)
    shape = torch.sin(math.pi / (2 * n_bands) * torch.minimum(band[:, None], band)).square()
    shape.fill_diagonal_(0)
    return shape - torch.diag(shape.sum(-1))


def analytic_prefactor(rates: Tensor) -> tuple[float, float]:
    """q0 of Eq. 50 by least squares on the rates between different bands, and its standard error."""
    n = len(rates)
    other = ~torch.eye(n, dtype=torch.bool)
    shape, values = profile(n)[other], rates[other]
    if n == 1:
        return 0.0, 0.0
    weight = float(shape.square().sum())
    q0 = float((shape * values).sum()) / weight
    spread = float((values - q0 * shape).square().sum()) / max(1, len(values) - 1)
    return q0, math.sqrt(spread / weight)


def nonlinear_rates(
    times: Tensor, mean: Tensor, free: Tensor, window: tuple[float, float], progress: Any = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Exponential decay of the source and exponential rise of the others, fitted in the window (procedure NL).

    Source: (1 - y) exp(x (t - t0)) + y, rate (1 - y) x. Receiver: y (1 - exp(-x (t - t0))), rate x y. Both are
    the slope at t = t0, per free energy of the source.

    A fit counts as converged if the solver stops regularly, x has the sign of a saturating curve and lies
    between a tenth of the window's inverse length and the inverse of its time step, and the rate's standard error is below
    the rate. The energies of other entries are as good as straight in the window, or too noisy, and tell no saturation.

    Args:
        times, mean, free, window: see :func:`linear_rates`.
        progress: called with 1 after every fit.

    Returns:
        rates [source, receiver], zero where the fit did not converge; whether it converged, bool [source,
        receiver]; t0 [source, receiver].
    """
    inside = within(times, window, 4)
    t = times[inside].numpy()
    slowest, fastest = 0.1 / (t[-1] - t[0]), 1 / np.diff(t).min()
    n = mean.shape[0]
    rates, onset = torch.zeros(n, n, dtype=torch.float64), torch.zeros(n, n, dtype=torch.float64)
    converged = torch.zeros(n, n, dtype=torch.bool)
    for s in range(n):
        for r in range(n):
            sign = 1.0 if s == r else -1.0
            y = mean[s, inside, r].numpy()
            fit = _exponential(t, y if s == r else -y, 1.0 if s == r else 0.0)
            if fit is not None:
                slope, speed, t0, error = fit
                if slowest <= -speed <= fastest and error < abs(slope):
                    converged[s, r], rates[s, r], onset[s, r] = True, sign * slope, t0
            if progress is not None:
                progress(1)
    return rates / free[:, None], converged, onset


def _exponential(t: np.ndarray, y: np.ndarray, level: float) -> tuple[float, float, float, float] | None:
    """Fit (level - c) exp(x (t - t0)) + c; returns slope at t0, x, t0 and the slope's standard error."""

    def curve(t: np.ndarray, slope: float, x: float, t0: float) -> np.ndarray:
        # (level - c) = slope / x: written by the slope at t0, which the data fix best
        return level + slope / x * np.expm1(x * (t - t0))

    def jacobian(t: np.ndarray, slope: float, x: float, t0: float) -> np.ndarray:
        e = np.exp(x * (t - t0))
        return np.stack([(e - 1) / x, slope / x * ((t - t0) * e - (e - 1) / x), -slope * e], axis=1)

    line = np.polyfit(t, y, 1)
    if abs(line[0]) * (t[-1] - t[0]) <= 1e-12 * np.abs(y).max():  # flat to rounding
        return None
    t0 = float(np.clip((level - line[1]) / line[0], 0.0, t[0]))
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("error", scipy.optimize.OptimizeWarning)
            best, covariance = scipy.optimize.curve_fit(
                curve, t, y, p0=(line[0], -0.5 / (t[-1] - t[0]), t0), jac=jacobian, maxfev=200
            )
    except (RuntimeError, ValueError, scipy.optimize.OptimizeWarning):
        return None
    error = float(np.sqrt(max(covariance[0, 0], 0.0)))
    return float(best[0]), float(best[1]), float(best[2]), error if math.isfinite(error) else math.inf
