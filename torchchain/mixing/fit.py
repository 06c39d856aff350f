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
SETTLED = 30.0
"""Time after which energies are compared: by then the harmonics that are carried along without resonance have come, a share in
proportion to the energy that no triad makes."""


@dataclass(frozen=True, eq=False)
class TriadFit:
    """A fit of couplings.

    Attributes:
        model: with the couplings G.
        stderr: of G by bootstrap over realizations and starts, (triad,); zero without one. Starts disagree by more than noise
            where one number a band does not tell enough.
        misfit: root mean square of what is left over, in units of its error.
        total_stderr: of the sum of G.

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
    total_stderr: float = 0.0


def fit_triads(*data: Mixing, bootstrap: int = 20) -> TriadFit:
    """Couplings G >= 0 of a :class:`TriadModel` from one measurement or several, whatever their amplitude.

    The rates are linear in G. Integrated along the measured mean energies they are the change of these, so that no derivative
    of noisy data is taken: e(t) - e(s) = sum over triads of G times the integral of J / G from s to t (Simpson's rule),
    weighed by the standard error plus 0.3 % of the total, from s = 30 on (the middle of shorter runs). Non-negative least squares: C. L. Lawson and R. J. Hanson,
    Solving Least Squares Problems (1974), by SciPy.

    Args:
        data: of the same bands.
        bootstrap: how often realizations and starts are drawn again for the standard error; 0 for none.

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
    coupling, misfit = _coupling([(entry.times, entry.energies) for entry in data], unit)
    draw = np.random.default_rng(data[0].scene.seed)
    again = [
        _coupling([(entry.times, _drawn(entry.energies, draw)) for entry in data], unit)[0] for _ in range(bootstrap)
    ]
    model = TriadModel(data[0].bands, density, coupling)
    if len(again) < 2:
        return TriadFit(model, torch.zeros_like(coupling), misfit)
    return TriadFit(model, torch.stack(again).std(0), misfit, float(torch.stack(again).sum(1).std()))


def _drawn(energies: Tensor, draw: np.random.Generator) -> Tensor:
    """As many realizations and starts, drawn with replacement."""
    rows, starts = (torch.from_numpy(draw.integers(0, n, n)) for n in energies.shape[:2])
    return energies[rows][:, starts]


def _coupling(data: list[tuple[Tensor, Tensor]], unit: TriadModel) -> tuple[Tensor, float]:
    """G and the misfit, from times and energies of each measurement; ``unit`` is the model of couplings 1."""
    matrix, change = [], []
    for times, energies in data:
        first = int((times < min(SETTLED, float(times[-1]) / 2)).sum())
        mean, stderr = energies.mean(0), energies.std(0) / math.sqrt(len(energies))
        flux = unit.flux(mean.clamp(min=0)).numpy()
        dose = torch.from_numpy(cumulative_simpson(flux, x=times.numpy(), axis=1, initial=0))
        later = slice(first + 1, None)
        weight = 1 / (stderr + CLOSURE * mean.sum(-1, keepdim=True))[:, later]
        made = (dose[:, later] - dose[:, first, None])[:, :, None] * unit.exchange.T  # (start, time, band, triad)
        matrix.append((weight[..., None] * made).flatten(0, 2))
        change.append((weight * (mean[:, later] - mean[:, first, None])).flatten())
    joined, target = torch.cat(matrix), torch.cat(change)
    coupling, residual = nnls(joined.numpy(), target.numpy(), maxiter=100 * joined.shape[1])
    return torch.from_numpy(coupling), residual / math.sqrt(len(target))
