"""Error bars of a calibrated model by block bootstrap, and the last time up to which it was compared with chains.

The error of a predicted energy has two parts. The ensemble is finite: blocks of realizations are drawn again with
replacement and the model is fitted again (Efron 1979; Kunsch 1989). And the model is not the chain: where it misses
its own ensemble by more than noise explains, the rest, smoothed over neighboring times and bands, is counted as the
model's own error. What noise explains is what models of the ensembles drawn again miss these by, beyond what is missed
of the whole: a fit follows a part of the noise, of every energy another.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.alike import factors, group_of, variance
from torchchain.master.fits import FitWarning
from torchchain.master.misfit import model_error
from torchchain.master.model import TransferModel
from torchchain.master.records import Progress, Recipe
from torchchain.master.sample import Sample, block_weights

MOST_TIMES = 64
"""Times at which the errors of predictions are kept."""
LATER = ("misfit_share", "alike")
"""What older files do not know."""
FAR, NORMAL_MEDIAN = 3.0, 0.6745
"""Deviations from the median that are cut, in standard deviations; the median size of normal ones."""
OCTAVES = 12
"""Doublings of twice the last time up to which a model is looked at before it is trusted for good."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Standard errors of a calibration and of what it predicts.

    Attributes:
        rates_stderr, basis_stderr: of Q and Pi, [source, receiver].
        times: (time,), some of the calibration's, increasing.
        stderr: of the predicted share of the energy, [source, time, receiver].
        misfit_share: how much of its square is the model's own error, which more chains would not lessen, in the source's
            own band and, on average, in others, (part, time, band); None in files that do not know it.
        alike: part of each standard error that is one with those of other sources, [factor, source, group of times,
            receiver], see :mod:`torchchain.master.alike`; None where the errors of sources are taken as independent.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40)
        >>> master = tc.calibrate(tc.band_transfer(scene, method="modes"), model="exact_psi", method="linear")
        >>> tuple(master.uncertainty.rates_stderr.shape), tuple(master.standard_error(torch.eye(8, dtype=torch.float64), [10.0]).shape)
        ((8, 8), (8, 1, 8))
    """

    rates_stderr: Tensor
    basis_stderr: Tensor
    times: Tensor
    stderr: Tensor
    misfit_share: Tensor | None = None
    alike: Tensor | None = None

    def of(self, initial: Tensor, times: Tensor) -> Tensor:
        """Standard error of the prediction from a start, (*batch, time, band).

        Between the kept times errors are interpolated, and beyond the last they stay.

        Args:
            initial: (*batch, band).
            times: (time,).
        """
        here = self.at(times).to(initial)
        size = initial.abs().amax(-1, keepdim=True).clamp(min=torch.finfo(initial.dtype).tiny)
        return variance([(initial / size, here)], self.shared(times)).sqrt() * size[..., None]

    def shared(self, times: Tensor) -> Tensor | None:
        """``alike`` at other times, [factor, source, time, receiver]."""
        if self.alike is None:
            return None
        kept = self.times.to(times)
        nearest = torch.searchsorted((kept[1:] + kept[:-1]) / 2, times.contiguous())
        return self.alike.to(times)[:, :, group_of(len(kept)).to(nearest)[nearest]]

    def at(self, times: Tensor) -> Tensor:
        """Standard error of the prediction from each band, [source, time, receiver]."""
        return interpolated(self.times.to(times), self.stderr.to(times), times)

    def parts(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """Variances of the prediction from each band, by the ensemble's noise and by the model's misfit, [source, time, receiver]."""
        every = self.at(times).square()
        if self.misfit_share is None:
            return every, torch.zeros_like(every)
        inside, outside = interpolated(self.times.to(times), self.misfit_share.to(times), times).transpose(1, 2)[
            ..., None
        ]
        misfit = every * torch.where(_own(every), inside, outside)
        return every - misfit, misfit

    def coarsened(self, joined: Tensor) -> Uncertainty:
        """Of wider bands, which ``joined`` (band, wider band) makes of the present ones.

        Errors of sources are alike as in :meth:`of`. Those of receivers may be the same error of the model, and add up:
        the standard errors are upper bounds. Wider bands are taken to err independently.
        """
        mean = (joined / joined.sum(0)).T
        alike = self.shared(self.times)
        alike = None if alike is None else alike.to(joined) @ joined / joined.sum(0)

        def wider(error: Tensor, alike: Tensor | None = None) -> Tensor:
            return variance([(mean, error.to(joined) @ joined)], alike).sqrt()

        rates, basis = (wider(error[:, None])[:, 0] for error in (self.rates_stderr, self.basis_stderr))
        return Uncertainty(rates, basis, self.times, wider(self.stderr, alike))

    def tensors(self) -> dict[str, Tensor]:
        return {
            "rates_stderr": self.rates_stderr, "basis_stderr": self.basis_stderr,
            "stderr_times": self.times, "stderr": self.stderr,
            **{name: value for name in LATER if (value := getattr(self, name)) is not None},
        }  # fmt: skip

    @classmethod
    def from_tensors(
        cls, rates_stderr: Tensor, basis_stderr: Tensor, stderr_times: Tensor, stderr: Tensor,
        misfit_share: Tensor | None = None, alike: Tensor | None = None,
    ) -> Uncertainty:  # fmt: skip
        """The inverse of :meth:`tensors`, checked."""
        n, count = len(rates_stderr), len(stderr_times)
        if stderr_times.ndim != 1 or count < 2 or not bool((stderr_times.diff() > 0).all()):
            raise checks.fail("stderr_times", "be at least two increasing times", f"{count} times")
        every = {
            "rates_stderr": (rates_stderr, (n, n)), "basis_stderr": (basis_stderr, (n, n)),
            "stderr_times": (stderr_times, (count,)), "stderr": (stderr, (n, count, n)),
            **({} if misfit_share is None else {"misfit_share": (misfit_share, (2, count, n))}),
            **({} if alike is None else {"alike": (alike, (len(alike), n, int(group_of(count)[-1]) + 1, n))}),
        }  # fmt: skip
        for name, (value, shape) in every.items():
            checks.shaped(name, value, shape)
            if name != "alike":
                checks.first_bad(name, "not be negative", value, value < 0)
            else:
                checks.first_bad(
                    name, "hold parts of squares up to 1", value, value.square().sum(0).expand_as(value) > 1 + 1e-5
                )
        if misfit_share is not None:
            checks.first_bad("misfit_share", "be at most 1", misfit_share, misfit_share > 1)
        return cls(rates_stderr, basis_stderr, stderr_times, stderr, misfit_share, alike)


def interpolated(known: Tensor, values: Tensor, times: Tensor) -> Tensor:
    """Of values [any, known time, any], those at other times: between the nearest two, and beyond the ends the last."""
    if len(known) == 1:
        return values.expand(-1, len(times), -1)
    after = torch.searchsorted(known, times.contiguous()).clamp(1, len(known) - 1)
    low, high = known[after - 1], known[after]
    weight = ((times - low) / (high - low)).clamp(0, 1)[:, None]
    return values[:, after - 1] * (1 - weight) + values[:, after] * weight


def of_parts(
    rates_stderr: Tensor,
    basis_stderr: Tensor,
    times: Tensor,
    noise: Tensor,
    misfit: Tensor,
    alike: Tensor | None = None,
) -> Uncertainty:
    """From variances by the ensemble's noise and by the model's misfit, [source, time, receiver]."""
    both = noise + misfit
    share = torch.where(both > 0, misfit / both.clamp(min=torch.finfo(both.dtype).tiny), 0.0).clamp(max=1)
    inside = share.diagonal(dim1=0, dim2=2)
    outside = (share.sum(2).T - inside) / max(len(share) - 1, 1)
    shares = torch.stack([inside, outside]).clamp(0, 1)
    return Uncertainty(rates_stderr, basis_stderr, times, both.sqrt().float(), shares.float(), alike)


def draw_again(
    transfer: BandTransfer, recipe: Recipe, model: TransferModel, replicates: int, progress: Progress = None,
    chosen: TransferModel | None = None,
) -> Uncertainty:  # fmt: skip
    """Fit the same recipe to ``replicates`` ensembles of blocks drawn with replacement.

    Deterministic: the draws depend on the numbers of blocks and replicates alone.

    Args:
        transfer: what the model was fitted to, of at least two blocks.
        recipe: with nothing left to be chosen.
        model: fitted to the whole transfer.
        replicates: how many, at least 2.
        progress: called with 1 after every replicate.
        chosen: the model whose own misfit counts, where that is not ``model`` but one as near to the ensemble.
    """
    drawn = block_draws(len(transfer.block_counts), replicates)
    return combined(transfer, chosen or model, _replicas(transfer, recipe, model, drawn), drawn, progress)


def block_draws(blocks: int, replicates: int, ensemble: int = 0) -> Tensor:
    """How often each block is drawn, (replica, block); ``ensemble`` tells several apart whose draws are independent."""
    key = np.array([blocks + (ensemble << 32), replicates], dtype=np.uint64)
    draws = np.random.Generator(np.random.Philox(key=key))
    return torch.from_numpy(
        np.stack([np.bincount(draws.integers(0, blocks, blocks), minlength=blocks) for _ in range(replicates)])
    )


def combined(
    transfer: BandTransfer, model: TransferModel, replicas: Iterable[TransferModel], repeats: Tensor,
    progress: Progress = None,
) -> Uncertainty:  # fmt: skip
    """Standard errors from the spread of models of ensembles drawn again, and from what the model itself misses.

    Args:
        transfer: what the model was fitted to.
        model: whose error it is.
        replicas: the models of the ensembles.
        repeats: how often each block is in each of them, (replica, block).
        progress: called with 1 after every one.
    """
    kept, blocks = kept_times(transfer.times), len(transfer.block_counts)
    times, block_mean = transfer.times[kept], transfer.block_mean[:, :, kept]
    rates, bases, paths, missed = [], [], [], []
    for other, weight in zip(replicas, block_weights(transfer, repeats), strict=True):
        rates.append(other.rates.detach())
        bases.append(other.basis)
        paths.append(other.transfer(times).detach())
        missed.append(paths[-1] - torch.tensordot(weight, block_mean.to(weight), dims=1))
        if progress is not None:
            progress(1)
    # blocks drawn with replacement spread (blocks - 1) / blocks of what independent ensembles do
    scale = math.sqrt(blocks / (blocks - 1))
    spread, noise = ([scale * x for x in winsorized(torch.stack(each))] for each in (paths, missed))
    found, mean = model.transfer(times).detach(), transfer.mean[:, kept]
    own = model_error(found, mean, transfer.stderr[:, kept], noise[0])
    slopes, ends = (scale * torch.stack(each).std(0) for each in (rates, bases))
    alike = factors(spread[1], noise[1], found - mean, (spread[0].square() + own.square()).sqrt()).float()
    return of_parts(slopes, ends, times, spread[0].square(), own.square(), alike)


def winsorized(values: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviation over the first axis, and deviations from the mean: cut at ``FAR`` times those of normal values with their median.

    One fit of twenty that went astray would otherwise count for all (Huber 1964).
    """
    off = values - _median(values)
    most = FAR / NORMAL_MEDIAN * _median(off.abs())
    off = torch.maximum(torch.minimum(off, most), -most)
    off -= off.mean(0)
    return (off.square().sum(0) / (len(off) - 1)).sqrt(), off  # several times as fast as torch's std along this axis


