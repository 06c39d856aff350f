"""The model with memory that calibration hands out: never negative at any time, proved, where such a one is as good."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace

import torch

from torchchain import checks
from torchchain.ensemble.statistics import total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.certificate import CertificateError, certify
from torchchain.master.fits import FitWarning
from torchchain.master.memory import ORDERS, MemoryModel, ProjectionReport
from torchchain.master.model import TransferModel
from torchchain.master.nonnegative import nonnegative
from torchchain.master.proof import ROUNDING, Certificate
from torchchain.master.records import Progress, Recipe
from torchchain.master.sample import Sample, decade_weights

AS_GOOD = 1.05
"""Distance from the ensemble of a model that is never negative, relative to the free fit's, up to which it replaces it."""
ORDERS_TRIED = 4
"""Orders whose decay rates are tried, downward from the chosen one: functions that hardly differ only make noise."""
Projected = tuple[MemoryModel, ProjectionReport]
"""A fit by the method "projection"."""
DIVERGES = 0.1
"""A model whose energies leave [0, 1] by more than this share at any time is not handed out without a warning."""


def certified(
    transfer: BandTransfer, asked: Recipe, free: Projected, mend: bool, progress: Progress = None, spare: bool = False
) -> tuple[TransferModel, ProjectionReport, Certificate | None]:
    """The model that is never negative, with its proof, in place of a free fit, where it is as near to the ensemble.

    Args:
        transfer: of chains without damping.
        asked: the recipe of the free fit.
        free: the fit and its report.
        mend: whether another model may take the place of the free fit; not where its order was asked for, unless that is to
            be certified: then the one with its decay rates does, however near.
        progress: called with 1 after every order.
        spare: whether another model takes its place where none is found.

    Returns:
        The model, the report of the fit that found its decay rates, and its certificate: the nearest where none is as
        good; the free fit where no other was found, with a certificate if it has one.

    Raises:
        FieldError: where an order that is asked for has no model that is never negative, and is to.

    Warns:
        FitWarning: if the model that is left may be negative, or is farther from the ensemble because the free fit diverged.
    """
    model, told = free
    noise = Sample.of(transfer).distance
    if asked.settings.certified and not mend:
        proof = certify(model)
        if not proof.holds:
            try:
                model, proof = nonnegative(model, transfer.times, transfer.mean, noise)
            except CertificateError as error:
                raise checks.fail(
                    "certified", f"be False for order {told.order} of these energies", str(error)
                ) from None
        return model, told, proof
    how = "certified=True makes one of that order that is never negative"
    far = _distance(model, transfer)
    nearest: tuple[float, TransferModel, ProjectionReport, Certificate] | None = None
    tried = _fits(transfer, asked, free) if mend and transfer.n_bands > 1 else ()  # one band keeps all its energy
    for each, report in tried:
        try:
            other, proof = nonnegative(each, transfer.times, transfer.mean, noise)
        except CertificateError:
            continue
        off = _distance(other, transfer)
        if progress is not None:
            progress(1)
        if nearest is None or off < nearest[0]:
            nearest = (off, other, report, proof)
        if off <= AS_GOOD * far:
            return nearest[1:]
    proof = certify(model)
    if proof.holds:
        return model, told, proof
    low, high = min(0.0, float(transfer.mean.min())), max(1.0, float(transfer.mean.max()))  # imported data may be wild
    if proof.lower < low - DIVERGES or proof.upper > high + DIVERGES:
        wild = f"the free fit of order {told.order} goes from {proof.lower:.3g} to {proof.upper:.3g} of the energy"
        if nearest is not None:
            warnings.warn(
                f"{wild}: the model of order {nearest[2].order} that is never negative takes its place, "
                f"{nearest[0]:.3g} from the ensemble in place of {far:.3g}", FitWarning, stacklevel=3,
            )  # fmt: skip
            return nearest[1:]
        if not spare:
            hint = "" if mend else f", or {how}"
            warnings.warn(f"{wild}: do not predict other times than it was fitted to{hint}", FitWarning, stacklevel=3)
    elif not mend and proof.lower < low - ROUNDING:
        warnings.warn(
            f"energies of a model of order {told.order} may go down to {proof.lower:.2g} of the total: {how}",
            FitWarning,
            stacklevel=3,
        )
    return (model, told, None) if nearest is None else nearest[1:]


def _fits(transfer: BandTransfer, asked: Recipe, free: Projected) -> Iterator[Projected]:
    """The free fit, and those of the next smaller orders."""
    yield free
    at = ORDERS.index((asked.order[0], asked.order[1]))
    sample = Sample.of(transfer)
    for order in ORDERS[max(at - ORDERS_TRIED + 1, 0) : at][::-1]:
        model, told = replace(asked, settings=replace(asked.settings, order=order)).run(sample)
        assert isinstance(model, MemoryModel), "of the method 'projection'"
        yield model, told


def _distance(model: TransferModel, transfer: BandTransfer) -> float:
    """Total variation from the ensemble, each decade of time counting alike."""
    with torch.no_grad():
        off = total_variation(model.transfer(transfer.times), transfer.mean).mean(0)
    return float(off @ decade_weights(transfer.times))
