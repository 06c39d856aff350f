"""The error of a model itself: by how much it misses its own ensemble beyond what the ensemble's error explains."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from torchchain import checks

TIMES, BANDS = 2, 2
"""Neighbors on either side over which the model's error is averaged."""
ROUNDING = 1e-14
"""Errors of a share of the energy that are none, at time 0 and just after."""


def model_error(predicted: Tensor, mean: Tensor, stderr: Tensor, noise: Tensor) -> Tensor:
    """Standard error of a model beyond its statistical one, [source, time, receiver].

    What is missed is counted in units of the ensemble's error, which grows as t^4 at first, and averaged over neighbors: the
    source's own band, which holds most of the energy, with the own bands of neighboring sources, the others among
    themselves. An average over all bands would hide what the own band is missed by.

    Args:
        predicted, mean: the model's and the ensemble's transfer, [source, time, receiver].
        stderr: standard error of the ensemble's.
        noise: standard deviation of their difference by the ensemble's noise alone: less than ``stderr`` where the model
            has followed that noise.
    """
    for name, value in (("mean", mean), ("stderr", stderr), ("noise", noise)):
        checks.shaped(name, value, tuple(predicted.shape))
    variance = stderr.square()
    told = variance > ROUNDING**2
    unit = torch.where(told, variance, torch.ones_like(variance))
    excess = ((predicted - mean).square() - noise.square()) / unit
    own = torch.eye(len(mean), dtype=torch.bool, device=mean.device)[:, None].expand_as(mean)
    others, size, edge = (~own).to(excess), (2 * TIMES + 1, 2 * BANDS + 1), (TIMES, BANDS)
    table = excess.diagonal(dim1=0, dim2=2)[None]  # [1, time, source]
    kept = functional.avg_pool2d(table, size, 1, edge, count_include_pad=False)[0].T
    total, count = (functional.avg_pool2d(x, size, 1, edge) for x in (excess * others, others))
    smooth = torch.where(own, kept[:, :, None], total / count.clamp(min=1e-12))
    return (smooth.clamp(min=0) * unit).sqrt() * told
