"""Which model: the smallest that reaches the ensemble's own error on blocks of realizations that it has not seen."""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from torchchain.ensemble.statistics import total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.fits import FitWarning
from torchchain.master.ladder import MODELS
from torchchain.master.model import TransferModel
from torchchain.master.records import Progress, Recipe
from torchchain.master.report import Rung, Selection
from torchchain.master.sample import Sample, exact_basis

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
        elif record.named_only or not record.describes(transfer.scene):
            continue
        fit = record.fit(record.climbed_by)
        for settings in record.rungs(len(transfer.times)):
            size = record.size(transfer.n_bands, damped, settings)
            found.append((size, replace(asked, model=record, fit=fit, settings=settings)))
    return [recipe for _, recipe in sorted(found, key=lambda entry: entry[0])]


def select(
    transfer: BandTransfer, asked: Recipe, progress: Progress = None
) -> tuple[Recipe, Selection, TransferModel | None]:
    """The first rung that, fitted on every other block, predicts the rest as well as the fitted blocks' means do.

    As well: within 5 % in total variation, for some models in each of several windows of time. If none does, the nearest. Models with rates are tried with procedure L.

    Returns:
        The recipe of the rung, what was tried, and the model fitted to half of the blocks.
    """
    candidates = rungs(asked, transfer)
    blocks = len(transfer.block_counts)
    if blocks < 4:
        return candidates[-1], Selection("largest: too few blocks of realizations to hold some out"), None
    even = (torch.arange(blocks) + 1) % 2
    seen, held = Sample.of_blocks(transfer, even), Sample.of_blocks(transfer, 1 - even).mean
    used = transfer.times > 0
    halves = total_variation(seen.mean, held)
    noise = float(halves[:, used].mean())
    tried: list[Rung] = []
    models: list[TransferModel] = []
    enough = False
    for candidate in candidates:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            model, _ = candidate.run(seen, progress=progress)
        missed = total_variation(model.transfer(transfer.times).detach(), held)
        distance = float(missed[:, used].mean())
        assert candidate.model is not None, "a rung names its model"
        tried.append(Rung(candidate.model.name, candidate.order, distance))
        models.append(model)
        enough = all(
            float(missed[:, window].mean()) <= ENOUGH * float(halves[:, window].mean())
            for window in _windows(transfer.times, candidate.model.windows)
        )
        if enough:
            break
    best = len(tried) - 1 if enough else min(range(len(tried)), key=lambda i: tried[i].distance)
    reached = "reaches" if enough else "comes nearest to"
    reason = f"smallest model that {reached} the distance of the two halves of the ensemble"
    return candidates[best], Selection(reason, tried[best].distance, noise, tuple(tried)), models[best]


def _windows(times: Tensor, ends: tuple[float, ...]) -> list[Tensor]:
    """Times above 0: all of them, those up to each end, and those after the last; windows without times are left out."""
    used = times > 0
    found = [used, *(used & (times <= end) for end in ends), *(times > end for end in ends[-1:])]
    return [window for window in found if bool(window.any())]
