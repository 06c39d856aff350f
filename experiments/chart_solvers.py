"""Work against precision of every solver of the master equation, at mild rates and at stiff ones."""

from __future__ import annotations

import itertools
import statistics
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

import harness
import numpy as np
import torch
import torchdiffeq
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import checks
from torchchain.master import PredictionWarning, solving
from torchchain.odes import INTEGRATORS
from torchchain.threads import single_blas_thread

MILD, STIFF = "mild rates", "stiff rates"
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
SHARES = (1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01)
"""of the largest stable step"""
SCIPY = ("LSODA", "DOP853", "BDF", "Radau")


@dataclass(frozen=True)
class Config(Ensemble):
    realizations: int = 10
    """chains that the rates are fitted to"""
    strength: float = 0.3
    """disorder xi"""
    faster: float = 1e4
    """factor on the rates of the upper half of the bands, for the stiff ones"""
    until: float = 50.0
    """last time, mild rates"""
    stiff_until: float = 0.5
    """last time, stiff rates"""
    outputs: int = 51
    """output times"""
    repeats: int = 3
    """timed runs after a first"""
    longest: float = 0.1
    """seconds of a run after which no finer one of the solver follows"""


SMOKE = Config(
    n_particles=32, n_bands=4, realizations=2, stop=5.0, faster=100.0, until=5.0, stiff_until=0.1, outputs=3, repeats=1, longest=0.002
)  # fmt: skip


def ways(reach: float) -> Iterator[tuple[str, str, tuple[dict[str, Any], ...]]]:
    """Solver, label and options, coarse to fine; ``reach``: 1 over the fastest rate."""
    for name, solver in tc.SOLVERS.items():
        if "solver" in solver.options:
            for kind in SCIPY:
                yield name, f"scipy {kind}", tuple({"rtol": r, "atol": r / 100, "solver": kind} for r in TOLERANCES)
        elif "step" in solver.options:
            limit = solving.STABILITY[name] * reach
            yield name, name, tuple({"step": share * limit} for share in SHARES)
        elif "rtol" in solver.options:
            yield name, name, tuple({"rtol": r, "atol": r / 100} for r in TOLERANCES)
        else:
            yield name, name, ({},)


def extended_exponential(matrix: np.ndarray, degree: int, extra: int) -> np.ndarray:
    """exp(matrix) in extended precision: its Taylor series at a norm of 2^-extra, squared."""
    squarings = max(0, int(np.ceil(np.log2(np.abs(matrix).sum(1).max()))) + extra)
    small = matrix.astype(np.longdouble) / np.longdouble(2) ** squarings
    term = total = np.eye(len(matrix), dtype=np.longdouble)
    for k in range(1, degree + 1):
        term = term @ small / k
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total


def reference(rates: torch.Tensor, basis: torch.Tensor, times: torch.Tensor, degree: int, extra: int) -> np.ndarray:
    """T(t) = Pi + (I - Pi) exp(Q t) in extended precision, [source, time, receiver]."""
    step = extended_exponential(rates.numpy() * float(times[1]), degree, extra)
    resting = basis.numpy().astype(np.longdouble)
    moving = [np.eye(len(resting), dtype=np.longdouble) - resting]
    for _ in times[1:]:
        moving.append(moving[-1] @ step)
    return np.stack([resting + part for part in moving], axis=1)


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', whose time this experiment measures", repr(device))
    with single_blas_thread():
        return _measure(config)


