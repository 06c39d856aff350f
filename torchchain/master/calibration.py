"""Calibrate a master equation on a band transfer: one entry for every method and model (Sections 3.4, 3.5)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchchain import checks
from torchchain.ensemble import BandTransfer
from torchchain.master.adam import AdamSettings, fit_rates
from torchchain.master.equation import Calibration, MasterEquation
from torchchain.master.fits import FitWarning, analytic_prefactor, linear_rates, nonlinear_rates, profile, within
from torchchain.master.memory import LADDER, MemoryModel, checked_order, fit_memory
from torchchain.master.model import RateModel
from torchchain.scene import Scene
from torchchain.statistics import total_variation
from torchchain.threads import single_blas_thread, single_thread
from torchchain.wavenumber import basis_fraction

LINEAR_WINDOW = (0.5, 2.0)
NONLINEAR_WINDOW = (0.5, 4.5)
METHODS = ("analytic", "linear", "nonlinear", "adam", "projection")
"""Ways to fit: four for rates Q, and variable projection for the model "memory"."""


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


MODELS = (*BASES, "memory")


@dataclass(frozen=True)
class Recipe:
    """A calibration in every detail: what :func:`calibrate` makes of its arguments."""

    method: str
    model: str
    window: tuple[float, float]
    adam: AdamSettings
    order: tuple[int, int] | None


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
    if method is not None:
        checks.choice("method", method, METHODS)
    if model is None:
        model = "memory" if method in (None, "projection") and long_time else "basis_matrix" if long_time else "paper"
    checks.choice("model", model, MODELS)
    if method is None:
        method = "projection" if model == "memory" else "adam"
    if (method == "projection") != (model == "memory"):
        fitting = "memory" if method == "projection" else ", ".join(BASES)
        raise checks.fail("model", f"be one of {fitting} for method '{method}'", repr(model))
    allowed = {"adam": [entry.name for entry in fields(AdamSettings)], "projection": ["order"]}.get(method, [])
    checks.known_keys(f"settings of method '{method}'", settings, allowed)
    order = settings.pop("order", None)
    if order is not None:
        order = checked_order(order, len(scene.times))
    window = _window(window, NONLINEAR_WINDOW if method == "nonlinear" else LINEAR_WINDOW)
    if not scene.is_ordered:
        within(scene.times, window, 4 if method == "nonlinear" else 2)
    return Recipe(method, model, window, AdamSettings(**settings), order)


def calibrate(
    transfer: BandTransfer,
    method: str | None = None,
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
            procedures L and NL of Section 3.5 on the times in the window; "adam": Q from all times, starting from L;
            "projection": the model "memory" from all times. None for the one that fits the model best.
        model: "paper" (basis energy Psi of Eq. 47), "exact_psi", "basis_matrix" or "memory" (these need the
            long-time average); None for the most accurate that method and transfer allow.
        window: first and last time of the fits at short times; None for 0.5 to 2, "nonlinear" 0.5 to 4.5.
        progress: show a bar if the output is a terminal.
        settings: for "adam" the fields of :class:`AdamSettings`; for "projection" ``order``, the numbers of exponentials
            and of pairs (none: the smallest that reaches the ensemble's own error on held-out realizations).

    Returns:
        MasterEquation, whose ``calibration.report`` tells convergence, q0 of "analytic", the order of "memory".

    Raises:
        FieldError: for an unknown name, a window without times, a model that the method cannot fit.

    Warns:
        FitWarning: naming how many entries of the nonlinear fit did not converge, or that Adam did not.
    """
    chosen = recipe(transfer.scene, method, model, window, transfer.long_time is not None, **settings)
    method, model, window = chosen.method, chosen.model, chosen.window
    basis = BASES.get(model, exact_basis)(transfer)
    record = Calibration(method, model, window, transfer.scene)
    if transfer.scene.is_ordered:
        return _ordered(transfer, record)
    free = (1 - basis.diagonal()).clamp(min=torch.finfo(basis.dtype).eps)
    linear = linear_rates(transfer.times, transfer.mean, free, window)
    if model == "memory":
        tensors, report = _memory(transfer, chosen.order, progress)
        return MasterEquation(MemoryModel(rates=linear, **tensors), replace(record, report=report))
    if method == "analytic":
        q0, error = analytic_prefactor(linear)
        rates, report = q0 * profile(transfer.n_bands), {"q0": q0, "q0_stderr": error}
    elif method == "linear":
        rates, report = linear, {}
    elif method == "nonlinear":
        rates, report = _nonlinear(transfer, free, window, linear, progress)
    else:
        rates, report = _adam(transfer, basis, linear, chosen.adam, progress)
    growth = float(torch.linalg.eigvals(rates).real.max())
    if growth > 1e-6:
        warnings.warn(
            f"rates fitted by '{method}' make energy grow as exp({growth:.3g} t): do not predict beyond t = {1 / growth:.3g}",
            FitWarning,
            stacklevel=2,
        )
    return MasterEquation(RateModel(rates, basis), replace(record, report=report))


