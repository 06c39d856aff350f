"""The ladder of models and how each is fitted to the transfer of an ensemble, from the paper's (Q, Psi) upward.

=============  ==============================================================  =======================================
model          what it adds                                                    fitted numbers, B bands
=============  ==============================================================  =======================================
paper          rates Q, basis energy Psi of Eq. 47                             B^2 (1 with Eq. 50 for Q)
exact_psi      Psi from the exact long-time average of the modes               B^2 + B
basis_matrix   basis energy of every pair of bands, Pi[s, r]                   2 B^2
swing_in       rates that act some time after the energy came                  2 B^2 + 1
memory         any response, as a few decay rates shared by all pairs          B^2 (1 + functions - 1) + their rates
=============  ==============================================================  =======================================
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.energy.wavenumber import basis_fraction
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.adam import AdamSettings, fit_rates
from torchchain.master.fits import FitWarning, analytic_prefactor, linear_delay, linear_rates, nonlinear_rates, profile
from torchchain.master.memory import MemoryModel, fit_memory
from torchchain.master.model import RateModel, SwingInModel, TransferModel
from torchchain.threads import single_blas_thread, single_thread


@dataclass(frozen=True, eq=False)
class Sample:
    """What a fit sees of an ensemble, or of some of its blocks.

    Attributes:
        times: (time,).
        mean: share of the energy of the start, [source, time, receiver].
        long_time: infinite-time average, [source, receiver], or None.
        strength: disorder xi.
        damped: whether the chains lose energy.
    """

    times: Tensor
    mean: Tensor
    long_time: Tensor | None
    strength: float
    damped: bool = False

    @classmethod
    def of(cls, transfer: BandTransfer) -> Sample:
        """The whole ensemble."""
        scene = transfer.scene
        return cls(transfer.times, transfer.mean, transfer.long_time, scene.disorder.strength, scene.damping > 0)

    @classmethod
    def of_blocks(cls, transfer: BandTransfer, repeats: Tensor) -> Sample:
        """Each block of realizations as often as told, (block,)."""
        weight = repeats.to(transfer.mean.dtype) * torch.tensor(transfer.block_counts, dtype=transfer.mean.dtype)
        weight = weight / weight.sum()
        late = transfer.block_long_time
        return replace(
            cls.of(transfer),
            mean=torch.einsum("b,bstr->str", weight, transfer.block_mean),
            long_time=None if late is None else torch.einsum("b,bsr->sr", weight, late),
        )

    @property
    def n_bands(self) -> int:
        return self.mean.shape[-1]

    def distribution(self) -> Sample:
        """The share of each band in what is left of the energy: what is measured where nothing is lost."""
        return replace(self, mean=self.mean / self.mean.sum(-1, keepdim=True), damped=False) if self.damped else self


def paper_basis(sample: Sample) -> Tensor:
    """Psi of Eq. 47 on the diagonal, [source, receiver]."""
    return torch.diag(basis_fraction(sample.strength, sample.n_bands))


def exact_psi(sample: Sample) -> Tensor:
    """The exact infinite-time share of each source's own band on the diagonal, [source, receiver]."""
    return torch.diag(exact_basis(sample).diagonal())


def exact_basis(sample: Sample) -> Tensor:
    """The exact infinite-time share of every source in every band, Pi [source, receiver]."""
    if sample.long_time is None:
        raise checks.fail(
            "transfer", "hold the long-time average for this model (band_transfer with long_time=True)", "none"
        )
    return sample.long_time


BASES: dict[str, Callable[[Sample], Tensor]] = {
    "paper": paper_basis,
    "exact_psi": exact_psi,
    "basis_matrix": exact_basis,
    "swing_in": exact_basis,
}
"""Models with rates Q, by what stays behind: Psi of Eq. 47, its exact value, the exact share of every pair of bands."""

MODELS = (*BASES, "memory")


@dataclass(frozen=True)
class Recipe:
    """A calibration in every detail: what ``calibrate`` makes of its arguments.

    Attributes:
        method, model: names; None: to be chosen.
        window: of the fits at short times.
        adam: settings of Adam.
        order: of the model with memory; None: to be chosen.
    """

    method: str | None
    model: str | None
    window: tuple[float, float]
    adam: AdamSettings
    order: tuple[int, int] | None