def _measure(config: Config) -> xarray.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = tc.calibrate(tc.band_transfer(config.scene(config.strength)), "linear", "basis_matrix")
    mild = fitted.rates.detach()
    factors = torch.ones(config.n_bands, 1, dtype=torch.float64)
    factors[config.n_bands // 2 :] = config.faster
    entries: list[dict[str, Any]] = []
    own = []
    for case, rates, until in ((MILD, mild, config.until), (STIFF, factors * mild, config.stiff_until)):
        times = torch.linspace(0, until, config.outputs, dtype=torch.float64)
        exact = reference(rates, fitted.basis, times, 30, 4)
        own.append(float(np.abs(exact - reference(rates, fitted.basis, times, 24, 8)).max()))
        master = tc.MasterEquation(tc.RateModel(rates, fitted.basis), fitted.calibration)
        fastest = float(torch.linalg.eigvals(rates).abs().max())
        for name, label, options in ways(1 / fastest):
            entries += _curve(config, master, times, exact, case, name, label, options)
    data = {key: ("run", [entry[key] for entry in entries]) for key in entries[0]}
    data["reference_error"] = ("case", own)
    return xarray.Dataset(data, {"case": [MILD, STIFF]})


def _curve(
    config: Config, master: tc.MasterEquation, times: torch.Tensor, exact: np.ndarray, case: str, name: str, label: str,
    every: tuple[dict[str, Any], ...],
) -> list[dict[str, Any]]:  # fmt: skip
    """A solver from coarse to fine, until a run takes too long."""
    start = torch.eye(master.n_bands, dtype=torch.float64)
    entries = []
    original = torchdiffeq.odeint
    for options in every:
        calls = itertools.count()

        def counting(slope: Any, *arguments: Any, calls: Any = calls, **settings: Any) -> Any:
            def counted(t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
                next(calls)
                return slope(t, y)

            return original(counted, *arguments, **settings)

        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore", PredictionWarning)
            warnings.filterwarnings("ignore", message=".*have no effect for a chosen solver.*")
            warnings.simplefilter("ignore", RuntimeWarning)  # SciPy's BDF at its first step
            try:
                began = time.process_time()
                with mock.patch.object(torchdiffeq, "odeint", counting):
                    found = master.solve(start, times, name, **options)
                first = time.process_time() - began
            except (tc.master.IntegrationError, checks.FieldError):
                continue
            samples = [first] if first > 2 * config.longest else []
            for _ in range(0 if samples else config.repeats if first < config.longest else 1):
                began = time.process_time()
                master.solve(start, times, name, **options)
                samples.append(time.process_time() - began)
        entries.append(
            {
                "rates": case,
                "solver": label,
                "option": ", ".join(f"{k}={v:.3g}" for k, v in options.items() if k in ("step", "rtol")),
                "error": float(np.abs(found.numpy() - exact).max()),
                "seconds": statistics.median(samples),
                "evaluations": float(next(calls)) or np.nan,
            }
        )
        if min(first, *samples) > config.longest:
            break
    return entries


def _look(label: str) -> dict[str, Any]:
    labels = [
        "expm",
        *(name for name in tc.SOLVERS if name not in ("expm", "scipy_solver")),
        *(f"scipy {k}" for k in SCIPY),
    ]
    i = labels.index(label)
    adaptive = label in INTEGRATORS and INTEGRATORS[label].adaptive and "scipy" not in label
    line = "-" if adaptive else "--" if label in solving.STABILITY else ":"
    size = {"markersize": 9, "zorder": 5} if label == "expm" else {"markersize": 4}
    return {"color": f"C{i % 7}", "marker": "*osv^D<>pPXdh8"[i % 14], "linestyle": line, "linewidth": 1, **size}


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 2, width=5.2, height=4.0)
    for row, case in enumerate((MILD, STIFF)):
        part = data.isel(run=data.rates.values == case)
        until = config.until if case == MILD else config.stiff_until
        title = f"{case}, $t$ = {until:g}" + (f", upper bands {config.faster:g} times" if case == STIFF else "")
        for ax, cost in zip(axes[row], ("seconds", "evaluations"), strict=True):
            _panel(ax, part, cost, title, float(data.reference_error[row]))
    for ax in axes.flat:
        ax.xaxis.set_minor_formatter("")
    axes[1, 0].set_xlabel("processor seconds, median")
    axes[1, 1].set_xlabel(r"evaluations of $e\,Q$ (all sources together)")
    for ax in axes[:, 0]:
        ax.set_ylabel("largest error of any energy")
    labels = list(dict.fromkeys(data.solver.values))
    handles = [axes[0, 0].plot([], [], label=label, **_look(label))[0] for label in labels]
    handles.append(axes[0, 0].plot([], [], "k--", lw=0.8, label="the reference's own error")[0])
    figure.legend(handles=handles, loc="outside lower center", ncols=6)
    return figure


def _panel(ax: Axes, part: xarray.Dataset, cost: str, title: str, floor: float) -> None:
    for label in dict.fromkeys(part.solver.values):
        curve = part.isel(run=part.solver.values == label)
        good = np.isfinite(curve[cost].values)
        if good.any():
            ax.plot(curve[cost].values[good], np.maximum(curve.error.values[good], 1e-17), **_look(label))
    ax.set(xscale="log", yscale="log", title=title, ylim=(1e-17, 3))
    ax.title.set_fontsize("medium")
    ax.axhline(max(floor, 1.2e-17), color="k", linestyle="--", linewidth=0.8)


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, case in enumerate((MILD, STIFF)):
        part = data.isel(run=data.rates.values == case)
        rows.append(
            Row(
                f"{case}: reference's error",
                float(data.reference_error[i]),
                note="two series, of different norm and degree",
            )
        )
        exact = part.isel(run=part.solver.values == "expm")
        rows.append(Row(f"{case}: error of expm", float(exact.error[0]), note=f"{float(exact.seconds[0]):.2g} s"))
        peers = part.isel(run=np.isfinite(part.evaluations.values))
        for accuracy in (1e-3, 1e-6, 1e-9):
            found = harness.fastest(peers, accuracy)
            if found is not None:
                ratio = float(found.seconds / exact.seconds[0])
                note = f"{found.solver.values} {found.option.values}, {int(found.evaluations)} evaluations, {ratio:.3g} times expm"
                rows.append(
                    Row(f"{case}: seconds for error {accuracy:.0e} by a solver", float(found.seconds), note=note)
                )
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"measured: {config.n_bands} sources at {config.outputs} times, rates by the linear procedure on {config.realizations} "
        f"chains; median of {config.repeats} runs after a first,\nprocessor time of one thread. A curve ends after its first run of "
        f"more than {config.longest:g} s. Reference: scaling and squaring in extended precision (64 bits);\nits error is how far "
        "two such series are apart. Explicit methods take 1 / |lambda| steps where rates are stiff, whatever the accuracy."
    )  # fmt: skip


SCRIPT = harness.Script("chart_solvers", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
