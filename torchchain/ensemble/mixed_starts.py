"""The transfer between bands from runs whose starts are spread over several bands: impulses, packets, random states."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import jackknife_error

LARGEST_CONDITION = 1e3
"""Of the least-squares problem; noise in the energies grows by up to this factor in the transfer."""
MOST_BLOCKS = 20


@dataclass(frozen=True, eq=False)
class FittedTransfer:
    """Transfer T of the runs E(run, t) = sum_s x(run, s) T(s, t), by least squares.

    Attributes:
        mean: T [source, time, receiver].
        stderr: its standard error, from leaving out one block of realizations at a time.
        block_mean: pseudo-values of the blocks [block, source, time, receiver], whose mean is near ``mean``.
        block_counts: realizations of each block.
        condition: ratio of the largest and the smallest singular value of the starts x, each source scaled to unit size.
    """

    mean: Tensor
    stderr: Tensor
    block_mean: Tensor
    block_counts: tuple[int, ...]
    condition: float


def fit_transfer(starts: Tensor, energies: Tensor, realization: Tensor) -> FittedTransfer:
    """The transfer that explains the energies of all runs best.

    Energies of bands add up over the bands of the start where the waves in them are not correlated, which disorder and
    random phases see to (and T is defined by). Rows of T sum to one where those of the runs do.

    Args:
        starts: x, energy of every band at time 0, (run, band).
        energies: energy of every band at every time, (run, time, band).
        realization: number of the chain of every run, (run,); runs of one chain are not independent.

    Returns:
        FittedTransfer.

    Raises:
        FieldError: if the starts leave a band without energy, or do not tell the bands apart.
    """
    starts = checks.real_tensor("starts", starts).double()
    energies = checks.real_tensor("energies", energies).double()
    if starts.ndim != 2 or energies.ndim != 3 or len(starts) != len(energies) or starts.shape[1] != energies.shape[2]:
        rule = f"have shape (run, time, band) that fits starts {tuple(starts.shape)}"
        raise checks.fail("energies", rule, energies)
    condition = condition_of(starts)
    chains = torch.unique(realization)
    blocks = min(MOST_BLOCKS, len(chains))
    parts = chains.tensor_split(blocks)

    def without(block: int) -> Tensor:
        kept = ~torch.isin(realization, parts[block])
        _check_left(starts, kept, realization)
        return _solved(starts[kept], energies[kept])

    return _jackknife(_solved(starts, energies), without, tuple(len(part) for part in parts), condition)


def _jackknife(
    mean: Tensor, without: Callable[[int], Tensor], counts: tuple[int, ...], condition: float
) -> FittedTransfer:
    """The transfer with the error and the pseudo-values of those without one block each; of one block it has none."""
    blocks = len(counts)
    if blocks < 2:
        return FittedTransfer(mean, torch.full_like(mean, torch.inf), mean[None], counts, condition)
    replicates = torch.stack([without(block) for block in range(blocks)])
    pseudo = blocks * mean - (blocks - 1) * replicates
    return FittedTransfer(mean, jackknife_error(replicates), pseudo, counts, condition)


def _check_left(starts: Tensor, kept: Tensor, realization: Tensor) -> None:
    """An error that counts chains where the runs that are kept for a standard error do not tell the bands apart."""
    try:
        condition_of(starts[kept])
    except checks.FieldError as error:
        sizes, n = starts.norm(dim=0), len(torch.unique(realization))
        share = starts[kept].norm(dim=0) / sizes
        band = int(share.argmin())
        on = len(torch.unique(realization[starts[:, band] > 1e-6 * sizes[band]]))
        rule = "excite every band in runs on at least 2 chains, as standard errors leave out some at a time"
        if on < 2:
            raise checks.fail("starts", rule, f"band {band + 1} on {on} of {n} chains") from None
        raise checks.fail(
            "starts", f"tell the bands apart without any one of {n} chains ({rule})", str(error)
        ) from None


def condition_of(starts: Tensor) -> float:
    """Condition number of the least-squares problem for starts (run, band), each band scaled to unit size.

    Raises:
        FieldError: if it is hopeless, naming the band that has least energy or the condition.
    """
    sizes = starts.norm(dim=0)
    weakest = int(sizes.argmin())
    if not float(sizes[weakest]) > 1e-6 * float(sizes.max()):
        raise checks.fail("starts", "excite every band in some run", f"none in band {weakest + 1}")
    singular = torch.linalg.svdvals(starts / sizes)
    condition = float(singular[0] / singular[-1]) if len(starts) >= starts.shape[1] else math.inf
    if not condition < LARGEST_CONDITION:
        rule = f"tell the {starts.shape[1]} bands apart (a condition number of at most {LARGEST_CONDITION:g})"
        words = "infinite" if math.isinf(condition) else f"{condition:.3g}"
        raise checks.fail("starts", rule, f"{words} with {len(starts)} runs")
    return condition


def _solved(starts: Tensor, energies: Tensor) -> Tensor:
    flat = energies.reshape(len(energies), -1)
    solution = torch.linalg.lstsq(starts, flat, driver="gelsd").solution
    return solution.reshape(starts.shape[1], *energies.shape[1:])


def unmixed(block_mean: Tensor, block_counts: Sequence[int]) -> FittedTransfer:
    """The transfer T of runs that every realization makes alike, from their mean energies: E(run, t) = sum_s E(run, s, 0) T(s, t).

    Energies add up on average, so that the means over the realizations are enough.

    Args:
        block_mean: E of blocks of realizations, [block, run, time, band], as many runs as bands, the first time being 0.
        block_counts: realizations of each.

    Returns:
        FittedTransfer, its errors by leaving out one block at a time.

    Raises:
        FieldError: if the runs do not tell the bands apart.
    """
    counts = torch.tensor(block_counts, dtype=block_mean.dtype)[:, None, None, None]
    total = (counts * block_mean).sum(0)

    def solved(energies: Tensor) -> Tensor:
        return torch.linalg.solve(energies[:, 0], energies.flatten(1)).reshape(energies.shape)

    parts, condition = counts * block_mean, condition_of(total[:, 0])
    return _jackknife(solved(total), lambda block: solved(total - parts[block]), tuple(block_counts), condition)
