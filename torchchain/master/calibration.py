"""Calibrate a master equation on a band transfer: one entry for every method and model (Sections 3.4, 3.5)."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from torchchain import checks
from torchchain.ensemble.measured_transfer import with_late_average
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.certificate import certify
from torchchain.master.certified import certified
from torchchain.master.compact import OddsModel
from torchchain.master.equation import MasterEquation
from torchchain.master.fits import WINDOW, FitWarning, checked_window, within
from torchchain.master.ladder import MODELS, fitted_by, methods
from torchchain.master.memory import MemoryModel, ProjectionReport
from torchchain.master.model import TransferModel
from torchchain.master.rates import RateModel
from torchchain.master.records import Fit, NoSettings, Recipe, ReducedModel
from torchchain.master.report import Calibration, Report
from torchchain.master.sample import Sample, loss_of
from torchchain.master.selection import select
from torchchain.master.starts import can_fit, fit_starts, with_errors
from torchchain.master.uncertainty import draw_again, horizon
from torchchain.progress import bar
from torchchain.threads import beside, core_free, single_blas_thread

REPLICATES = 20
"""Of the bootstrap, where fits are quick."""


def recipe(
    data: Scene | BandTransfer,
    method: str | None = None,
    model: str | None = None,
    window: tuple[float, float] | None = None,
    bootstrap: int | None = None,
    **settings: Any,
) -> Recipe:
    """The arguments of :func:`calibrate`, checked before hours go into an ensemble for them.

    Args:
        data: the transfer, or the scene of one to come.
        method, model, window, bootstrap, settings: see :func:`calibrate`.
    """
    record = None if model is None else MODELS[checks.choice("model", model, MODELS)]
    fit = None if method is None else methods()[checks.choice("method", method, methods())]
    if record is None and fit is None and settings:  # they tell what they are settings of
        record, fit = _owner(settings)
    elif record is None and fit is not None:
        record = _richest(fit, data)
    elif record is not None and fit is None:
        fit = record.fit()
    if record is None or fit is None:
        chosen, n_times, given = NoSettings(), 2, WINDOW
    else:
        if fit not in record.fits:
            able = ", ".join(other.name for other in fitted_by(fit.name))
            raise checks.fail("model", f"be one of {able} for method '{fit.name}'", repr(record.name))
        checks.known_keys(f"settings of method '{fit.name}'", settings, fit.settings_names)
        chosen, n_times, given = fit.settings(**settings), fit.least_times, fit.window
        fit.check(chosen, len(data.times))
    if window is None and (record is None or not issubclass(record.kind, RateModel)):
        given = _widened(given, data)
    given = checked_window(given if window is None else window)
    if not data.is_ordered:
        if record is not None:
            record.check_scene(data if isinstance(data, Scene) else data.scene)
        within(data.times, given, n_times)
    return Recipe(record, fit, given, chosen)


def _widened(window: tuple[float, float], data: Scene | BandTransfer) -> tuple[float, float]:
    """The window, or the first two times where it holds no two: models with no rates need slopes for comparison only."""
    times = data.times
    if int(((times >= window[0]) & (times <= window[1])).sum()) >= 2 or len(times) < 2:
        return window
    return float(times[0]), float(times[1])


def _owner(settings: dict[str, Any]) -> tuple[ReducedModel, Fit]:
    """The model of the ladder whose fit has these settings."""
    every = [(record, record.fit(record.climbed_by)) for record in MODELS.values() if record.climbed_by is not None]
    for record, fit in reversed(every):
        if set(settings) <= set(fit.settings_names):
            return record, fit
    names = dict.fromkeys(name for _, fit in every for name in fit.settings_names)
    checks.known_keys("settings without a method", settings, names)
    raise checks.fail("settings", "be those of one method", ", ".join(settings))


def _richest(fit: Fit, data: Scene | BandTransfer) -> ReducedModel:
    """The model where only the fit is named."""
    damped = data.damping > 0
    late = not damped if isinstance(data, Scene) else data.long_time is not None
    known = isinstance(data, Scene) or data.scene is not None
    able = fitted_by(fit.name)
    return next((record for record in reversed(able) if record.default and record.suits(late, known, damped)), able[-1])


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
    the ensemble's own error on realizations it has not seen. A model with memory of chains without damping, whose
    order was not asked for, is then replaced by one whose energies are never negative and which starts like a chain,
    T(t) = I + O(t^4), if that is as near to the ensemble: ``calibration.report.certificate`` holds the proof.

    Args:
        transfer: see :func:`torchchain.band_transfer`. Of damped chains, the damping d of Eq. 51 is calibrated too.
        method: "analytic": Eq. 50 with q0 fitted to the linear procedure's rates; "linear" and "nonlinear": the
            procedures L and NL of Section 3.5 on the times in the window; "adam": Q from all times, starting from L;
            "projection": the model "memory" from all times; "logistic": the model "compact" from all times; "ringing": the theory of binary masses, corrected. None for the one that fits the model best.
        model: "paper" (basis energy Psi of Eq. 47), "exact_psi", "basis_matrix", "swing_in", "compact", "memory" (all but the
            first need the long-time average) or a registered one; None: the richest that the method fits. Where the
            transfer has no long-time average and no model is named, that of the later half of its times serves, with a warning.
        window: first and last time of the fits at short times; None for 0.5 to 2, "nonlinear" 0.5 to 4.5. Models without
            rates need no such fit: where their times are too coarse, the slopes they keep are those of the first two.
        bootstrap: number of ensembles drawn again for the error bars, 0 for none; None for 20, or none with methods
            that would take long ("adam", "nonlinear") and with fewer than 4 blocks of realizations.
        progress: show a bar if the output is a terminal.
        settings: for "adam" the fields of :class:`AdamSettings`; for "projection" ``order``, the numbers of exponentials
            and of pairs, and ``certified``, for one of that order that is never negative; for "logistic" and "correction" ``degrees`` in place, distance and time, for "ringing" also of its polynomials and how many frequencies (none: the smallest that reach the ensemble's own error on held-out realizations).

    Returns:
        MasterEquation, whose ``calibration.report`` tells how the model was chosen and fitted.

    Raises:
        FieldError: for an unknown name, a window without times, a model that the method cannot fit.

    Warns:
        FitWarning: naming how many entries of the nonlinear fit did not converge, or that Adam did not, or a model with
            memory that goes far outside the energy there is.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40)
        >>> transfer = tc.band_transfer(scene, method="modes")
        >>> master = tc.calibrate(transfer, model="basis_matrix", bootstrap=0)
        >>> tuple(master.rates.shape), master.rates.sum(-1).abs().max().item() < 1e-12
        ((8, 8), True)
    """
    checks.instance("transfer", transfer, BandTransfer)
    if model is None and transfer.long_time is None and not transfer.damping and not transfer.is_ordered:
        transfer = _settled(transfer)
    asked = recipe(transfer, method, model, window, **settings)
    count = replicates(bootstrap, asked.fit, transfer)
    if transfer.is_ordered:
        return _ordered(transfer, asked)
    report, near, spare, errors = Report(), None, None, None
    starts = partial(fit_starts, transfer) if can_fit(transfer) else lambda: None
    with (
        single_blas_thread() as threads,
        beside(starts, threads) as starts_fitted,
        bar("calibrating", None, "step", progress) as shown,
    ):
        if not asked.complete:
            asked, selection, near, spare = select(transfer, asked, shown.update, threads)
            report = replace(report, selection=selection)
        core_free()
        sample = Sample.of(transfer)
        fitted, told = asked.run(sample, near, shown.update)
        free, proof = fitted, None
        if isinstance(fitted, MemoryModel) and isinstance(told, ProjectionReport) and not sample.damped:
            fitted, told, proof = certified(
                transfer, asked, (fitted, told), report.selection is not None, shown.update, spare is not None
            )
        elif isinstance(fitted, RateModel) and report.selection is not None and not sample.damped:
            proof = certify(fitted)
            proof = proof if proof.holds else None
        sure = proof is not None or (asked.model is not None and asked.model.never_negative)
        if not sure and spare is not None:
            asked = spare  # nothing that may be negative is handed out where another can be had
            fitted, told = asked.run(sample, None, shown.update)
            free, proof = fitted, None
        report = replace(
            report, fit=told, loss=loss_of(sample), horizon=horizon(transfer, fitted), bootstrap=count,
            certificate=fitted.certificate if isinstance(fitted, OddsModel) else proof,
        )  # fmt: skip
        _check_growth(fitted, asked)
        if count:
            errors = draw_again(transfer, asked, free, count, shown.update, fitted)
        moved = starts_fitted()
        if moved is not None and errors is not None:
            moved = with_errors(moved, transfer, errors)
    return MasterEquation(fitted, _record(transfer, asked, report), errors, moved)


