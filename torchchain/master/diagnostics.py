"""Is the energy in the bands Markovian? Chapman-Kolmogorov test and implied timescales of a measured transfer.

For rates that do not depend on the past T(n lag) = T(lag)^n, and the eigenvalues of T(lag) are exp(-lag / timescale)
with timescales that no lag changes (Swope, Pitera and Suits, J. Phys. Chem. B 108, 6571, 2004; Prinz et al., J. Chem.
Phys. 134, 174105, 2011). The energy of a disordered chain passes neither test: some of it stays where it started.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import jackknife_error, statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer


@dataclass(frozen=True, eq=False)
class ChapmanKolmogorov:
    """Result of :func:`chapman_kolmogorov`.

    Attributes:
        lag: the lag time.
        times: multiples of it, (time,).
        measured: T(n lag), [source, time, receiver].
        predicted: T(lag)^n, [source, time, receiver].
        stderr: of their difference, by delete-one jackknife over blocks of realizations, [source, time, receiver].
        distance: total variation of the two, [source, time].
        statistical: what it would be if the chain were Markovian, [source, time].

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=[0.0, 8.0, 16.0, 32.0])
        >>> test = tc.chapman_kolmogorov(tc.band_transfer(scene, method="modes"), lag=8.0, multiples=(1, 2, 4))
        >>> tuple(test.measured.shape), tuple(test.distance.shape)
        ((8, 3, 8), (8, 3))
    """

    lag: float
    times: Tensor
    measured: Tensor
    predicted: Tensor
    stderr: Tensor

    @property
    def distance(self) -> Tensor:
        return total_variation(self.measured, self.predicted)

    @property
    def statistical(self) -> Tensor:
        return statistical_distance(self.stderr / 2**0.5)


def chapman_kolmogorov(
    transfer: BandTransfer, lag: float, multiples: Sequence[int] = (1, 2, 4, 8)
) -> ChapmanKolmogorov:
    """Compare T(n lag) with T(lag)^n.

    Args:
        transfer: of an ensemble, at the lag and its multiples, in at least two blocks of realizations.
        lag: time, above 0.
        multiples: n, increasing, at least 1.

    Raises:
        FieldError: if the transfer holds no such time.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=[0.0, 8.0, 16.0])
        >>> test = tc.chapman_kolmogorov(tc.band_transfer(scene, method="modes"), lag=8.0, multiples=(2,))
        >>> bool(test.distance.mean() > 3 * test.statistical.mean())  # the bands have a memory
        True
    """
    checks.instance("transfer", transfer, BandTransfer)
    lag = checks.number("lag", lag, above=0)
    if not checks.is_collection(multiples):
        raise checks.FieldTypeError(f"multiples must be integers, got {checks.shown(multiples)}")
    numbers = [checks.integer("multiples", n, 1) for n in multiples]
    if not numbers or any(b <= a for a, b in pairwise(numbers)):
        raise checks.fail("multiples", "be increasing", numbers)
    first = _at("lag", transfer, lag)
    places = [_at("multiples", transfer, n * lag) for n in numbers]

    def both(mean: Tensor) -> tuple[Tensor, Tensor]:
        step = mean[:, first]
        predicted = torch.stack([torch.linalg.matrix_power(step, n) for n in numbers], dim=1)
        return mean[:, places], predicted

    measured, predicted = both(transfer.mean)
    differences = torch.stack([a - b for a, b in map(both, without_one(transfer))])
    return ChapmanKolmogorov(lag, transfer.times[places], measured, predicted, jackknife_error(differences))


def implied_timescales(transfer: BandTransfer, lags: Any) -> tuple[Tensor, Tensor]:
    """Timescales -lag / log|eigenvalue of T(lag)|, slowest first, and their standard errors by jackknife over blocks.

    Args:
        transfer: of an ensemble, at all the lags, in at least two blocks of realizations.
        lags: times above 0, (lag,).

    Returns:
        timescales and standard errors, (lag, band - 1): the eigenvalue 1 of conserved energy is left out; infinite
        where noise has carried an eigenvalue to 1 or beyond.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=[0.0, 4.0, 8.0])
        >>> timescales, errors = tc.implied_timescales(tc.band_transfer(scene, method="modes"), [4.0, 8.0])
        >>> tuple(timescales.shape)
        (2, 7)
    """
    checks.instance("transfer", transfer, BandTransfer)
    lags = checks.times("lags", lags)
    places = [_at("lags", transfer, float(lag)) for lag in lags]
    checks.first_bad("lags", "be above 0", lags, lags <= 0)

    def scales(mean: Tensor) -> Tensor:
        size = torch.linalg.eigvals(mean[:, places].transpose(0, 1)).abs().sort(dim=-1, descending=True).values[:, 1:]
        return torch.where(size < 1, -lags[:, None] / size.clamp(max=1 - 1e-16).log(), torch.inf)

    value = scales(transfer.mean)
    rates = torch.stack([1 / scales(mean) for mean in without_one(transfer)])  # finite where scales are not
    return value, value.square().nan_to_num(posinf=torch.inf) * jackknife_error(rates)


def _at(name: str, transfer: BandTransfer, time: float) -> int:
    place = int((transfer.times - time).abs().argmin())
    if abs(float(transfer.times[place]) - time) > 1e-9 * max(1.0, time):
        raise checks.fail(name, "lead to times of the transfer", time)
    return place


def without_one(transfer: BandTransfer) -> Iterator[Tensor]:
    """The mean transfer without each block of realizations in turn."""
    counts = torch.tensor(transfer.block_counts, dtype=transfer.mean.dtype)
    if len(counts) < 2:
        raise checks.fail("transfer", "have at least 2 blocks of realizations", len(counts))
    whole = torch.einsum("b,bstr->str", counts, transfer.block_mean)
    for n, part in zip(counts, transfer.block_mean, strict=True):
        yield (whole - n * part) / (counts.sum() - n)
