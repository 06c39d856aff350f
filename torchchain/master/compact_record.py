"""The compact model as a rung of the ladder: its settings, its fit to a sample, its error bars."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.compact import CompactModel
from torchchain.master.fits import linear_weights
from torchchain.master.logistic import BEYOND, Regression, chosen_times, fit_compact, regression, stepped
from torchchain.master.loss import mixture
from torchchain.master.model import TransferModel
from torchchain.master.polynomials import checked_degrees, n_coefficients
from torchchain.master.records import Fit, Fitted, Progress, Recipe, ReducedModel
from torchchain.master.sample import Sample, block_weights
from torchchain.master.waves import Waves
from torchchain.threads import single_blas_thread

LADDER = ((4, 3, 6), (6, 4, 8), (8, 6, 12), (10, 7, 14), (10, 7, 20), (14, 10, 20))
"""Degrees in place, distance and time that are tried one after the other: 53 to 480 fitted numbers, and 806."""
WINDOWS = (1.0, 5.0, 50.0)
"""Ends of the windows of time in each of which models of odds are held to the ensemble's error."""


@dataclass(frozen=True)
class CompactSettings:
    """Settings of the logistic regression.

    Attributes:
        degrees: in place, distance and time; None for the smallest that reach the ensemble's own error.
    """

    degrees: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.degrees is not None:
            object.__setattr__(self, "degrees", self._checked())

    def _checked(self) -> tuple[int, ...]:
        return checked_degrees(self.degrees)


@dataclass(frozen=True)
class CompactReport:
    """How the regression went.

    Attributes:
        converged: whether it ended by itself.
        steps: that it took.
        misfit: root mean square, in units of the error.
        degrees: of the settings.
        sets: polynomials of sqrt(xi) that the coefficients of a family are made of; 0 for a model alone.
    """

    converged: bool
    steps: int
    misfit: float
    degrees: tuple[int, ...]
    sets: int = 0


def check_scene(scene: Scene | None) -> None:
    """Raise for chains that the model is not made for: those of particles in a row, with disorder, damped alike if at all."""
    if scene is None:
        raise checks.fail("transfer", "be of chains of a scene for model 'compact'", "energies without one")
    if scene.lattice is not None:
        raise checks.fail("lattice", "be none for model 'compact'", scene.lattice)
    if scene.species:
        raise checks.fail("species", "be left out for model 'compact'", [each.name for each in scene.species])
    if not scene.disorder.strength > 0:
        raise checks.fail("disorder.strength", "be above 0 for model 'compact'", scene.disorder.strength)
    if scene.n_bands < 2 or len(scene.tones) != scene.n_bands:
        raise checks.fail("n_bands", "be at least 2, with one tone each, for model 'compact'", scene.n_bands)


def _fit(sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Progress) -> Fitted:
    check_scene(sample.scene)
    shares = sample.distribution()
    rates = torch.einsum("t,str->sr", linear_weights(sample.times, recipe.window), shares.mean)
    with single_blas_thread():
        model, told = fit_compact(
            rates, Waves.of(sample.chains), recipe.settings.degrees, sample.times, shares.mean, sample.long_time,
            sample.distance, _left(sample), near if isinstance(near, CompactModel) else None, progress,
        )  # fmt: skip
    model = CompactModel(**model.tensors() | loss_tensors(sample))
    return model, CompactReport(**told, degrees=model.degrees_)


def drawn_again(transfer: BandTransfer, repeats: Tensor) -> Tensor:
    """T at the times of its regression of ensembles in which the blocks are repeated, [replica, source, time, receiver]."""
    weights = block_weights(transfer, repeats)
    means = torch.einsum("ab,bstr->astr", weights, transfer.block_mean[:, :, chosen_times(transfer.times)])
    late = transfer.block_long_time
    if late is not None:
        ends = torch.einsum("ab,bsr->asr", weights, late)[:, :, None].expand(-1, -1, len(BEYOND) + 1, -1)
        means = torch.cat([means, ends], dim=2)
    return means.double()


