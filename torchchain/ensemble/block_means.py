"""Block means of large transfers in whole steps finer than their noise, so that a file holds no noise to sixteen digits.

The deviations of the blocks from the mean are whole multiples of a unit: the power of two that is at most a sixth, and
more than a twelfth, of their own standard deviation. What rounding takes from one receiver the next one gets, from the
quietest to the noisiest, which holds what the others leave of a block's energy; the last block holds what the others
leave of the mean. So the blocks still average to the mean, and their energies add up as before. Rounding adds at most a
hundredth to the variance of a block.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

LARGE = 2**20
"""Numbers of block means from which on they are rounded; what is small is kept whole."""
FINENESS = 6.0
"""Standard deviations of a block to the unit, at least."""
REST = 2.0**-6
"""Unit of the sum over receivers, in units of the noisiest receiver."""
QUIET = 2.0**-40
"""Noise below this is that of rounding, and left out."""
ERROR_BITS = 12
"""Significant bits of a standard error, itself known to a few per cent."""
TOGETHER = 4
"""Sources that are rounded together and stay in cache."""


def rounded(blocks: Tensor, mean: Tensor, stderr: Tensor, counts: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Block means (block, source, time, receiver) and standard error (source, time, receiver) as large transfers keep them."""
    if blocks.numel() < LARGE:
        return blocks, stderr
    mantissa, _ = torch.frexp(stderr)
    kept = (mantissa * 2.0**ERROR_BITS).round() / 2.0**ERROR_BITS
    stderr = torch.where(stderr.isfinite() & (stderr > 0), stderr / mantissa * kept, stderr)
    found = torch.empty_like(blocks)
    for first in range(0, len(mean), TOGETHER):
        some = slice(first, first + TOGETHER)
        order, unit = _order(stderr[some], len(counts))
        whole = _steps(_sorted(blocks[:, some] - mean[some], order), unit, counts)
        found[:, some] = _unsorted(_deviations(whole, unit, counts), order).add_(mean[some])
    return found, stderr


def encoded(blocks: Tensor, mean: Tensor, stderr: Tensor, counts: Sequence[int]) -> np.ndarray | None:
    """Rounded block means as small integers for a file; None of those that are not rounded.

    Each whole step is foretold from the two times before; what is kept is what the forecast misses.
    """
    if blocks.dtype != torch.float64 or mean.dtype != torch.float64 or blocks.numel() < LARGE:
        return None
    order, units = _order(stderr, len(counts))
    whole = _unsorted(_steps(_sorted(blocks - mean, order), units, counts), order)
    if not torch.equal(_from_steps(whole, mean, stderr, counts), blocks):
        return None
    numbers, unit = whole.numpy(), _units(stderr, len(counts))
    missed = numbers.copy()
    for t in range(1, numbers.shape[2]):
        missed[:, :, t] -= _foretold(numbers, unit, t)
    largest = float(np.abs(missed).max())
    kinds = (np.int8, np.int16, np.int32, np.int64)
    return missed.astype(next(kind for kind in kinds if largest <= np.iinfo(kind).max))


def decoded(missed: np.ndarray, mean: Tensor, stderr: Tensor, counts: Sequence[int]) -> Tensor:
    """Block means from the integers of :func:`encoded`, the same to the last bit on every machine."""
    numbers, unit = missed.astype(np.float64), _units(stderr, len(counts))
    for t in range(1, numbers.shape[2]):
        numbers[:, :, t] += _foretold(numbers, unit, t)
    return _from_steps(torch.from_numpy(numbers), mean, stderr, counts)


def _foretold(numbers: np.ndarray, unit: np.ndarray, t: int) -> np.ndarray:
    """The whole steps at time t from those before: half the last change goes on."""
    last = numbers[:, :, t - 1] * unit[:, t - 1]
    if t > 1:
        last = 1.5 * last - 0.5 * numbers[:, :, t - 2] * unit[:, t - 2]
    return np.rint(np.divide(last, unit[:, t], out=np.zeros_like(last), where=unit[:, t] > 0))


def _steps(apart: Tensor, unit: Tensor, counts: Sequence[int]) -> Tensor:
    """Deviations of the blocks from the mean in whole steps: the inverse of :func:`_deviations`."""
    inverse = torch.where(unit > 0, 1 / unit, 0)
    found = torch.empty_like(apart)
    early, carried = apart[:, :-1], torch.zeros_like(apart[0, :-1])
    for r in range(len(apart) - 1):
        carried += early[r]
        torch.mul(carried, inverse[r], out=found[r, :-1]).round_()
        carried -= found[r, :-1] * unit[r]
    found[-1, :-1] = (early.sum(0) * (inverse[-1] / REST)).round()
    found[:, -1] = ((_others(apart, counts) + apart[:, -1]) * inverse).round()
    return found


def _deviations(whole: Tensor, unit: Tensor, counts: Sequence[int]) -> Tensor:
    """Deviations (receiver in order, block, source, time) from whole steps of the same axes, in their place.

    In the place of the noisiest receiver is the sum over receivers, in that of the last block the weighted sum over blocks.
    """
    rest = whole[-1, :-1] * (unit[-1] * REST)
    whole *= unit[:, None]
    for r in range(len(whole) - 1):
        rest -= whole[r, :-1]
    whole[-1, :-1] = rest
    whole[:, -1] -= _others(whole, counts)
    return whole


def _from_steps(whole: Tensor, mean: Tensor, stderr: Tensor, counts: Sequence[int]) -> Tensor:
    """Block means from whole steps, both (block, source, time, receiver)."""
    order, unit = _order(stderr, len(counts))
    return _unsorted(_deviations(_sorted(whole, order), unit, counts), order).add_(mean)


def _others(apart: Tensor, counts: Sequence[int]) -> Tensor:
    """Sum over all blocks but the last, in weights of the last, of (receiver, block, source, time)."""
    total = torch.zeros_like(apart[:, 0])
    for block, count in enumerate(counts[:-1]):  # one after the other, so that every machine rounds the same
        total += apart[:, block] if count == counts[-1] else apart[:, block] * (count / counts[-1])
    return total


def _units(stderr: Tensor, blocks: int) -> np.ndarray:
    """The unit of every deviation, (source, time, receiver); 0 where there is no noise, or no error is known."""
    size = torch.nan_to_num(stderr * (math.sqrt(blocks) / FINENESS), nan=0.0, posinf=0.0).numpy()
    return np.where(size > QUIET, np.ldexp(1.0, np.frexp(size)[1] - 1), 0.0)


def _order(stderr: Tensor, blocks: int) -> tuple[Tensor, Tensor]:
    """Receivers from quiet to noisy (source, time, receiver), and their units in that order (receiver, source, time)."""
    order = stderr.argsort(dim=-1, stable=True)
    return order, torch.from_numpy(_units(stderr, blocks)).gather(-1, order).movedim(-1, 0).contiguous()


def _sorted(values: Tensor, order: Tensor) -> Tensor:
    """(receiver, block, source, time) with receivers in order, of (block, source, time, receiver)."""
    return values.gather(-1, order.expand(values.shape)).movedim(-1, 0).contiguous()


def _unsorted(values: Tensor, order: Tensor) -> Tensor:
    """The inverse of :func:`_sorted`."""
    moved = values.movedim(0, -1).contiguous()
    return torch.empty_like(moved).scatter_(-1, order.expand(moved.shape), moved)