def _nonlinear(
    transfer: BandTransfer, free: Tensor, window: tuple[float, float], linear: Tensor, progress: bool
) -> tuple[Tensor, dict[str, Any]]:
    with _counter(progress, transfer.n_bands**2, "fit") as step:
        rates, converged, _ = nonlinear_rates(transfer.times, transfer.mean, free, window, step)
    failed = int((~converged).sum())
    if failed:
        warnings.warn(
            f"nonlinear fit did not converge for {failed} of {transfer.n_bands**2} pairs of bands, which take the "
            f"linear procedure's rate (calibration.report names them)",
            FitWarning,
            stacklevel=3,
        )
    report = {"unconverged": failed, "unconverged_entries": (converged.logical_not().nonzero() + 1).tolist()}
    return torch.where(converged, rates, linear), report


def _adam(
    transfer: BandTransfer, basis: Tensor, linear: Tensor, settings: AdamSettings, progress: bool
) -> tuple[Tensor, dict[str, Any]]:
    with _counter(progress, settings.steps, "step") as step, single_thread():
        rates, report = fit_rates(transfer.times, transfer.mean, basis, linear, settings, step)
    if not report["converged"]:
        warnings.warn(
            f"Adam did not converge in {settings.steps} steps to tolerance {settings.tolerance:g}; loss {report['loss']:.3e}",
            FitWarning,
            stacklevel=3,
        )
    return rates, report | {"constraint": settings.constraint, "penalty": settings.penalty}


def _memory(
    transfer: BandTransfer, order: tuple[int, int] | None, progress: bool
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Fit the model "memory", choosing its order on held-out realizations where none is given."""
    basis = exact_basis(transfer)
    affordable = [rung for rung in LADDER if 2 * (rung[0] + 2 * rung[1]) <= len(transfer.times)]
    if not affordable:
        raise checks.fail("transfer", "have at least 2 times for model 'memory'", f"{len(transfer.times)}")
    report: dict[str, Any] = {}
    with _counter(progress, None, "start") as step, single_blas_thread():
        if order is None and len(transfer.block_counts) < 4:
            order = affordable[-1]
            report["selection"] = "largest order: too few blocks of realizations to hold some out"
        elif order is None:
            order, report = _selected_order(transfer, affordable, step)
        tensors, fitted = fit_memory(transfer.times, transfer.mean, basis, order, progress=step)
    return tensors, report | fitted


def _selected_order(
    transfer: BandTransfer, orders: list[tuple[int, int]], step: Any
) -> tuple[tuple[int, int], dict[str, Any]]:
    """The first order that, fitted on every other block, predicts the rest as well as the fitted blocks' means do.

    As well: within 5 %, for the distance of two halves is itself uncertain by some per cent.
    """
    (mean, basis), (held, _) = (_half(transfer, parity) for parity in (0, 1))
    used = transfer.times > 0
    noise = float(total_variation(mean, held)[:, used].mean())
    enough = 1.05 * noise
    tried: list[list[Any]] = []
    for order in orders:
        tensors, _ = fit_memory(transfer.times, mean, basis, order, starts=3, progress=step)
        model = MemoryModel(rates=torch.zeros_like(basis), **tensors)
        tried.append([list(order), float(total_variation(model.transfer(transfer.times), held)[:, used].mean())])
        if tried[-1][1] <= enough:
            break
    chosen = tried[-1] if tried[-1][1] <= enough else min(tried, key=lambda entry: entry[1])
    reached = "reaches" if chosen[1] <= enough else "comes nearest to"
    return (chosen[0][0], chosen[0][1]), {
        "selection": f"smallest order that {reached} the distance of the two halves of the ensemble",
        "held_out_distance": chosen[1],
        "halves_distance": noise,
        "tried": tried,
    }


def _half(transfer: BandTransfer, parity: int) -> tuple[Tensor, Tensor]:
    """Mean transfer and long-time average over every other block."""
    weight = torch.tensor(transfer.block_counts[parity::2], dtype=transfer.mean.dtype)
    weight = weight / weight.sum()
    assert transfer.block_long_time is not None, "exact_basis has checked it"
    return (
        torch.einsum("b,bstr->str", weight, transfer.block_mean[parity::2]),
        torch.einsum("b,bsr->sr", weight, transfer.block_long_time[parity::2]),
    )


def _ordered(transfer: BandTransfer, record: Calibration) -> MasterEquation:
    """Without disorder no energy leaves its band: all of it is basis energy and every rate is zero."""
    n = transfer.n_bands
    model = RateModel(torch.zeros(n, n, dtype=torch.float64), torch.ones(n, dtype=torch.float64))
    return MasterEquation(model, replace(record, report={"ordered": True}))


def _window(window: tuple[float, float] | None, default: tuple[float, float]) -> tuple[float, float]:
    if window is None:
        return default
    if not isinstance(window, (tuple, list)) or len(window) != 2:
        raise checks.FieldTypeError(f"window must be two times, got {checks.shown(window)}")
    begin = checks.number("window", window[0], at_least=0)
    return begin, checks.number("window", window[1], above=begin)


@contextmanager
def _counter(progress: bool, total: int | None, unit: str) -> Iterator[Callable[[int], Any] | None]:
    """What a fit calls as it goes on: a bar's update on a terminal, or None."""
    if not progress:
        yield None
        return
    with tqdm(total=total, unit=unit, disable=None, leave=False) as bar:
        yield bar.update