def _settled(transfer: BandTransfer) -> BandTransfer:
    """The transfer with the long-time average that its own later half shows, so that no model is left out for want of it."""
    found = with_late_average(transfer)
    assert found.long_time_stderr is not None
    error = float(found.long_time_stderr.max())
    warnings.warn(
        f"transfer holds no long-time average: taken over the later half of its times, t >= {float(found.times[-1]) / 2:g}, "
        f"with a standard error up to {error:.2g}",
        FitWarning,
        stacklevel=3,
    )
    return found


def _record(transfer: BandTransfer, asked: Recipe, report: Report) -> Calibration:
    method = "linear" if asked.fit is None else asked.fit.name
    model = "paper" if asked.model is None else asked.model.name
    words = transfer.provenance.words if transfer.scene is None and transfer.provenance is not None else ""
    return Calibration(method, model, asked.window, transfer.scene, report, words)


def replicates(bootstrap: int | None, fit: Fit | None, transfer: BandTransfer) -> int:
    """Ensembles to be drawn again, from what was asked for."""
    blocks = len(transfer.block_counts)
    if bootstrap is None:
        return REPLICATES if (fit is None or fit.quick) and blocks >= 4 else 0
    count = checks.integer("bootstrap", bootstrap, 0, 10**4)
    if count and blocks < 2:
        raise checks.fail(
            "bootstrap", "be 0 for one realization (error bars need runs on at least 2 chains for every source)", count
        )
    if count == 1:
        raise checks.fail("bootstrap", "be 0, or at least 2", count)
    return count


def _check_growth(model: TransferModel, asked: Recipe) -> None:
    if not isinstance(model, RateModel) or asked.fit is None:
        return
    growth = float(torch.linalg.eigvals(model.rates.detach()).real.max())
    if growth > 1e-6:
        warnings.warn(
            f"rates fitted by '{asked.fit.name}' make energy grow as exp({growth:.3g} t): do not predict beyond t = {1 / growth:.3g}",
            FitWarning,
            stacklevel=3,
        )


def _ordered(transfer: BandTransfer, asked: Recipe) -> MasterEquation:
    """Without disorder no energy leaves its band: all of it is basis energy and every rate is zero."""
    n = transfer.n_bands
    model = RateModel(torch.zeros(n, n, dtype=torch.float64), torch.ones(n, dtype=torch.float64))
    return MasterEquation(model, _record(transfer, asked, Report(ordered=True)))
