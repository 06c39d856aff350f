"""A rung of the ladder on trial: fitted to half of an ensemble's blocks, held to the other half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.model import TransferModel
from torchchain.master.records import Progress, Recipe, ReducedModel
from torchchain.master.report import Rung
from torchchain.master.sample import Sample, decade_weights
from torchchain.master.uncertainty import kept_times

FIRST = 5.0
"""Time up to which a model is held to every single time, not to windows alone: waves collide once and nothing is averaged yet."""
SEEN = 128
"""Times at which models are compared with the half that they have not seen."""
ENOUGH = 1.05
"""Distance of a model that is as good as the ensemble, over that of two halves, which is itself uncertain by some per cent."""


def record_of(recipe: Recipe) -> ReducedModel:
    """The model that a rung names."""
    assert recipe.model is not None, "a rung names its model"
    return recipe.model


@dataclass(frozen=True, eq=False)
class Trial:
    """How a rung did.

    Attributes:
        recipe: of the rung.
        model: fitted to the first half.
        distance: from the other half, each decade of time counting alike.
        ahead: what is foreseen of a fit to all blocks, over the distance of two ensembles, if it will do: the mean over the
            windows of time; None if it will not.
        worst: and the largest of any window, and of any single early time.
    """

    recipe: Recipe
    model: TransferModel
    distance: float
    ahead: float | None = None
    worst: float = 1.0

    @property
    def record(self) -> ReducedModel:
        """The model that was tried."""
        return record_of(self.recipe)

    @property
    def told(self) -> Rung:
        """For the report."""
        return Rung(self.record.name, self.recipe.order, self.distance)


class Halves:
    """Every other block of an ensemble, and the rest.

    Args:
        transfer: of four blocks at least.
        progress: called with 1 after every step of a fit.

    Attributes:
        noise: distance of the two, each decade of time counting alike.
    """

    def __init__(self, transfer: BandTransfer, progress: Progress = None) -> None:
        even = (torch.arange(len(transfer.block_counts)) + 1) % 2
        self._parts = Sample.of_blocks(transfer, even), Sample.of_blocks(transfer, 1 - even)
        seen = kept_times(transfer.times, SEEN)
        self._times, self._means = transfer.times[seen], [part.mean[:, seen] for part in self._parts]
        self._apart = total_variation(*self._means).mean(0)
        self._weight = decade_weights(self._times)
        self._first = (self._times > 0) & (self._times <= FIRST)
        expected = 2**0.5 * statistical_distance(transfer.stderr[:, seen]).mean(0)
        self._scatter = torch.maximum(self._apart, expected)[self._first]
        self._progress = progress
        self.noise = float(self._apart @ self._weight)

    def climb(self, rungs: Sequence[Recipe], known: Sequence[TransferModel]) -> list[Trial | checks.FieldError]:
        """What became of rungs of one kind, each beginning with the model of the one before; an error where none can be made."""
        found: list[Trial | checks.FieldError] = []
        for recipe in rungs:
            before = [*known, *(trial.model for trial in found if isinstance(trial, Trial))]
            try:
                found.append(self._attempt(recipe, before))
            except checks.FieldError as error:  # of half of the data no model of this kind can be made
                found.append(error)
        return found

    def _fitted(self, recipe: Recipe, half: int, near: TransferModel | None) -> tuple[TransferModel, Tensor]:
        model, _ = recipe.run(self._parts[half], near, self._progress)
        return model, model.transfer(self._times).detach()

    def _attempt(self, recipe: Recipe, known: Sequence[TransferModel]) -> Trial:
        record, apart = record_of(recipe), self._apart
        like = next((m for m in known[::-1] if record.windows and isinstance(m, record.kind)), None)
        model, found = self._fitted(recipe, 0, like)
        missed = total_variation(found, self._means[1]).mean(0)
        distance = float(missed @ self._weight)
        if not record.windows:
            return Trial(recipe, model, distance, 1.0 if distance <= ENOUGH * self.noise else None)
        if not foreseen(apart, missed, apart) @ self._weight <= record.near:  # sure to be too far off
            return Trial(recipe, model, distance)
        _, other = self._fitted(recipe, 1, model)
        both = (missed + total_variation(other, self._means[0]).mean(0)) / 2
        spread = total_variation(found, other).mean(0)
        ahead = [
            float(foreseen(*(part[window].mean() for part in (apart, both, spread))))
            for window in windows(self._times, record.windows)
        ]
        singly = foreseen(apart[self._first], both[self._first], spread[self._first], self._scatter)
        if max(ahead) > record.near:
            return Trial(recipe, model, distance)
        return Trial(recipe, model, distance, sum(ahead) / len(ahead), max([*ahead, *singly.tolist()]))


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


def windows(times: Tensor, ends: tuple[float, ...]) -> list[Tensor]:
    """Times above 0 up to each end, and those after the last; windows without times are left out."""
    found = [*((times > 0) & (times <= end) for end in ends), *(times > end for end in ends[-1:])]
    return [window for window in found if bool(window.any())]
