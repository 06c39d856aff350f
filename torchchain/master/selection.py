"""Which model: the smallest that reaches the ensemble's own error on blocks of realizations that it has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby

from torchchain import checks
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.fits import FitWarning
from torchchain.master.ladder import MODELS
from torchchain.master.model import TransferModel
from torchchain.master.records import Progress, Recipe
from torchchain.master.report import Selection
from torchchain.master.sample import Sample, exact_basis
from torchchain.master.trials import ENOUGH, Halves, Trial, record_of
from torchchain.threads import map_in_order

AS_GOOD = 1.1
"""Foreseen distance, over that of the nearest model, of a smaller one that takes its place."""
LARGE = 500
"""Fitted numbers beyond which a model is tried only where no smaller one will do."""
SURELY, MUCH_AS_FAR = 1.15, 1.03
"""Foreseen distance, over the noise, in the worst window or at the worst early time, up to which no larger model is looked for;
where there is none, that over the smallest such."""


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


def _size(recipe: Recipe, transfer: BandTransfer) -> int:
    return record_of(recipe).size(transfer.n_bands, transfer.damping > 0, recipe.settings)


def _is_sure(recipe: Recipe, transfer: BandTransfer) -> bool:
    """Whether a rung is tried also where a smaller model will do."""
    return bool(record_of(recipe).windows) and _size(recipe, transfer) <= LARGE


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
    halves = Halves(transfer, progress)
    trials: list[Trial] = []
    refused: checks.FieldError | None = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        for batch in _batches(candidates, transfer):
            done, plain = [trial for trial in trials if trial.ahead is not None], not record_of(batch[0]).windows
            if done and not _is_sure(batch[0], transfer):
                continue
            if plain and any(trial.record.windows and trial.distance <= ENOUGH * halves.noise for trial in trials):
                continue  # it would do by the measure of these, which do not look at each window of time
            for found in _tried(halves, batch, trials, workers):
                if isinstance(found, Trial):
                    trials.append(found)
                else:
                    refused = found
            if plain and any(trial.ahead is not None for trial in trials):
                break
    if not trials:
        assert refused is not None, "there is at least one candidate"
        raise refused
    best, reached = _best(trials)
    reason = f"smallest model that {reached} the distance of the two halves of the ensemble"
    sure = [trial for trial in trials if trial.record.never_negative]
    untried = next((candidate for candidate in candidates if record_of(candidate).never_negative), None)
    spare = min(sure, key=lambda trial: trial.distance).recipe if sure else untried
    told = Selection(reason, best.distance, halves.noise, tuple(trial.told for trial in trials))
    return best.recipe, told, best.model, spare


def _tried(
    halves: Halves, batch: Sequence[Recipe], trials: Sequence[Trial], workers: int
) -> list[Trial | checks.FieldError]:
    """The rungs of a batch in their order; those of different kinds side by side."""
    kinds, known = list(dict.fromkeys(record_of(rung).kind for rung in batch)), [trial.model for trial in trials]

    def climb(kind: type) -> list[Trial | checks.FieldError]:
        return halves.climb([rung for rung in batch if record_of(rung).kind is kind], known)

    found = dict(zip(kinds, map(iter, map_in_order(climb, kinds, min(workers, len(kinds)))), strict=True))
    return [next(found[record_of(rung).kind]) for rung in batch]


def _best(trials: Sequence[Trial]) -> tuple[Trial, str]:
    """The trial to take, and whether it reaches the ensemble's own error or comes nearest to it."""
    enough = [trial for trial in trials if trial.ahead is not None]
    if not enough:
        return min(trials, key=lambda trial: trial.distance), "comes nearest to"
    bar = max(SURELY, MUCH_AS_FAR * min(trial.worst for trial in enough))
    kept = [(trial, trial.ahead) for trial in enough if trial.ahead is not None and trial.worst <= bar]
    nearest = min(ahead for _, ahead in kept)
    good = [trial for trial, ahead in kept if ahead <= AS_GOOD * nearest]
    return min(good, key=lambda trial: trial.record.slow), "reaches"  # the first, hence smallest, of those


def _untested(candidates: list[Recipe]) -> tuple[Recipe, str]:
    """Of those never negative the one of the fewest fitted numbers; else the largest without windows to be tested in; and why.

    A few chains are so far from their ensemble that what follows them follows noise.
    """
    sure = [candidate for candidate in candidates if record_of(candidate).never_negative]
    if sure:
        return sure[0], "fewest fitted numbers"
    plain = [candidate for candidate in candidates if not record_of(candidate).windows]
    return (plain or candidates)[-1], "largest"
