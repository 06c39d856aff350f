"""Mean and standard error over realizations, the same to the last bit however the realizations are cut into chunks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks


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
        mean = torch.add(self.mean, difference, alpha=other.count / count)
        squares = torch.addcmul(self.squares, difference, difference, value=self.count * other.count / count)
        if other.count > 1:
            squares += other.squares
        return Moments(count, mean, squares)


def total_variation(p: Tensor, q: Tensor) -> Tensor:
    """Distance of two distributions over bands, sum over bands of |p - q| / 2, (*batch,) from (*batch, band).

    Example:
        >>> tc.total_variation(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.5, 0.5, 0.0])).item()
        0.5
    """
    p, q = checks.real_tensor("p", p), checks.real_tensor("q", q)
    if p.ndim == 0 or q.ndim == 0 or p.shape[-1] != q.shape[-1]:
        raise checks.fail("q", f"have the bands of p, shape {tuple(p.shape)}", q)
    try:
        distance = (p - q).abs().sum(-1) / 2
    except RuntimeError:
        raise checks.fail("q", f"fit p of shape {tuple(p.shape)}", q) from None
    return checks.finite("p - q", distance)


def statistical_distance(stderr: Tensor) -> Tensor:
    """Expected total variation between two independent ensembles whose means have this standard error, (*batch,).

    The difference of two normal means of standard error s has the mean absolute value 2 s / sqrt(pi).

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=20, times=[0.0, 5.0, 50.0])
        >>> tc.statistical_distance(tc.band_transfer(scene, method="modes").stderr).shape
        torch.Size([8, 3])
    """
    checks.instance("stderr", stderr, Tensor)
    if not stderr.is_floating_point() or stderr.layout != torch.strided or stderr.is_meta or stderr.ndim == 0:
        raise checks.FieldTypeError(f"stderr must be a dense floating-point tensor (*batch, band), got {stderr.dtype}")
    checks.first_bad("stderr", "not be negative", stderr, ~(stderr >= 0), "band")  # infinite for one realization
    return stderr.sum(-1) / math.sqrt(math.pi)


def jackknife_error(replicates: Tensor) -> Tensor:
    """Standard error of a statistic from its values with one block of data left out at a time, (...) from (block, ...)."""
    count = len(replicates)
    return ((replicates - replicates.mean(0)).square().sum(0) * (count - 1) / count).sqrt()


class MomentTree:
    """Running moments of numbered realizations that come in any chunks and any order.

    Node (level, i) holds the moments of realizations i 2^level to (i + 1) 2^level - 1 and is always the merger
    of its two children. Which numbers meet which is fixed by the realization numbers alone, so that the result is
    bitwise the same for every chunk size and every division among processes. At most about log2(R) nodes wait.

    Args:
        size: realizations in all, 0 to size - 1; with the last of them the nodes become one. None if not known.
    """

    def __init__(self, size: int | None = None) -> None:
        self.size = size
        self.waiting: dict[tuple[int, int], tuple[Tensor, Tensor | None]] = {}  # a leaf has no squares
        self.whole: Moments | None = None
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
                    self._wait(level, start, mean.pop(0), squares.pop(0))
                    start += 1
                else:
                    mean, squares, start = [left[0], *mean], [left[1], *squares], start - 1
            if len(mean) % 2:
                last = start + len(mean) - 1
                right = self.waiting.pop((level, last + 1), None)
                if right is None:
                    self._wait(level, last, mean.pop(), squares.pop())
                else:
                    mean, squares = [*mean, right[0]], [*squares, right[1]]
            pairs = range(0, len(mean), 2)
            merged = [_merge_equal(mean[i], squares[i], mean[i + 1], squares[i + 1], 2.0**level) for i in pairs]
            mean, squares = [m for m, _ in merged], [s for _, s in merged]
            level, start = level + 1, start // 2
        self._close()

    def absorb(self, other: MomentTree) -> None:
        """Take in the realizations of another tree, which is used up."""
        self.count += other.count
        self.whole = self.whole or other.whole
        for place, node in other.waiting.items():
            level, start = place
            while (sibling := self.waiting.pop((level, start ^ 1), None)) is not None:
                left, right = (sibling, node) if start % 2 else (node, sibling)
                node = _merge_equal(*left, *right, 2.0**level)
                level, start = level + 1, start // 2
            self.waiting[level, start] = node
        other.waiting, other.whole = {}, None
        self._close()

    def result(self) -> Moments:
        """The moments of all realizations taken in."""
        if self.whole is not None:
            return self.whole
        nodes = sorted(self.waiting.items(), key=lambda item: item[0][1] << item[0][0])
        if not nodes:
            raise ValueError("no realizations were taken in")
        parts = [
            Moments(2**level, mean, torch.zeros_like(mean) if squares is None else squares)
            for (level, _), (mean, squares) in nodes
        ]
        return merged(parts)

    def held(self) -> list[range]:
        """The realizations taken in, as ranges in order."""
        if self.whole is not None:
            return [range(self.whole.count)]
        return joined(range(i << level, (i + 1) << level) for level, i in self.waiting)

    def _wait(self, level: int, start: int, mean: Tensor, squares: Tensor | None) -> None:
        """Keep a node until its sibling comes: of a leaf a copy, not a view of the tensor that it came in."""
        self.waiting[level, start] = (mean.clone() if squares is None else mean, squares)

    def _close(self) -> None:
        """One node in place of those that wait, once every realization is in."""
        if self.waiting and self.count == self.size:
            self.whole, self.waiting = self.result(), {}


class EnsembleMoments:
    """Running moments of named measurements in blocks of consecutive realizations, from any chunks in any order.

    Args:
        realizations: of the ensemble.
        n_blocks: B, at most the number R of samples; block b holds samples R b / B (rounded down) to R (b + 1) / B - 1.
        sample_size: consecutive realizations that make one independent sample, which is their mean.
    """

    def __init__(self, realizations: int, n_blocks: int = 1, sample_size: int = 1) -> None:
        self.realizations, self.sample_size = realizations, sample_size
        self.edges = [realizations // sample_size * block // n_blocks for block in range(n_blocks + 1)]
        self.trees: dict[tuple[str, int], MomentTree] = {}

    def _tree(self, name: str, block: int) -> MomentTree:
        size = self.edges[block + 1] - self.edges[block]
        return self.trees.setdefault((name, block), MomentTree(size))

    def add(self, first: int, measured: Mapping[str, Tensor]) -> None:
        """Take in measurements (realization, ...) of realizations first, first + 1, ..., of whole samples."""
        first //= self.sample_size
        for name, values in measured.items():
            if self.sample_size > 1:
                values = values.unflatten(0, (-1, self.sample_size)).mean(1)
            for block, (low, high) in enumerate(zip(self.edges, self.edges[1:], strict=False)):
                begin, end = max(low, first), min(high, first + len(values))
                if begin < end:
                    self._tree(name, block).add(begin - low, values[begin - first : end - first])

    def absorb(self, other: EnsembleMoments) -> None:
        """Take in another part of the same ensemble, which is used up."""
        for (name, block), tree in other.trees.items():
            self._tree(name, block).absorb(tree)

    @property
    def names(self) -> set[str]:
        """What was measured."""
        return {name for name, _ in self.trees}

    def blocks(self, name: str) -> list[Moments]:
        """The moments of every block, in order."""
        return [self.trees[name, block].result() for block in range(len(self.edges) - 1)]

    def held(self) -> list[range]:
        """The realizations taken in, as ranges in order.

        Raises:
            ValueError: if the measurements differ in their realizations.
        """
        found: dict[str, list[range]] = {}
        for (name, block), tree in self.trees.items():
            low = self.edges[block]
            size = self.sample_size
            found.setdefault(name, []).extend(range(size * (low + r.start), size * (low + r.stop)) for r in tree.held())
        ranges = [joined(parts) for parts in found.values()]
        if any(other != ranges[0] for other in ranges):
            raise ValueError("the measurements differ in their realizations")
        return ranges[0] if ranges else []

    def tensors(self) -> dict[str, Tensor]:
        """All nodes by name, as :meth:`from_tensors` takes them: "name/block/level/i/mean" and ".../squares"."""
        plain: dict[str, Tensor] = {}
        for (name, block), tree in self.trees.items():
            nodes = {f"{level}/{i}": node for (level, i), node in tree.waiting.items()}
            if tree.whole is not None:
                nodes["whole"] = (tree.whole.mean, tree.whole.squares)
            for place, (mean, squares) in nodes.items():
                plain[f"{name}/{block}/{place}/mean"] = mean.contiguous()
                if squares is not None:
                    plain[f"{name}/{block}/{place}/squares"] = squares.contiguous()
        return plain

    @classmethod
    def from_tensors(
        cls, realizations: int, n_blocks: int, plain: Mapping[str, Tensor], sample_size: int = 1
    ) -> EnsembleMoments:
        """The inverse of :meth:`tensors`.

        Raises:
            ValueError, KeyError: for names or realizations that :meth:`tensors` does not give.
        """
        moments = cls(realizations, n_blocks, sample_size)
        for key, mean in plain.items():
            name, block, *place, kind = key.split("/")
            if kind != "mean":
                continue
            tree = moments._tree(name, int(block))
            squares = plain.get(key.removesuffix("mean") + "squares")
            if place == ["whole"]:
                assert tree.size is not None
                tree.count, tree.whole = (
                    tree.size,
                    Moments(tree.size, mean, plain[key.removesuffix("mean") + "squares"]),
                )
            else:
                level, i = (int(word) for word in place)
                tree.waiting[level, i] = (mean, squares)
                tree.count += 2**level
        moments.held()
        return moments

    def again(self, plain: Mapping[str, Tensor]) -> EnsembleMoments:
        """Other moments of the same ensemble, see :meth:`from_tensors`."""
        return self.from_tensors(self.realizations, len(self.edges) - 1, plain, self.sample_size)


def joined(ranges: Iterable[range]) -> list[range]:
    """Ranges of whole numbers in order, those that touch as one.

    Raises:
        ValueError: if two overlap.
    """
    whole: list[range] = []
    for part in sorted(ranges, key=lambda part: part.start):
        if whole and part.start < whole[-1].stop:
            raise ValueError(f"realization {part.start} is held twice")
        if whole and part.start == whole[-1].stop:
            whole[-1] = range(whole[-1].start, part.stop)
        elif len(part):
            whole.append(part)
    return whole


def merged(parts: list[Moments]) -> Moments:
    """The moments of all parts."""
    total = parts[0]
    for part in parts[1:]:
        total = total.merge(part)
    return total


def _merge_equal(
    mean: Tensor, squares: Tensor | None, other_mean: Tensor, other_squares: Tensor | None, count: float
) -> tuple[Tensor, Tensor]:
    """Mean and squares of two nodes of ``count`` realizations each."""
    difference = other_mean - mean
    if squares is None or other_squares is None:
        total = difference.square().mul_(count / 2)
    else:
        total = (squares + other_squares).addcmul_(difference, difference, value=count / 2)
    return torch.add(mean, difference, alpha=0.5, out=difference), total
