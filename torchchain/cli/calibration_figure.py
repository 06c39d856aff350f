"""The figure of a calibration: ensemble and model of some source bands, rates, and how far the model is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchchain import checks, plots
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master import MasterEquation
from torchchain.master.paper_rates import paper_rates

MOST_SHOWN = 6
ROOM = plots.Room(left=0.45, right=0.06, below=0.85, above=0.22, across=0.98, down=0.94)
"""For two lines of a legend below each panel, three below the last; labels of colors beside each but the last."""


@dataclass(frozen=True)
class Rates:
    """Rates between bands [source, receiver], the standard error of their diagonal or None, and what they are."""

    values: np.ndarray
    error: np.ndarray | None
    meaning: str


def sources_of(asked: str | None, n_bands: int) -> tuple[int, ...]:
    """The source bands to be drawn, from words like "12,15"; the paper's 10 and 23 of 32, or those at their places."""
    if asked is None:
        return tuple(dict.fromkeys(max(1, round(n_bands * place / 32)) for place in (10, 23)))
    words = asked.replace(",", " ").split()
    if not 1 <= len(words) <= MOST_SHOWN or not all(word.isdecimal() for word in words):
        raise checks.fail("show", f"be 1 to {MOST_SHOWN} bands, as in 12,15", repr(asked))
    return tuple(dict.fromkeys(checks.integer("show", int(word), 1, n_bands) for word in words))


def rates_of(transfer: BandTransfer, master: MasterEquation) -> Rates:
    """The paper's Q of the ensemble; where it has none, the model's."""
    try:
        found = paper_rates(transfer)
    except checks.FieldError:  # too few times early on, or an unknown disorder
        return Rates(master.rates.detach().numpy(), None, master.rates_meaning)
    error = found["rates_stderr"].values.diagonal()
    window = " to ".join(f"{time:g}" for time in found.attrs["window"])
    return Rates(found["rates"].values, error if np.isfinite(error).all() else None, f"procedure L, t = {window}")


def calibration_figure(
    transfer: BandTransfer, master: MasterEquation, predicted: torch.Tensor, rates: Rates, shown: Sequence[int]
) -> Any:
    """Measured and predicted maps and decay of each shown source; rates, their balance, and the distance over time."""
    times, mean, stderr = transfer.times.numpy(), transfer.mean.numpy(), transfer.stderr.numpy()
    model = predicted.numpy()
    with plots.style():
        figure, axes = plots.figure(plots.PAGE, 2.2 * len(shown) + 2.3, len(shown) + 1, 3, ROOM)
        for row, source in zip(axes, shown, strict=False):
            plots.band_map(row[0], times, mean[source - 1], f"chains, source {source}")
            plots.band_map(row[1], times, model[source - 1], f"model, source {source}")
            receivers = dict.fromkeys((source, max(1, source - 3)))
            at = (source - 1, slice(None), slice(None))
            plots.decays(row[2], times, mean[at], stderr[at], source, list(receivers), model[at])
        plots.rate_map(axes[-1, 0], rates.values, "" if rates.error is None else "$Q$")
        distance, noise = total_variation(predicted, transfer.mean), statistical_distance(transfer.stderr)
        plots.distance_curve(axes[-1, 1], times, distance.numpy(), noise.numpy())
        _balance(axes[-1, 2], rates)
        plots.lettered(axes.flat)
    return figure


def _balance(ax: Any, rates: Rates) -> None:
    """What every band loses, beside what all others gain from it: the same where energy is conserved."""
    bands, loss = np.arange(1, len(rates.values) + 1), -rates.values.diagonal()
    ax.errorbar(bands, loss, rates.error, fmt="o", mfc="none", label="$-Q_{ss}$")
    ax.plot(bands, rates.values.sum(-1) + loss, "-", label=r"$\sum_{r \neq s} Q_{sr}$")
    ax.set(xlabel="source $s$", ylabel="rate")
    plots.legend(ax)
