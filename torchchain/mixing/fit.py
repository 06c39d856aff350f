"""The coupling of every triad from measured energies, by non-negative least squares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.integrate import cumulative_simpson
from scipy.optimize import nnls
from torch import Tensor

from torchchain import checks
from torchchain.mixing.measure import Mixing
from torchchain.mixing.triads import TriadModel, triads_of

CLOSURE = 0.003
"""Share of the energy by which bands, each described by one number, miss the chains: added to the standard error."""


@dataclass(frozen=True, eq=False)
class TriadFit:
    """A fit of couplings.

    Attributes:
        model: with the couplings G.
        stderr: of G by bootstrap over realizations, (triad,); zero without one.
        misfit: root mean square of what is left over, in units of its error.

    Example:
        >>> scene = tc.Scene(n_particles=32, boundary="fixed", n_bands=4, realizations=8)
        >>> data = tc.mixing.measure_mixing(scene, 0.1, tc.mixing.FrequencyBands(4), times=torch.linspace(0, 100, 9))
        >>> fit = tc.mixing.fit_triads(data)
        >>> bool((fit.model.coupling >= 0).all()), len(fit.stderr) == fit.model.n_parameters
        (True, True)
    """

    model: TriadModel
    stderr: Tensor
    misfit: float


def fit_triads(*data: Mixing, bootstrap: int = 20) -> TriadFit:
    """Couplings G >= 0 of a :class:`TriadModel` from one measurement or several, whatever their amplitude.

    The rates are linear in G. Integrated from time 0 along the measured mean energies they are the change of these, so
    that no derivative of noisy data is taken: e(t) - e(0) = sum over triads of G times the integral of J / G (Simpson's
    rule), weighed by the standard error plus 0.3 % of the total. Non-negative least squares: C. L. Lawson and R. J. Hanson,
    Solving Least Squares Problems (1974), by SciPy.

    Args:
        data: of the same bands.
        bootstrap: how often realizations are drawn again for the standard error; 0 for none.

    Raises:
        FieldError: for none or for different bands, fewer than 3 times, or too few realizations.

    Example:
        >>> scene = tc.Scene(n_particles=32, boundary="fixed", n_bands=4, realizations=8)
        >>> bands, times = tc.mixing.FrequencyBands(4), torch.linspace(0, 100, 9)
        >>> weak, strong = (tc.mixing.measure_mixing(scene, a, bands, times=times) for a in (0.05, 0.1))
        >>> tc.mixing.fit_triads(weak, strong, bootstrap=0).model.n_parameters
        9
    """
    if not data:
        raise checks.fail("data", "be at least one measurement", "none")
    bootstrap = checks.integer("bootstrap", bootstrap, 0, 10_000)
    for entry in data:
        checks.instance("data", entry, Mixing)
        if entry.bands != data[0].bands:
            raise checks.fail("data", f"share the bands {data[0].bands}", entry.bands)
        if len(entry.times) < 3 or float(entry.times[0]) != 0:
            raise checks.fail("data.times", "be at least 3 from 0 on", len(entry.times))
        checks.integer("data.realizations", len(entry.energies), 2)
    density = torch.stack([entry.density for entry in data]).mean(0)
    unit = TriadModel(data[0].bands, density, torch.ones(len(triads_of(data[0].bands)[0])))
    coupling, misfit = _coupling(data, unit, [torch.arange(len(entry.energies)) for entry in data])
    draw = np.random.default_rng(data[0].scene.seed)
    again = [
        _coupling(data, unit, [torch.from_numpy(draw.integers(0, n, n)) for n in (len(d.energies) for d in data)])[0]
        for _ in range(bootstrap)
    ]
    stderr = torch.stack(again).std(0) if len(again) > 1 else torch.zeros_like(coupling)
    return TriadFit(TriadModel(data[0].bands, density, coupling), stderr, misfit)


def _coupling(data: tuple[Mixing, ...], unit: TriadModel, chosen: list[Tensor]) -> tuple[Tensor, float]:
    """G and the misfit, from the chosen realizations of each measurement; ``unit`` is the model of couplings 1."""
    matrix, change = [], []
    for entry, rows in zip(data, chosen, strict=True):
        energies = entry.energies[rows]
        mean, stderr = energies.mean(0), energies.std(0) / math.sqrt(len(energies))
        flux = unit.flux(mean.clamp(min=0)).numpy()
        dose = torch.from_numpy(cumulative_simpson(flux, x=entry.times.numpy(), axis=1, initial=0))
        weight = 1 / (stderr + CLOSURE * mean.sum(-1, keepdim=True))[:, 1:]
        made = dose[:, 1:, None, :] * unit.exchange.T  # (start, time, band, triad)
        matrix.append((weight[..., None] * made).flatten(0, 2))
        change.append((weight * (mean[:, 1:] - mean[:, :1])).flatten())
    joined, target = torch.cat(matrix), torch.cat(change)
    coupling, residual = nnls(joined.numpy(), target.numpy(), maxiter=100 * joined.shape[1])
    return torch.from_numpy(coupling), residual / math.sqrt(len(target))
