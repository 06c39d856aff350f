"""What a fit sees of an ensemble: mean energies, their long-time average, and how much is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.energy.wavenumber import basis_fraction
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import statistical_distance
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.report import Loss
from torchchain.threads import kept_property

LEADING = 24
"""Singular vectors of the energies on which poles are searched."""


@dataclass(frozen=True, eq=False)
class Sample:
    """What a fit sees of an ensemble, or of some of its blocks.

    Attributes:
        times: (time,).
        mean: share of the energy of the start, [source, time, receiver].
        long_time: infinite-time average, [source, receiver], or None.
        strength: disorder xi, or None if unknown.
        damped: whether the chains lose energy.
        scene: of the chains, or None.
        stderr: of the mean of the whole ensemble, [source, time, receiver], or None.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=40), method="modes")
        >>> sample = tc.master.Sample.of(transfer)
        >>> sample.n_bands, sample.strength
        (8, 0.3)
    """

    times: Tensor
    mean: Tensor
    long_time: Tensor | None
    strength: float | None
    damped: bool = False
    scene: Scene | None = None
    stderr: Tensor | None = None

    @classmethod
    def of(cls, transfer: BandTransfer) -> Sample:
        """The whole ensemble."""
        scene = transfer.scene
        strength = None if scene is None else scene.disorder.strength
        return cls(
            transfer.times, transfer.mean, transfer.long_time, strength, transfer.damping > 0, scene, transfer.stderr
        )  # fmt: skip

    @classmethod
    def of_blocks(cls, transfer: BandTransfer, repeats: Tensor) -> Sample:
        """Each block of realizations as often as told, (block,)."""
        weight = block_weights(transfer, repeats)
        used = weight.nonzero()[:, 0].tolist()
        late = transfer.block_long_time
        mean = torch.zeros_like(transfer.mean)
        for b in used:
            mean.add_(transfer.block_mean[b], alpha=float(weight[b]))
        long_time = None if late is None else torch.einsum("b,bsr->sr", weight, late)
        return replace(cls.of(transfer), mean=mean, long_time=long_time)

    @property
    def chains(self) -> Scene:
        """The scene of chains that have one."""
        assert self.scene is not None, "the model's check of the scene has seen it"
        return self.scene

    @property
    def n_bands(self) -> int:
        return self.mean.shape[-1]

    @kept_property
    def distance(self) -> Tensor | None:
        """Expected total variation of two whole ensembles at each time, (time,), or None."""
        if self.stderr is None:
            return None
        found = statistical_distance(self.stderr).mean(0)
        return found if bool(found.isfinite().all()) and bool((found > 0).any()) else None

    def distribution(self) -> Sample:
        """The share of each band in what is left of the energy: what is measured where nothing is lost."""
        return replace(self, mean=self.mean / self.mean.sum(-1, keepdim=True), damped=False) if self.damped else self

    def residual(self, basis: Tensor) -> np.ndarray:
        """Energy beyond what stays, T(t) - Pi, as (time, entry)."""
        return (self.mean - basis[:, None]).transpose(0, 1).reshape(len(self.times), -1).numpy()

    @kept_property
    def leading(self) -> np.ndarray:
        """Leading right singular vectors of the energies beyond what stays for good, (entry, vector)."""
        kept = self.long_time if self.long_time is not None and not self.damped else torch.zeros_like(self.mean[:, 0])
        return leading_vectors(self.residual(kept))


def leading_vectors(data: np.ndarray) -> np.ndarray:
    """Leading right singular vectors, (column, vector), by two power iterations on a random range.

    (Halko, Martinsson and Tropp, SIAM Rev. 53, 217, 2011; the same random numbers every time.)
    """
    count = min(LEADING, *data.shape)
    random = np.random.Generator(np.random.Philox(key=np.array([count, 0], dtype=np.uint64)))
    vectors = random.normal(size=(data.shape[1], min(count + 16, *data.shape)))
    for _ in range(3):
        vectors, _ = np.linalg.qr(data.T @ (data @ vectors))
    _, _, right = np.linalg.svd(data @ vectors, full_matrices=False)
    return vectors @ right[:count].T


def decade_weights(times: Tensor) -> Tensor:
    """Weight of every time in a mean over the logarithm of time, (time,): that of 0 is none, the sum 1.

    However the times are spaced, a decade of them counts as much as another.
    """
    used = (times > 0).nonzero()[:, 0]
    weight = torch.zeros_like(times)
    if len(used) < 3:
        weight[used] = 1 / max(len(used), 1)
        return weight
    weight[used] = torch.gradient(times[used].log())[0]
    return weight / weight.sum()


def block_weights(transfer: BandTransfer, repeats: Tensor) -> Tensor:
    """Weight of each block taken as often as told, (*batch, block); rows sum to 1."""
    weight = repeats.to(transfer.mean.dtype) * torch.tensor(transfer.block_counts, dtype=transfer.mean.dtype)
    return weight / weight.sum(-1, keepdim=True)


def paper_basis(sample: Sample) -> Tensor:
    """Psi of Eq. 47 on the diagonal, [source, receiver]."""
    if sample.strength is None:
        raise checks.fail("transfer", "tell the strength of the disorder for Psi of Eq. 47 (model 'paper')", "none")
    return torch.diag(basis_fraction(sample.strength, sample.n_bands))


def exact_psi(sample: Sample) -> Tensor:
    """The exact infinite-time share of each source's own band on the diagonal, [source, receiver]; noise past 0 and 1 is cut."""
    return torch.diag(exact_basis(sample).diagonal().clamp(0, 1))


def exact_basis(sample: Sample) -> Tensor:
    """The exact infinite-time share of every source in every band, Pi [source, receiver]; rows of noisy data sum to 1 at most."""
    if sample.long_time is None:
        raise checks.fail(
            "transfer", "hold the long-time average for this model (band_transfer with long_time=True)", "none"
        )
    total = sample.long_time.sum(-1, keepdim=True)
    return torch.where(total > 1, sample.long_time / total, sample.long_time)


def loss_rates(sample: Sample) -> Tensor:
    """d of Eq. 51 [band]: the energy lost up to each time is the sum over bands of d times the energy there until then.

    Nonnegative least squares over all sources and times, with the integral by the trapezoidal rule; no model of the
    transfer comes in.
    """
    import scipy.optimize

    held, lost = _held_and_lost(sample)
    found, _ = scipy.optimize.nnls(held.flatten(0, 1).numpy(), lost.flatten().numpy())
    return torch.from_numpy(found).to(sample.mean)


def loss_of(sample: Sample) -> Loss | None:
    """The damping of damped chains, and how well it explains the lost energy; None for others."""
    if not sample.damped:
        return None
    damping = loss_rates(sample)
    held, lost = _held_and_lost(sample)
    return Loss(tuple(damping.tolist()), float((held @ damping - lost).square().mean().sqrt()))


def _held_and_lost(sample: Sample) -> tuple[Tensor, Tensor]:
    """Integral of the energy over time, [source, time, band], and the energy lost by then, [source, time]."""
    held = torch.cumulative_trapezoid(sample.mean, sample.times, dim=1)
    return held, sample.mean[:, :1].sum(-1) - sample.mean[:, 1:].sum(-1)
