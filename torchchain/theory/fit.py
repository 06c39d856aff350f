"""The inverse problem: strength of the disorder, and contact damping, from band energies of a few chains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import scipy

from torchchain import checks
from torchchain.chain import Disorder
from torchchain.energy.bands import band_of, center_tones
from torchchain.theory.transfer import theory_transfer

WEAKEST, STRONGEST = 0.005, 0.8  # xi
_MOST_DAMPING = 1.0  # contact damping coefficient
_STEP = 0.01  # of the finite differences, relative


@dataclass(frozen=True)
class DisorderFit:
    """Disorder that explains measured band energies best.

    Attributes:
        strength, strength_stderr: xi and its standard error.
        damping, damping_stderr: contact damping; 0 and 0 where it was not fitted.
        misfit: root mean square of the residuals over their expected size, 1 for a fit within the errors.
        evaluations: transfers computed.

    Example:
        >>> found = tc.theory.DisorderFit(0.21, 0.02, 0.0, 0.0, misfit=1.0, evaluations=12)
        >>> abs(found.strength - 0.2) < found.strength_stderr
        True
    """

    strength: float
    strength_stderr: float
    damping: float
    damping_stderr: float
    misfit: float
    evaluations: int


def fit_disorder(
    times: Any,
    energies: Any,
    n_particles: int,
    n_bands: int,
    tones: Sequence[int] | None = None,
    kind: str = "normal",
    lower: float = 0.05,
    fit_damping: bool = False,
    guess: float = 0.2,
) -> DisorderFit:
    """Strength of mass disorder (and contact damping) from a transfer or one decay curve, by least squares on the theory.

    Weighted by the ensemble's variance and the theory's own systematic error. The standard error is the spread of what
    each realization adds to the estimate (the sandwich estimator, which does not mind that energies of one chain at
    neighboring times are correlated), and in quadrature what the systematic error would move the estimate by.

    Args:
        times: (time,).
        energies: share of the energy at the start, (realization, time) in the source's own band, of one source; or
            (realization, source, time, receiver).
        n_particles: N.
        n_bands: B.
        tones: the sources; None for the center tone of every band.
        kind, lower: law of the masses, see :class:`Disorder`.
        fit_damping: fit contact damping too.
        guess: of the strength.

    Returns:
        DisorderFit.

    Raises:
        FieldError: for energies of another shape, or fewer than 2 realizations.

    Example:
        >>> import torch, torchchain as tc
        >>> chain = tc.Chain(tc.Disorder(strength=0.2).masses(64, 40, seed=1))
        >>> times = torch.arange(0.0, 30.0, 3.0)
        >>> motion = tc.evolve(chain, tc.standing_wave(chain, tone=22), times)
        >>> fit = fit_disorder(times, tc.band_energy(chain, motion, 8)[..., 5], 64, 8, tones=[22])
        >>> abs(fit.strength - 0.2) < 2 * fit.strength_stderr
        True
    """
    times = checks.times("times", times)
    measured = checks.real_tensor("energies", energies)
    found = center_tones(n_particles, n_bands) if tones is None else tuple(tones)
    curve = measured.ndim == 2
    shape = (len(times),) if curve else (len(found), len(times), n_bands)
    if tuple(measured.shape[1:]) != shape or (curve and len(found) != 1) or len(measured) < 2:
        words = f"have shape (realization, {', '.join(map(str, shape))}), 2 realizations or more"
        if curve and len(found) != 1:
            words += ", and one tone where it is a decay curve"
        raise checks.fail("energies", words, f"shape {tuple(measured.shape)} for {len(found)} tones")
    start = checks.number("guess", guess, at_least=WEAKEST, at_most=STRONGEST)
    disorder = Disorder(kind=kind, strength=start, lower=lower)
    band = band_of(found[0], n_particles, n_bands) - 1
    data = measured.detach().cpu().double().numpy().reshape(len(measured), -1)
    mean, variance = data.mean(0), _pooled(data.var(0, ddof=1) / len(data), curve, shape, found, n_particles)

    @cache
    def model(*parameters: float) -> tuple[np.ndarray, np.ndarray]:
        strength = min(max(math.exp(parameters[0]), WEAKEST), STRONGEST)
        damping = parameters[1] if fit_damping else 0.0
        result = theory_transfer(
            replace(disorder, strength=strength), n_particles, n_bands, times, found, damping=max(damping, 0.0)
        )
        # Spread a distance of total variation over the bands: half of it is the source's own.
        if curve:
            return result.mean[0, :, band].numpy(), result.systematic[0].numpy()
        error = result.systematic[..., None] * (2.0 / n_bands)
        return result.mean.numpy().ravel(), error.expand_as(result.mean).numpy().ravel()

    first = np.array([math.log(start)] + [0.01] * fit_damping)
    bounds = (
        np.array([math.log(WEAKEST)] + [0.0] * fit_damping),
        np.array([math.log(STRONGEST)] + [_MOST_DAMPING] * fit_damping),
    )
    parameters = first
    for _ in range(2):  # the weights follow the systematic error at the estimate
        _, systematic = model(*parameters)
        weight = 1 / np.sqrt(variance + systematic**2 + 1e-10)
        solution = scipy.optimize.least_squares(
            lambda p, weight=weight: (model(*p)[0] - mean) * weight,
            parameters, bounds=bounds, diff_step=_STEP, xtol=3e-4, ftol=1e-5, max_nfev=12, x_scale=np.array([1.0, 0.1])[: len(first)],
        )  # fmt: skip
        parameters = solution.x
    gain = np.linalg.pinv(solution.jac) * weight  # estimate's change with the data, (parameter, datum)
    influence = (data - mean) @ gain.T
    noise = (influence**2).sum(0) / (len(data) * (len(data) - 1))
    _, systematic = model(*parameters)
    # Systematic errors at different times and bands do not all have one sign: as if a tenth of them were independent.
    bias = 10 * (gain**2 @ systematic**2)
    error = np.sqrt(noise + bias)
    strength = math.exp(parameters[0])
    misfit = math.sqrt(float((solution.fun**2).mean()))
    damped = (float(parameters[1]), float(error[1])) if fit_damping else (0.0, 0.0)
    return DisorderFit(strength, strength * float(error[0]), *damped, misfit, model.cache_info().misses)


def _pooled(
    variance: np.ndarray, curve: bool, shape: tuple[int, ...], tones: Sequence[int], n_particles: int
) -> np.ndarray:
    """Variances pooled over neighboring times and sources, and over all bands but the source's own.

    Those of a few chains are large where their energies are large: weights by them would pull the estimate down, and
    make its error look smaller than it is.
    """
    if curve:
        return scipy.ndimage.uniform_filter(variance, 5, mode="nearest")
    bands = np.array([band_of(tone, n_particles, shape[2]) - 1 for tone in tones])
    cube = variance.reshape(shape)
    rows = np.arange(len(tones))
    own = cube[rows, :, bands]
    mean = (cube.sum(-1) - own) / max(shape[2] - 1, 1)
    pooled = np.repeat(scipy.ndimage.uniform_filter(mean, 5, mode="nearest")[..., None], shape[2], axis=-1)
    pooled[rows, :, bands] = scipy.ndimage.uniform_filter(own, 5, mode="nearest")
    return pooled.ravel()