def fit(
    sample: Sample, recipe: Recipe, near: TransferModel | None = None, progress: Callable[[int], Any] | None = None
) -> tuple[TransferModel, dict[str, Any]]:
    """Fit the recipe's model to a sample.

    Where the chains lose energy, a model with rates takes Q from the distribution over bands and the damping d of
    Eq. 51 from the loss; the model with memory describes both together.

    Args:
        sample: see :class:`Sample`.
        recipe: with model, method and, for "memory", order.
        near: the model of a similar sample, to start from.
        progress: called with 1 after every step of a long fit.

    Returns:
        The model, and a report on the fit.
    """
    if recipe.model == "memory":
        return _fit_memory(sample, recipe, near, progress)
    damping, loss = _loss(sample) if sample.damped else (None, {})
    sample = sample.distribution()
    basis = BASES[recipe.model or "paper"](sample)
    free = (1 - basis.diagonal()).clamp(min=torch.finfo(basis.dtype).eps)
    linear = linear_rates(sample.times, sample.mean, free, recipe.window)
    swings = recipe.model == "swing_in"
    delay = linear_delay(sample.times, sample.mean, recipe.window) if swings else None
    report: dict[str, Any] = {}
    if recipe.method == "analytic":
        q0, error = analytic_prefactor(linear)
        rates, report = q0 * profile(sample.n_bands), {"q0": q0, "q0_stderr": error}
    elif recipe.method == "linear":
        rates = linear
    elif recipe.method == "nonlinear":
        rates, report = _fit_nonlinear(sample, free, recipe.window, linear, progress)
    else:
        start = linear if near is None else near.rates.detach()
        rates, delay, report = _fit_adam(sample, basis, start, delay, recipe.adam, progress)
    report = report | loss
    if delay is not None:
        return SwingInModel(rates, basis, delay, damping), report | {"delay": float(delay)}
    return RateModel(rates, basis, damping), report


def loss_rates(sample: Sample) -> Tensor:
    """d of Eq. 51 [band]: the energy lost up to each time is the sum over bands of d times the energy there until then.

    Nonnegative least squares over all sources and times, with the integral by the trapezoidal rule; no model of the
    transfer comes in.
    """
    import scipy.optimize

    held, lost = _held_and_lost(sample)
    found, _ = scipy.optimize.nnls(held.flatten(0, 1).numpy(), lost.flatten().numpy())
    return torch.from_numpy(found).to(sample.mean)


def _held_and_lost(sample: Sample) -> tuple[Tensor, Tensor]:
    """Integral of the energy over time, [source, time, band], and the energy lost by then, [source, time]."""
    held = torch.cumulative_trapezoid(sample.mean, sample.times, dim=1)
    return held, sample.mean[:, :1].sum(-1) - sample.mean[:, 1:].sum(-1)


def _loss(sample: Sample) -> tuple[Tensor, dict[str, Any]]:
    """d of Eq. 51, and a report: d, and the root mean square of the lost energy that it leaves unexplained."""
    damping = loss_rates(sample)
    held, lost = _held_and_lost(sample)
    misfit = float((held @ damping - lost).square().mean().sqrt())
    return damping, {"damping": damping.tolist(), "loss_misfit": misfit}


def _fit_nonlinear(
    sample: Sample, free: Tensor, window: tuple[float, float], linear: Tensor, progress: Any
) -> tuple[Tensor, dict[str, Any]]:
    rates, converged, _ = nonlinear_rates(sample.times, sample.mean, free, window, progress)
    failed = int((~converged).sum())
    if failed:
        warnings.warn(
            f"nonlinear fit did not converge for {failed} of {converged.numel()} pairs of bands, which take the "
            f"linear procedure's rate (calibration.report names them)",
            FitWarning,
            stacklevel=4,
        )
    report = {"unconverged": failed, "unconverged_entries": (converged.logical_not().nonzero() + 1).tolist()}
    return torch.where(converged, rates, linear), report


def _fit_adam(
    sample: Sample, basis: Tensor, start: Tensor, delay: Tensor | None, settings: AdamSettings, progress: Any
) -> tuple[Tensor, Tensor | None, dict[str, Any]]:
    with single_thread():
        rates, delay, report = fit_rates(sample.times, sample.mean, basis, start, settings, progress, delay)
    if not report["converged"]:
        warnings.warn(
            f"Adam did not converge in {settings.steps} steps to tolerance {settings.tolerance:g}; loss {report['loss']:.3e}",
            FitWarning,
            stacklevel=4,
        )
    return rates, delay, report | {"constraint": settings.constraint, "penalty": settings.penalty}


def _fit_memory(
    sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Any
) -> tuple[TransferModel, dict[str, Any]]:
    assert recipe.order is not None, "calibrate chooses one"
    basis = torch.zeros_like(sample.mean[:, 0]) if sample.damped else exact_basis(sample)
    calm = sample.distribution()
    free = (1 - (basis if calm is sample else paper_basis(calm)).diagonal()).clamp(min=torch.finfo(basis.dtype).eps)
    rates = linear_rates(calm.times, calm.mean, free, recipe.window)
    guess = near if isinstance(near, MemoryModel) else None
    with single_blas_thread():
        tensors, report = fit_memory(sample.times, sample.mean, basis, recipe.order, progress=progress, near=guess)
    loss = _loss(sample)[1] if sample.damped else {}
    return MemoryModel(rates=rates, **tensors), report | loss
