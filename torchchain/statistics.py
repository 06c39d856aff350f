"""Mean and standard error over realizations, the same to the last bit however the realizations are cut into chunks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Moments:
    """Count, mean and sum of squared deviations of realizations; mean and sum have the shape of one of them."""

    count: int
    mean: Tensor
    squares: Tensor

    @property
    def stderr(self) -> Tensor:
        """Standard error of the mean; infinite for a single realization, whose error nothing tells."""
        if self.count < 2:
            return torch.full_like(self.mean, torch.inf)
        return (self.squares / (self.count - 1) / self.count).sqrt()

    def merge(self, other: Moments) -> Moments:
        """The moments of both sets (Chan, Golub and LeVeque 1983)."""
        count = self.count + other.count
        difference = other.mean - self.mean
        mean = self.mean + difference * (other.count / count)
        squares = self.squares + other.squares + difference * difference * (self.count * other.count / count)
        return Moments(count, mean, squares)


def total_variation(p: Tensor, q: Tensor) -> Tensor:
    """Distance of two distributions over bands, sum over bands of |p - q| / 2, (*batch,) from (*batch, band)."""
    return (p - q).abs().sum(-1) / 2


def statistical_distance(stderr: Tensor) -> Tensor:
    """Expected total variation between two independent ensembles whose means have this standard error, (*batch,).

    The difference of two normal means of standard error s has the mean absolute value 2 s / sqrt(pi).
    """
    return stderr.sum(-1) / math.sqrt(math.pi)


class MomentTree:
    """Running moments of numbered realizations that come in any chunks and any order.

    Node (level, i) holds the moments of realizations i 2^level to (i + 1) 2^level - 1 and is always the merger
    of its two children. Which numbers meet which is fixed by the realization numbers alone, so that the result is
    bitwise the same for every chunk size and every division among processes. At most about log2(R) nodes wait.
    """

    def __init__(self) -> None:
        self.waiting: dict[tuple[int, int], tuple[Tensor, Tensor | None]] = {}  # a leaf has no squares
        self.count = 0

    def add(self, first: int, values: Tensor) -> None:
        """Take in realizations first, first + 1, ...; values (realization, ...)."""
        self.count += len(values)
        level, start = 0, first
        mean = list(values.unbind())
        squares: list[Tensor | None] = [None] * len(mean)
        while mean:
            if start % 2:
                left = self.waiting.pop((level, start - 1), None)
                if left is None:
                    self.waiting[level, start] = (mean.pop(0).clone(), squares.pop(0))
                    start += 1
                else:
                    mean, squares, start = [left[0], *mean], [left[1], *squares], start - 1
            if len(mean) % 2:
                last = start + len(mean) - 1
                right = self.waiting.pop((level, last + 1), None)
                if right is None:
                    self.waiting[level, last] = (mean.pop().clone(), squares.pop())
                else:
                    mean, squares = [*mean, right[0]], [*squares, right[1]]
            pairs = range(0, len(mean), 2)
            merged = [_merge_equal(mean[i], squares[i], mean[i + 1], squares[i + 1], 2.0**level) for i in pairs]
            mean, squares = [m for m, _ in merged], [s for _, s in merged]
            level, start = level + 1, start // 2

    def result(self) -> Moments:
        """The moments of all realizations taken in."""
        nodes = sorted(self.waiting.items(), key=lambda item: item[0][1] << item[0][0])
        if not nodes:
            raise ValueError("no realizations were taken in")
        parts = [
            Moments(2**level, mean, torch.zeros_like(mean) if squares is None else squares)
            for (level, _), (mean, squares) in nodes
        ]
        total = parts[0]
        for part in parts[1:]:
            total = total.merge(part)
        return total


def _merge_equal(
    mean: Tensor, squares: Tensor | None, other_mean: Tensor, other_squares: Tensor | None, count: float
) -> tuple[Tensor, Tensor]:
    """Mean and squares of two nodes of ``count`` realizations each."""
    difference = other_mean - mean
    total = difference.square().mul_(count / 2)
    if squares is not None and other_squares is not None:
        total = (squares + other_squares).add_(total)
    return difference.div_(2).add_(mean), total
