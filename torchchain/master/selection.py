"""Which model: the smallest that reaches the ensemble's own error on blocks of realizations that it has not seen."""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.fits import FitWarning
from torchchain.master.ladder import MODELS
from torchchain.master.model import TransferModel
from torchchain.master.records import Progress, Recipe
from torchchain.master.report import Rung, Selection
from torchchain.master.sample import Sample, decade_weights, exact_basis

ENOUGH = 1.05
"""Distance of a model that is as good as the ensemble, over that of two halves, which is itself uncertain by some per cent."""


def rungs(asked: Recipe, transfer: BandTransfer) -> list[Recipe]:
    """The models that :func:`select` tries, from the fewest fitted numbers up."""
    damped, late = transfer.damping > 0, transfer.long_time is not None
    known = Sample.of(transfer).strength is not None
    if asked.model is not None and asked.model.needs_long_time and not asked.model.suits(late, known, damped):
        exact_basis(Sample.of(transfer))  # an error that says what is missing
    found = []
    for record in [asked.model] if asked.model is not None else MODELS.values():
        if record.climbed_by is None or not record.suits(late, known, damped):
            continue
        if asked.model is not None:
            record.check_scene(transfer.scene)
        elif not (record.describes(transfer.scene) and record.tried_on(transfer.scene)):
            continue
        fit = record.fit(record.climbed_by)
        for settings in record.rungs(len(transfer.times)):
            size = record.size(transfer.n_bands, damped, settings)
            found.append((size, replace(asked, model=record, fit=fit, settings=settings)))
    ordered = [recipe for _, recipe in sorted(found, key=lambda entry: entry[0])]
    sure = [recipe for recipe in ordered if recipe.model is not None and recipe.model.never_negative]
    return sure if damped and sure else ordered


def select(
    transfer: BandTransfer, asked: Recipe, progress: Progress = None
) -> tuple[Recipe, Selection, TransferModel | None]:
    """The first rung that, fitted on every other block, predicts the rest as well as the fitted blocks' means do.

    As well: within 5 % in total variation, each decade of time counting alike. A model with windows of time is taken if,
    fitted to all blocks, it is foreseen to be within ``near`` times the noise in every one. If none is, the nearest is
    taken. Models with rates are tried with procedure L.

    Returns:
        The recipe of the rung, what was tried, and the model fitted to half of the blocks.
    """
    candidates = rungs(asked, transfer)
    blocks = len(transfer.block_counts)
    if blocks < 4:
        return _untested(candidates), Selection("largest: too few blocks of realizations to hold some out"), None
    even = (torch.arange(blocks) + 1) % 2
    parts = Sample.of_blocks(transfer, even), Sample.of_blocks(transfer, 1 - even)
    halves = total_variation(parts[0].mean, parts[1].mean).mean(0)
    weight = decade_weights(transfer.times)
    noise = float(halves @ weight)
    tried: list[Rung] = []
    models: list[TransferModel] = []
    chosen: list[Recipe] = []
    enough = False
    refused: checks.FieldError | None = None

    def fitted(recipe: Recipe, sample: Sample, near: TransferModel | None = None) -> tuple[TransferModel, Tensor]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            model, _ = recipe.run(sample, near, progress)
        return model, model.transfer(transfer.times).detach()

    for candidate in candidates:
        record = candidate.model
        assert record is not None, "a rung names its model"
        try:
            model, found = fitted(candidate, parts[0])
        except checks.FieldError as error:  # of half of the data no model of this kind can be made
            refused = error
            continue
        chosen.append(candidate)
        missed = total_variation(found, parts[1].mean).mean(0)
        tried.append(Rung(record.name, candidate.order, float(missed @ weight)))
        models.append(model)
        if not record.windows:
            enough = tried[-1].distance <= ENOUGH * noise
        elif foreseen(halves, missed, halves) @ weight <= record.near:  # not sure to be too far off
            _, other = fitted(candidate, parts[1], model)
            back = total_variation(other, parts[0].mean).mean(0)
            both, spread = (missed + back) / 2, total_variation(found, other).mean(0)
            enough = all(
                float(foreseen(*(part[window].mean() for part in (halves, both, spread)))) <= record.near
                for window in windows(transfer.times, record.windows)
            )
        if enough:
            break
    if not tried:
        assert refused is not None, "there is at least one candidate"
        raise refused
    best = len(tried) - 1 if enough else min(range(len(tried)), key=lambda i: tried[i].distance)
    reached = "reaches" if enough else "comes nearest to"
    reason = f"smallest model that {reached} the distance of the two halves of the ensemble"
    return chosen[best], Selection(reason, tried[best].distance, noise, tuple(tried)), models[best]


def foreseen(halves: Tensor, missed: Tensor, spread: Tensor) -> Tensor:
    """Distance of a model of all blocks from fresh chains, over that of two ensembles.

    Errors add in squares: the held-out half is missed by the model's own error, by that of the blocks that it was fitted
    to, and by the half's own; the latter two are half as large, squared, in twice the chains.

    Args:
        halves: distance of the two halves of the ensemble.
        missed: of a model of one half from the other half.
        spread: of the models of either half.
    """
    squared = halves.square()
    return ((missed.square() - (squared + spread.square()) / 4).clamp(min=0) / (squared / 2).clamp(min=1e-300)).sqrt()


def _untested(candidates: list[Recipe]) -> Recipe:
    """The last of those without windows, that none has to be tested in; else the last."""
    plain = [candidate for candidate in candidates if candidate.model is None or not candidate.model.windows]
    return (plain or candidates)[-1]


def windows(times: Tensor, ends: tuple[float, ...]) -> list[Tensor]:
    """Times above 0 up to each end, and those after the last; windows without times are left out."""
    found = [*((times > 0) & (times <= end) for end in ends), *(times > end for end in ends[-1:])]
    return [window for window in found if bool(window.any())]