def redrawn(
    transfer: BandTransfer,
    model: CompactModel,
    window: tuple[float, float],
    repeats: Tensor,
    drawn: Tensor,
    coefficients: np.ndarray,
) -> Iterator[CompactModel]:
    """The models of ensembles drawn again, from their T, :func:`drawn_again`, and coefficients, (replica, coefficient)."""
    sample = Sample.of(transfer)
    slopes = torch.einsum("t,bstr->bsr", linear_weights(transfer.times, window), transfer.block_mean)
    slopes = torch.einsum("ab,bsr->asr", block_weights(transfer, repeats), slopes)
    for mean, rates, row in zip(drawn, slopes, coefficients, strict=True):
        changed = {"rates": rates.clone(), "coefficients": torch.from_numpy(row)} | loss_tensors(sample, mean)
        yield CompactModel(**model.tensors() | changed)


def shares_of(drawn: Tensor) -> np.ndarray:
    """The shares of the bands in what is left of the energy."""
    return (drawn / drawn.sum(-1, keepdim=True)).numpy()


def loss_tensors(sample: Sample, mean: Tensor | None = None) -> dict[str, Tensor]:
    """Those of a compact model that tell how damped chains lose energy; of others, none.

    Args:
        sample: of chains of a scene.
        mean: T at the times of the regression, where it is not the sample's own.
    """
    if not sample.damped:
        return {}
    picked = chosen_times(sample.times)
    mean = sample.mean[:, picked] if mean is None else mean
    found = mixture(mean.sum(-1).numpy(), sample.chains.damping, sample.times[picked].numpy())
    return {
        "loss": torch.from_numpy(found),
        "contact_damping": torch.tensor(sample.chains.damping, dtype=torch.float64),
    }


def regression_of(sample: Sample, degrees: tuple[int, int, int]) -> Regression:
    """The regression of a sample of chains of a scene; of damped ones, of the shares of what is left."""
    waves, late, distance = Waves.of(sample.chains), sample.long_time, sample.distance
    return regression(waves, degrees, sample.times, sample.distribution().mean, late, distance, _left(sample))


def _left(sample: Sample) -> Tensor | None:
    """Share of the energy of damped chains that is left, [source, time]."""
    return sample.mean.sum(-1) if sample.damped else None


def replicas(transfer: BandTransfer, recipe: Recipe, model: CompactModel, repeats: Tensor) -> Iterator[CompactModel]:
    """Models of ensembles in which the blocks are repeated, (replica, block), by one step from the model each."""
    problem, drawn = regression_of(Sample.of(transfer), model.degrees_), drawn_again(transfer, repeats)
    found = model.coefficients.detach().double().cpu().numpy()[None]
    with single_blas_thread():
        others = stepped([problem], np.ones((1, 1)), found, [shares_of(drawn)])[:, 0]
    yield from redrawn(transfer, model, recipe.window, repeats, drawn, others)


def rungs_of(
    settings: type[CompactSettings], ladder: Sequence[tuple[int, ...]]
) -> Callable[[int], list[CompactSettings]]:
    """Settings of the degrees in place, distance, time and more that so many times can tell apart, the smallest at least."""
    return lambda n_times: [settings(each) for each in ladder if each == ladder[0] or 2 * each[2] <= n_times]


COMPACT = ReducedModel(
    "compact", "odds of damped beats times exponentials of polynomials: a few hundred numbers, never negative", CompactModel,
    (Fit("logistic", "logistic regression on all times", _fit, settings=CompactSettings, report=CompactReport),),
    lambda n_bands, damped, settings: n_coefficients(settings.degrees or LADDER[0]), climbed_by="logistic", default=True,
    needs_long_time=True, needs_strength=True, fits_loss=True, rungs=rungs_of(CompactSettings, LADDER), check_scene=check_scene, windows=WINDOWS, never_negative=True, replicas=replicas,
)  # fmt: skip