def _own(values: Tensor) -> Tensor:
    """Which of [source, time, receiver] are of the source's own band."""
    return torch.eye(len(values), dtype=torch.bool, device=values.device)[:, None].expand_as(values)


def _median(values: Tensor) -> Tensor:
    """Over the first axis, of an even number the mean of the middle two."""
    count = len(values)
    ordered = np.sort(values.cpu().numpy(), axis=0)  # five times as fast as torch along this axis
    return torch.from_numpy(ordered[(count - 1) // 2 : count // 2 + 1]).to(values).mean(0)


def _replicas(transfer: BandTransfer, recipe: Recipe, model: TransferModel, repeats: Tensor) -> Iterator[TransferModel]:
    """The models of ensembles in which blocks are repeated, (replica, block): the record's own way, or fitted anew."""
    if recipe.model is not None and recipe.model.replicas is not None:
        yield from recipe.model.replicas(transfer, recipe, model, repeats)
        return
    for repeat in repeats:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            other, _ = recipe.run(Sample.of_blocks(transfer, repeat), model)
        yield other


def kept_times(times: Tensor, most: int = MOST_TIMES) -> Tensor:
    """Indices of at most ``most`` of the times, first and last among them: half of them evenly by number, half by logarithm."""
    count = len(times)
    if count <= most:
        return torch.arange(count)
    even = torch.linspace(0, count - 1, most // 2, dtype=torch.float64).round().long()
    used = times[times > 0]
    wanted = torch.logspace(math.log10(float(used[0])), math.log10(float(used[-1])), most // 2, dtype=times.dtype)
    return torch.cat([even, torch.searchsorted(times, wanted).clamp(max=count - 1)]).unique()


def later_times(end: float) -> Tensor:
    """Times beyond the last at which :func:`horizon` looks, (48,): 24 up to twice that, and two in every octave from there."""
    octaves = 2.0 ** torch.arange(1, OCTAVES + 1, dtype=torch.float64)
    return end * torch.cat(
        [torch.linspace(1, 2, 24, dtype=torch.float64), torch.stack([1.5 * octaves, 2 * octaves], 1).flatten()]
    )


def horizon(transfer: BandTransfer, model: TransferModel) -> float:
    """The time up to which predictions were compared with chains.

    That is the last time of the calibration, or infinity where the chains have settled by then, in the last quarter of
    the times, to their exact long-time average, and the model stays there from then on, at all of 48 later times: both
    within twice the distance of two such ensembles.
    """
    end = float(transfer.times[-1])
    if transfer.long_time is None or end == 0 or transfer.damping > 0:
        return end
    late = transfer.times > 0.75 * end
    noise = 2 * float(statistical_distance(transfer.stderr[:, late]).mean())
    if not math.isfinite(noise):  # of one chain nothing tells whether it has settled
        return end
    if float(total_variation(transfer.mean[:, late], transfer.long_time[:, None]).mean()) > noise:
        return end
    later = later_times(end).to(transfer.times)
    try:
        for times in (later[-1:], later):
            foreseen = model.transfer(times).detach()
            ahead = float(total_variation(foreseen, transfer.long_time[:, None]).mean(0).max())
            if not ahead <= noise:  # nor where it is not a number
                return end
    except checks.FieldError:  # rates that rounding has blurred by then
        return end
    return math.inf
