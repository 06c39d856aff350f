"""Errors that the predictions from several sources share: a model errs alike for neighboring bands, and energy that is missing in one is in another.

Of a mixture of sources with the energies p, the error has the variance p' C p, with C the covariance of the sources' errors
in one receiver at one time. It is kept as a few factors beside what every source has for itself (Thurstone 1931; Rao 1955).
"""

from __future__ import annotations

import torch
from torch import Tensor

FACTORS, GROUPS = 2, 8
"""Factors, and groups of kept times with the same ones: with 3 or 6, or 6 or 64 groups, mixtures are told as well."""


def group_of(count: int) -> Tensor:
    """The group of each of the kept times, (time,)."""
    groups = min(GROUPS, count)
    return torch.arange(count) * groups // count


def factors(spread: Tensor, missed: Tensor, off: Tensor, error: Tensor) -> Tensor:
    """Part of each standard error that is a factor's, [factor, source, group, receiver]; of squares that add up to 1 at most.

    The covariance is that of models of ensembles drawn again, and of what the model misses its own ensemble by, less what
    noise explains of it: as for the variances, see :mod:`torchchain.master.misfit`.

    Args:
        spread, missed: deviations of the models of ensembles drawn again from their mean, and of what these miss them by,
            [replica, source, time, receiver].
        off: by how much the model misses its ensemble, [source, time, receiver].
        error: standard error of the model, which the former are counted in.
    """
    n, count, _ = error.shape
    unit = torch.where(error > 0, error, torch.ones_like(error))
    group = group_of(count).to(error.device)
    found = error.new_zeros(min(FACTORS, n), n, int(group[-1]) + 1, n)
    for i in range(found.shape[2]):
        here = group == i
        one, two, three = (x[..., here, :] / unit[:, here] for x in (spread, missed, off[None]))
        replicas = max(len(spread) - 1, 1)
        weighted = ((one, 1 / replicas), (three, 1.0), (two, -1 / replicas))
        covariance = torch.stack([weight * torch.einsum("kstr,kutr->rsu", x, x) for x, weight in weighted]).sum(0)
        size = covariance.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt()  # [receiver, source]
        both = size[:, :, None] * size[:, None, :]
        correlation = torch.where(
            both > 0, covariance / both.clamp(min=torch.finfo(both.dtype).tiny), torch.zeros_like(both)
        )
        values, vectors = torch.linalg.eigh(correlation.clamp(-1, 1))
        parts = (
            vectors[..., -len(found) :] * values[:, None, -len(found) :].clamp(min=0).sqrt()
        )  # [receiver, source, factor]
        parts = parts / parts.square().sum(-1, keepdim=True).clamp(min=1).sqrt()
        parts = parts * torch.where(parts.sum(1, keepdim=True) < 0, -1.0, 1.0)  # the sign is free
        found[:, :, i] = parts.permute(2, 1, 0)
    return found


def variance(amplitudes: list[tuple[Tensor, Tensor]], shared: Tensor | None) -> Tensor:
    """Variance of a sum over sources, (*batch, time, receiver).

    Args:
        amplitudes: pairs of a weight of each source, (*batch, source), and an error, [source, time, receiver]; all errors
            of one source are the same error, and add up.
        shared: part of a factor in it, [factor, source, time, receiver]; None for sources that err independently.
    """
    rest = None if shared is None else 1 - shared.square().sum(0)
    total: Tensor | float = 0.0
    for i, (first, one) in enumerate(amplitudes):
        for j, (second, two) in enumerate(amplitudes[i:]):
            both = one * two if rest is None else one * two * rest
            total = total + (1 + (j > 0)) * torch.einsum("...s,str->...tr", first * second, both)
    for factor in () if shared is None else shared:
        alike = [torch.einsum("...s,str->...tr", w, x * factor) for w, x in amplitudes]
        total = total + torch.stack(alike).sum(0).square()
    assert isinstance(total, Tensor), "there is a source"
    return total.clamp(min=0)
