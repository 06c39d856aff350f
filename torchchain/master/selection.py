"""Which model: the smallest that reaches the ensemble's own error on blocks of realizations that it has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.fits import FitWarning
from torchchain.master.ladder import MODELS
from torchchain.master.model import TransferModel
from torchchain.master.records import Progress, Recipe, ReducedModel
from torchchain.master.report import Rung, Selection
from torchchain.master.sample import Sample, decade_weights, exact_basis
from torchchain.master.uncertainty import kept_times
from torchchain.threads import map_in_order

AS_GOOD = 1.1
"""Foreseen distance, over that of the nearest model, of a smaller one that takes its place."""
LARGE = 500
"""Fitted numbers beyond which a model is tried only where no smaller one will do."""
SURELY, MUCH_AS_FAR = 1.15, 1.03
"""Foreseen distance, over the noise, in the worst window or at the worst early time, up to which no larger model is looked for;
where there is none, that over the smallest such."""
FIRST = 5.0
"""Time up to which a model is held to every single time, not to windows alone: waves collide once and nothing is averaged yet."""
SEEN = 128
"""Times at which models are compared with the half that they have not seen."""
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
            found.append(replace(asked, model=record, fit=fit, settings=settings))
    ordered = sorted(found, key=lambda recipe: _size(recipe, transfer))
    sure = [recipe for recipe in ordered if recipe.model is not None and recipe.model.never_negative]
    return sure if damped and sure else ordered


def _model(recipe: Recipe) -> ReducedModel:
    assert recipe.model is not None, "a rung names its model"
    return recipe.model


def _size(recipe: Recipe, transfer: BandTransfer) -> int:
    return _model(recipe).size(transfer.n_bands, transfer.damping > 0, recipe.settings)


def _is_sure(recipe: Recipe, transfer: BandTransfer) -> bool:
    """Whether a rung is tried also where a smaller model will do."""
    return bool(_model(recipe).windows) and _size(recipe, transfer) <= LARGE


def _batches(candidates: list[Recipe], transfer: BandTransfer) -> Iterator[list[Recipe]]:
    """The rungs in order, those together of which each is tried whatever the others show."""
    for sure, some in groupby(candidates, lambda recipe: _is_sure(recipe, transfer)):
        rungs = list(some)
        yield from [rungs] if sure else [[each] for each in rungs]


def select(
    transfer: BandTransfer, asked: Recipe, progress: Progress = None, workers: int = 1
) -> tuple[Recipe, Selection, TransferModel | None, Recipe | None]:
    """The first rung that, fitted on every other block, predicts the rest as well as the fitted blocks' means do.

    As well: within 5 % in total variation, each decade of time counting alike. A model with windows of time will do if,
    fitted to all blocks, it is foreseen to be within ``near`` times the noise in every one, and is taken if no larger
    one of its like is foreseen to be nearer by more than a tenth, nor one as near that predicts faster; those come first
    that are within ``SURELY`` times the noise in every window and at every single time up to ``FIRST``. If none will do,
    the nearest is taken; models without windows are tried only where those with are farther than 5 % over all times.
    Models with rates are tried with procedure L. Rungs of different kinds that are tried in any case are fitted side by
    side on as many threads as there are ``workers``, one thread of BLAS each.

    Returns:
        The recipe of the rung, what was tried, the model fitted to half of the blocks, and of the rungs that were tried the
        nearest whose energies are never negative by its form; if there was none, the smallest of those that were not tried.
    """
    candidates = rungs(asked, transfer)
    blocks = len(transfer.block_counts)
    if blocks < 4:
        untested, reason = _untested(candidates)
        return untested, Selection(f"{reason}: too few blocks of realizations to hold some out"), None, None
    even = (torch.arange(blocks) + 1) % 2
    parts = Sample.of_blocks(transfer, even), Sample.of_blocks(transfer, 1 - even)
    seen = kept_times(transfer.times, SEEN)
    times, means = transfer.times[seen], [part.mean[:, seen] for part in parts]
    halves = total_variation(*means).mean(0)
    weight = decade_weights(times)
    noise = float(halves @ weight)
    first = (times > 0) & (times <= FIRST)
    scatter = torch.maximum(halves, 2**0.5 * statistical_distance(transfer.stderr[:, seen]).mean(0))[first]
    tried: list[Rung] = []
    models: list[TransferModel] = []
    chosen: list[Recipe] = []
    enough: dict[int, float] = {}  # foreseen distance of those that will do, by their place among the tried
    worst: dict[int, float] = {}  # and the largest of any window, and of any early time
    refused: checks.FieldError | None = None

    def fitted(recipe: Recipe, sample: Sample, near: TransferModel | None = None) -> tuple[TransferModel, Tensor]:
        model, _ = recipe.run(sample, near, progress)
        return model, model.transfer(times).detach()

    def attempt(
        candidate: Recipe, known: list[TransferModel]
    ) -> tuple[TransferModel, float, tuple[float, float] | None]:
        """The model, its distance, and that foreseen if it will do: its mean, and the largest."""
        record = _model(candidate)
        like = next((m for m in known[::-1] if record.windows and isinstance(m, record.kind)), None)
        model, found = fitted(candidate, parts[0], like)
        missed = total_variation(found, means[1]).mean(0)
        distance = float(missed @ weight)
        if not record.windows:
            return model, distance, (1.0, 1.0) if distance <= ENOUGH * noise else None
        if not foreseen(halves, missed, halves) @ weight <= record.near:  # sure to be too far off
            return model, distance, None
        _, other = fitted(candidate, parts[1], model)
        both = (missed + total_variation(other, means[0]).mean(0)) / 2
        spread = total_variation(found, other).mean(0)
        ahead = [
            float(foreseen(*(part[window].mean() for part in (halves, both, spread))))
            for window in windows(times, record.windows)
        ]
        singly = foreseen(halves[first], both[first], spread[first], scatter)
        far = max(*ahead, float(singly.max()) if len(singly) else 0.0)
        return model, distance, (sum(ahead) / len(ahead), far) if max(ahead) <= record.near else None

    def climb(ladder: list[tuple[int, Recipe]]) -> dict[int, Any]:
        """What became of rungs of one kind, each beginning with the model of the one before, by their place."""
        found: dict[int, Any] = {}
        for place, candidate in ladder:
            known = [*models, *(each[0] for each in found.values() if isinstance(each, tuple))]
            try:
                found[place] = attempt(candidate, known)
            except checks.FieldError as error:  # of half of the data no model of this kind can be made
                found[place] = error
        return found

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        for batch in _batches(candidates, transfer):
            if enough and not _is_sure(batch[0], transfer):
                continue
            near = [rung.distance for rung in tried if MODELS[rung.model].windows]
            if near and min(near) <= ENOUGH * noise and not _model(batch[0]).windows:
                continue  # it would do by the measure of these, which do not look at each window of time
            kinds: dict[type, list[tuple[int, Recipe]]] = {}
            for place, candidate in enumerate(batch):
                kinds.setdefault(_model(candidate).kind, []).append((place, candidate))
            found = {
                k: v for part in map_in_order(climb, kinds.values(), min(workers, len(kinds))) for k, v in part.items()
            }
            for place, candidate in enumerate(batch):
                if isinstance(found[place], checks.FieldError):
                    refused = found[place]
                    continue
                model, distance, ahead = found[place]
                chosen.append(candidate)
                models.append(model)
                tried.append(Rung(_model(candidate).name, candidate.order, distance))
                if ahead is not None:
                    enough[len(tried) - 1], worst[len(tried) - 1] = ahead
            if enough and not _model(batch[0]).windows:
                break
    if not tried:
        assert refused is not None, "there is at least one candidate"
        raise refused
    if enough:
        bar = max(SURELY, MUCH_AS_FAR * min(worst.values()))
        enough = {i: distance for i, distance in enough.items() if worst[i] <= bar}
        good = [i for i, distance in enough.items() if distance <= AS_GOOD * min(enough.values())]
        best = min(good, key=lambda i: (MODELS[tried[i].model].slow, i))
    else:
        best = min(range(len(tried)), key=lambda i: tried[i].distance)
    reached = "reaches" if enough else "comes nearest to"
    reason = f"smallest model that {reached} the distance of the two halves of the ensemble"
    sure = [i for i, rung in enumerate(tried) if MODELS[rung.model].never_negative]
    untried = next((candidate for candidate in candidates if _model(candidate).never_negative), None)
    spare = chosen[min(sure, key=lambda i: tried[i].distance)] if sure else untried
    return chosen[best], Selection(reason, tried[best].distance, noise, tuple(tried)), models[best], spare


def foreseen(halves: Tensor, missed: Tensor, spread: Tensor, scatter: Tensor | None = None) -> Tensor:
    """Distance of a model of all blocks from fresh chains, over that of two ensembles.

    Errors add in squares: the held-out half is missed by the model's own error, by that of the blocks that it was fitted
    to, and by the half's own; the latter two are half as large, squared, in twice the chains.

    Args:
        halves: distance of the two halves of the ensemble.
        missed: of a model of one half from the other half.
        spread: of the models of either half.
        scatter: distance that is expected of halves, where a single time tells too little of it; None for theirs.
    """
    squared = halves.square()
    own = (missed.square() - (squared + spread.square()) / 4).clamp(min=0)
    return (own / ((halves if scatter is None else scatter).square() / 2).clamp(min=1e-300)).sqrt()


def _untested(candidates: list[Recipe]) -> tuple[Recipe, str]:
    """Of those never negative the one of the fewest fitted numbers; else the largest without windows to be tested in; and why.

    A few chains are so far from their ensemble that what follows them follows noise.
    """
    sure = [candidate for candidate in candidates if _model(candidate).never_negative]
    if sure:
        return sure[0], "fewest fitted numbers"
    plain = [candidate for candidate in candidates if not _model(candidate).windows]
    return (plain or candidates)[-1], "largest"


def windows(times: Tensor, ends: tuple[float, ...]) -> list[Tensor]:
    """Times above 0 up to each end, and those after the last; windows without times are left out."""
    found = [*((times > 0) & (times <= end) for end in ends), *(times > end for end in ends[-1:])]
    return [window for window in found if bool(window.any())]
