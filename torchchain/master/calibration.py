"""Calibrate a master equation on a band transfer: one entry for every method and model (Sections 3.4, 3.5)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any

import torch
from tqdm import tqdm

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master import trust
from torchchain.master.adam import AdamSettings
from torchchain.master.equation import Calibration, MasterEquation
from torchchain.master.fits import FitWarning, checked_window, within
from torchchain.master.ladder import BASES, MODELS, Recipe, Sample, exact_basis, fit
from torchchain.master.memory import LADDER, checked_order
from torchchain.master.model import RateModel, TransferModel

LINEAR_WINDOW = (0.5, 2.0)
NONLINEAR_WINDOW = (0.5, 4.5)
METHODS = ("analytic", "linear", "nonlinear", "adam", "projection")
"""Ways to fit: four for rates Q, and variable projection for the model "memory"."""
REPLICATES = 20
"""Of the bootstrap, where fits are quick."""


def recipe(
    scene: Scene,
    method: str | None = None,
    model: str | None = None,
    window: tuple[float, float] | None = None,
    long_time: bool = True,
    **settings: Any,
) -> Recipe:
    """The arguments of :func:`calibrate`, checked before hours go into an ensemble for them.

    Args:
        scene: of the transfer to come.
        method, model, window, settings: see :func:`calibrate`.
        long_time: whether the transfer holds the long-time average.
    """
    settings.pop("bootstrap", None)
    if method is not None:
        checks.choice("method", method, METHODS)
    if model is not None:
        checks.choice("model", model, MODELS)
    if model is None and method is not None:
        richest = "memory" if method == "projection" else "basis_matrix"
        model = richest if long_time or (scene.damping > 0 and method == "projection") else "paper"
    if model is not None and method is None:
        method = "projection" if model == "memory" else "adam"
    if method is not None and (method == "projection") != (model == "memory"):
        fitting = "memory" if method == "projection" else ", ".join(BASES)
        raise checks.fail("model", f"be one of {fitting} for method '{method}'", repr(model))
    every = [entry.name for entry in fields(AdamSettings)]
    allowed = {"adam": every, "projection": ["order"], None: ["order"]}.get(method, [])
    checks.known_keys(f"settings of method '{method or 'projection'}'", settings, allowed)
    order = settings.pop("order", None)
    if order is not None:
        order = checked_order(order, len(scene.times))
        method, model = "projection", "memory"
    if window is None:
        window = NONLINEAR_WINDOW if method == "nonlinear" else LINEAR_WINDOW
    window = checked_window(window)
    if not scene.is_ordered:
        within(scene.times, window, 4 if method == "nonlinear" else 2)
    return Recipe(method, model, window, AdamSettings(**settings), order)


def calibrate(
    transfer: BandTransfer,
    method: str | None = None,
    model: str | None = None,
    window: tuple[float, float] | None = None,
    *,
    bootstrap: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> MasterEquation:
    """A master equation from the transfer of an ensemble.

    With neither method nor model, the smallest of the ladder's models (see :mod:`torchchain.master.ladder`) that reaches
    the ensemble's own error on realizations it has not seen.

    Args:
        transfer: see :func:`torchchain.band_transfer`. Of damped chains, the damping d of Eq. 51 is calibrated too.
        method: "analytic": Eq. 50 with q0 fitted to the linear procedure's rates; "linear" and "nonlinear": the
            procedures L and NL of Section 3.5 on the times in the window; "adam": Q from all times, starting from L;
            "projection": the model "memory" from all times. None for the one that fits the model best.
        model: "paper" (basis energy Psi of Eq. 47), "exact_psi", "basis_matrix", "swing_in" or "memory" (all but the
            first need the long-time average); None: the richest that the method fits.
        window: first and last time of the fits at short times; None for 0.5 to 2, "nonlinear" 0.5 to 4.5.
        bootstrap: number of ensembles drawn again for the error bars, 0 for none; None for 20, or none with methods
            that would take long ("adam", "nonlinear") and with fewer than 4 blocks of realizations.
        progress: show a bar if the output is a terminal.
        settings: for "adam" the fields of :class:`AdamSettings`; for "projection" ``order``, the numbers of exponentials
            and of pairs (none: the smallest that reaches the ensemble's own error on held-out realizations).

    Returns:
        MasterEquation, whose ``calibration.report`` tells how the model was chosen and fitted.

    Raises:
        FieldError: for an unknown name, a window without times, a model that the method cannot fit.

    Warns:
        FitWarning: naming how many entries of the nonlinear fit did not converge, or that Adam did not.
    """
    checks.instance("transfer", transfer, BandTransfer)
    held = transfer.long_time is not None
    asked = recipe(transfer.scene, method, model, window, held, **settings)
    replicates = _replicates(bootstrap, asked.method, transfer)
    if transfer.scene.is_ordered:
        return _ordered(transfer, asked)
    report: dict[str, Any] = {}
    with _counter(progress, None, "step") as step:
        if asked.model is None or (asked.model == "memory" and asked.order is None):
            asked, report = select(transfer, asked, step)
        fitted, details = fit(Sample.of(transfer), asked, progress=step)
        report = report | details
        _check_growth(fitted, asked)
        uncertainty = None
        if replicates:
            uncertainty = trust.bootstrap(transfer, asked, fitted, replicates, step)
            report["bootstrap"] = replicates
    limit = trust.horizon(transfer, fitted)
    report["horizon"] = limit if math.isfinite(limit) else "infinite"
    assert asked.method is not None, "chosen above"
    assert asked.model is not None, "chosen above"
    return MasterEquation(
        fitted, Calibration(asked.method, asked.model, asked.window, transfer.scene, report), uncertainty
    )


def _replicates(bootstrap: int | None, method: str | None, transfer: BandTransfer) -> int:
    blocks = len(transfer.block_counts)
    if bootstrap is None:
        return REPLICATES if method not in ("adam", "nonlinear") and blocks >= 4 else 0
    count = checks.integer("bootstrap", bootstrap, 0, 10**4)
    if count == 1 or (count and blocks < 2):
        raise checks.fail("bootstrap", "be 0, or at least 2 for at least 2 blocks of realizations", count)
    return count


def _check_growth(model: TransferModel, chosen: Recipe) -> None:
    if not isinstance(model, RateModel):
        return
    growth = float(torch.linalg.eigvals(model.rates.detach()).real.max())
    if growth > 1e-6:
        warnings.warn(
            f"rates fitted by '{chosen.method}' make energy grow as exp({growth:.3g} t): do not predict beyond t = {1 / growth:.3g}",
            FitWarning,
            stacklevel=3,
        )


def rungs(asked: Recipe, transfer: BandTransfer) -> list[Recipe]:
    """The models that :func:`select` tries, from the fewest fitted numbers up."""
    affordable = [order for order in LADDER if 2 * (order[0] + 2 * order[1]) <= len(transfer.times)]
    if not affordable:
        raise checks.fail("transfer", "have at least 2 times for model 'memory'", f"{len(transfer.times)}")
    damped = transfer.scene.damping > 0
    if asked.model == "memory" and not damped:
        exact_basis(Sample.of(transfer))  # an error if there is none
    memory = [replace(asked, method="projection", model="memory", order=order) for order in affordable]
    if transfer.long_time is None and not damped:
        memory = []
    if asked.model == "memory":
        return memory
    usable = [name for name in BASES if name == "paper" or transfer.long_time is not None]
    rated = [replace(asked, method="linear", model=name, order=None) for name in usable]
    bands = transfer.n_bands**2
    numbers = {
        "paper": bands,
        "exact_psi": bands + transfer.n_bands,
        "basis_matrix": 2 * bands,
        "swing_in": 2 * bands + 1,
    }

    def size(entry: Recipe) -> int:
        if entry.order is None:
            return numbers[entry.model or "paper"]
        functions = entry.order[0] + 2 * entry.order[1]
        return bands * (functions + damped) + functions

    return sorted(rated + memory, key=size)


def select(transfer: BandTransfer, asked: Recipe, progress: Any = None) -> tuple[Recipe, dict[str, Any]]:
    """The first rung that, fitted on every other block, predicts the rest as well as the fitted blocks' means do.

    As well: within 5 % in total variation, for the distance of two halves is itself uncertain by some per cent. If
    none does, the nearest. Models with rates are tried with procedure L.

    Returns:
        The recipe of the rung, and what was tried: model, order, held-out distance.
    """
    candidates = rungs(asked, transfer)
    blocks = len(transfer.block_counts)
    if blocks < 4:
        return candidates[-1], {"selection": "largest: too few blocks of realizations to hold some out"}
    even = (torch.arange(blocks) + 1) % 2
    seen, held = Sample.of_blocks(transfer, even), Sample.of_blocks(transfer, 1 - even).mean
    used = transfer.times > 0
    noise = float(total_variation(seen.mean, held)[:, used].mean())
    enough = 1.05 * noise
    tried: list[list[Any]] = []
    for candidate in candidates:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            model, _ = fit(seen, candidate, progress=progress)
        distance = float(total_variation(model.transfer(transfer.times).detach(), held)[:, used].mean())
        tried.append([candidate.model, list(candidate.order or ()), distance])
        if distance <= enough:
            break
    best = len(tried) - 1 if tried[-1][2] <= enough else min(range(len(tried)), key=lambda i: tried[i][2])
    reached = "reaches" if tried[best][2] <= enough else "comes nearest to"
    return candidates[best], {
        "selection": f"smallest model that {reached} the distance of the two halves of the ensemble",
        "held_out_distance": tried[best][2],
        "halves_distance": noise,
        "tried": tried,
    }


def _ordered(transfer: BandTransfer, asked: Recipe) -> MasterEquation:
    """Without disorder no energy leaves its band: all of it is basis energy and every rate is zero."""
    n = transfer.n_bands
    model = RateModel(torch.zeros(n, n, dtype=torch.float64), torch.ones(n, dtype=torch.float64))
    record = Calibration(
        asked.method or "linear", asked.model or "paper", asked.window, transfer.scene, {"ordered": True}
    )
    return MasterEquation(model, record)


@contextmanager
def _counter(progress: bool, total: int | None, unit: str) -> Iterator[Callable[[int], Any] | None]:
    """What a fit calls as it goes on: a bar's update on a terminal, or None."""
    if not progress:
        yield None
        return
    with tqdm(total=total, unit=unit, disable=None, leave=False) as bar:
        yield bar.update
