"""Calibrate a master equation on a band transfer: one entry for every method and model (Sections 3.4, 3.5)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchchain import checks
from torchchain.ensemble import BandTransfer
from torchchain.master.adam import AdamSettings, fit_rates
from torchchain.master.equation import Calibration, MasterEquation
from torchchain.master.fits import FitWarning, analytic_prefactor, linear_rates, nonlinear_rates, profile
from torchchain.master.model import RateModel
from torchchain.threads import single_thread
from torchchain.wavenumber import basis_fraction

LINEAR_WINDOW = (0.5, 2.0)
NONLINEAR_WINDOW = (0.5, 4.5)
METHODS = ("analytic", "linear", "nonlinear", "adam")


def paper_basis(transfer: BandTransfer) -> Tensor:
    """Psi of Eq. 47 on the diagonal, [source, receiver]."""
    return torch.diag(basis_fraction(transfer.scene.disorder.strength, transfer.n_bands))


def exact_psi(transfer: BandTransfer) -> Tensor:
    """The exact infinite-time share of each source's own band on the diagonal, [source, receiver]."""
    return torch.diag(_long_time(transfer).diagonal())


def exact_basis(transfer: BandTransfer) -> Tensor:
    """The exact infinite-time share of every source in every band, Pi [source, receiver]."""
    return _long_time(transfer)


def _long_time(transfer: BandTransfer) -> Tensor:
    if transfer.long_time is None:
        raise checks.fail(
            "transfer", "hold the long-time average for this model (band_transfer with long_time=True)", "none"
        )
    return transfer.long_time


BASES: dict[str, Callable[[BandTransfer], Tensor]] = {
    "paper": paper_basis,
    "exact_psi": exact_psi,
    "basis_matrix": exact_basis,
}
"""Models by what stays behind: Psi of Eq. 47, its exact value from the modes, the exact share of every pair of bands."""


def calibrate(
    transfer: BandTransfer,
    method: str = "adam",
    model: str | None = None,
    window: tuple[float, float] | None = None,
    *,
    progress: bool = False,
    **settings: Any,
) -> MasterEquation:
    """A master equation from the transfer of an ensemble.

    Args:
        transfer: see :func:`torchchain.band_transfer`.
        method: "analytic": Eq. 50 with q0 fitted to the linear procedure's rates; "linear" and "nonlinear": the
            procedures L and NL of Section 3.5 on the times in the window; "adam": Q from all times, starting from L.
        model: "paper" (basis energy Psi of Eq. 47), "exact_psi" or "basis_matrix" (needs the long-time average); None for
            the most accurate that the transfer allows.
        window: first and last time of the fits at short times; None for 0.5 to 2, "nonlinear" 0.5 to 4.5.
        progress: show a bar if the output is a terminal.
        settings: fields of :class:`AdamSettings`, for "adam".

    Returns:
        MasterEquation, whose ``calibration.report`` tells convergence and, for "analytic", q0.

    Raises:
        FieldError: for an unknown name, a window without times, a transfer without disorder.

    Warns:
        FitWarning: naming how many entries of the nonlinear fit, or whether Adam, did not converge.
    """
    checks.choice("method", method, METHODS)
    model = model or ("paper" if transfer.long_time is None else "basis_matrix")
    basis = BASES[checks.choice("model", model, BASES)](transfer)
    allowed = [entry.name for entry in fields(AdamSettings)] if method == "adam" else []
    checks.known_keys(f"settings of method '{method}'", settings, allowed)
    adam_settings = AdamSettings(**settings)
    default = NONLINEAR_WINDOW if method == "nonlinear" else LINEAR_WINDOW
    window = _window(window, default)
    if transfer.scene.is_ordered:
        return _ordered(transfer, method, model, window)
    free = (1 - basis.diagonal()).clamp(min=torch.finfo(basis.dtype).eps)
    linear = linear_rates(transfer.times, transfer.mean, free, window)
    report: dict[str, Any] = {}
    if method == "analytic":
        q0, error = analytic_prefactor(linear)
        rates, report = q0 * profile(transfer.n_bands), {"q0": q0, "q0_stderr": error}
    elif method == "linear":
        rates = linear
    elif method == "nonlinear":
        with _bar(progress, transfer.n_bands**2, "fit") as bar:
            rates, converged, _ = nonlinear_rates(transfer.times, transfer.mean, free, window, bar and bar.update)
        failed = int((~converged).sum())
        report = {"unconverged": failed, "unconverged_entries": (converged.logical_not().nonzero() + 1).tolist()}
        rates = torch.where(converged, rates, linear)
        if failed:
            warnings.warn(
                f"nonlinear fit did not converge for {failed} of {transfer.n_bands**2} pairs of bands, which take the "
                f"linear procedure's rate (calibration.report names them)",
                FitWarning,
                stacklevel=2,
            )
    else:
        with _bar(progress, adam_settings.steps, "step") as bar, single_thread():
            rates, report = fit_rates(transfer.times, transfer.mean, basis, linear, adam_settings, bar and bar.update)
        report |= {"constraint": adam_settings.constraint, "penalty": adam_settings.penalty}
        if not report["converged"]:
            warnings.warn(
                f"Adam did not converge in {adam_settings.steps} steps to tolerance {adam_settings.tolerance:g}; "
                f"loss {report['loss']:.3e}",
                FitWarning,
                stacklevel=2,
            )
    return MasterEquation(RateModel(rates, basis), Calibration(method, model, window, transfer.scene, report))


def _ordered(transfer: BandTransfer, method: str, model: str, window: tuple[float, float]) -> MasterEquation:
    """Without disorder no energy leaves its band: all of it is basis energy and every rate is zero."""
    n = transfer.n_bands
    zero, whole = torch.zeros(n, n, dtype=torch.float64), torch.ones(n, dtype=torch.float64)
    return MasterEquation(RateModel(zero, whole), Calibration(method, model, window, transfer.scene, {"ordered": True}))


def _window(window: tuple[float, float] | None, default: tuple[float, float]) -> tuple[float, float]:
    if window is None:
        return default
    if not isinstance(window, (tuple, list)) or len(window) != 2:
        raise checks.FieldTypeError(f"window must be two times, got {checks.shown(window)}")
    begin = checks.number("window", window[0], at_least=0)
    return begin, checks.number("window", window[1], above=begin)


def _bar(progress: bool, total: int, unit: str) -> Any:
    return tqdm(total=total, unit=unit, disable=None, leave=False) if progress else nullcontext()
