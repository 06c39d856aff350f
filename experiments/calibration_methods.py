"""Every way to calibrate a master equation, side by side: error on its own chains and on fresh ones, against cost."""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import dataclass, replace
from typing import Any

import gradient_cases
import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.master.adam import CONSTRAINTS
from torchchain.master.fits import FitWarning
from torchchain.master.ladder import fitted_by, methods


@dataclass(frozen=True)
class Config(Ensemble):
    strength: float = 0.3
    """disorder xi"""
    fresh_seed: int = 1
    """seed of the chains that no method has seen"""
    horizon: float = 1000.0
    """late time at which the total energy is looked at"""
    adam_steps: int = 2000
    """at most"""


SMOKE = Config(n_particles=32, n_bands=4, realizations=4, stop=5.0, adam_steps=2)


def candidates(config: Config) -> list[tuple[str, str, str, dict[str, Any]]]:
    """Label, method, model and settings of everything that the library can fit to such chains."""
    found: list[tuple[str, str, str, dict[str, Any]]] = []
    scene = config.scene(config.strength)
    for method in methods():
        models = [record.name for record in fitted_by(method) if record.describes(scene)]
        if method == "adam":
            found += [(f"adam, {c}", method, model, {"constraint": c, "steps": config.adam_steps})
                      for model in models for c in CONSTRAINTS]  # fmt: skip
        else:
            found += [(method, method, model, {}) for model in models]
    return found


def measure(config: Config, device: str) -> xarray.Dataset:
    began = time.process_time()
    own = tc.band_transfer(config.scene(config.strength), device=device)
    ensemble_seconds = time.process_time() - began
    fresh = tc.band_transfer(replace(config, seed=config.fresh_seed).scene(config.strength), device=device)
    later = own.times > 0
    tc.calibrate(own, "analytic", "paper")  # the first call pays for loading libraries
    entries = [_judge(config, candidate, own, fresh, ensemble_seconds) for candidate in candidates(config)]
    noise = float(tc.total_variation(own.mean, fresh.mean)[:, later].mean())
    data = xarray.Dataset({name: ("fit", np.array([entry[name] for entry in entries])) for name in entries[0]})
    cases = gradient_cases.found(config, own, fresh, config.adam_steps < 100)
    for name in ("case", "tool", "seconds", "error"):
        data[f"gradient_{name}"] = "gradient_fit", np.array([getattr(case, name) for case in cases])
    return data.assign_attrs(noise=noise, ensemble_seconds=ensemble_seconds)


def _judge(
    config: Config, candidate: tuple[str, str, str, dict[str, Any]], own: tc.BandTransfer, fresh: tc.BandTransfer,
    ensemble_seconds: float,
) -> dict[str, Any]:  # fmt: skip
    label, method, model, settings = candidate
    began = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FitWarning)
        master = tc.calibrate(own, method, model, **settings)
    seconds = time.process_time() - began
    later = own.times > 0
    predicted = master.model.transfer(own.times).detach()
    late = master.model.transfer(torch.tensor([config.horizon], dtype=torch.float64)).detach().sum(-1) - 1

    def distance(mean: torch.Tensor) -> torch.Tensor:
        return tc.total_variation(predicted, mean)[:, later].mean()

    value, error = harness.jackknife(fresh.block_mean, fresh.block_counts, distance)
    rated = isinstance(master.model, tc.RateModel)  # others have no Q that they predict with
    return {
        "method": label,
        "model": model,
        "own": float(distance(own.mean)),
        "fresh": float(value),
        "fresh_stderr": float(error),
        "leak": master.conservation_defect if rated else np.nan,
        "drift": float(late.flatten()[late.abs().argmax()]),
        "lowest_rate": master.most_negative_rate if rated else np.nan,
        "lowest_energy": float(predicted.min()),
        "parameters": master.n_parameters,
        "seconds": seconds,
        "cost": seconds / ensemble_seconds,
        "warning": str(caught[0].message) if caught else "",
    }


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 2, width=6.4, height=5.2)
    _errors(axes[0, 0], data)
    _costs(axes[0, 1], data)
    lower = axes[1, 0].get_gridspec()[1, :]
    for ax in axes[1]:
        ax.remove()
    _gradients(figure.add_subplot(lower), data)
    figure.suptitle(f"$\\xi$ = {config.strength:g}, {config.realizations} chains, 0 < $t$ ≤ {config.stop:g}")
    return figure


def _colors(data: xarray.Dataset) -> dict[str, str]:
    return {model: f"C{i}" for i, model in enumerate(dict.fromkeys(data.model.values))}


def _errors(ax: Axes, data: xarray.Dataset) -> None:
    colors = _colors(data)
    place = np.arange(data.sizes["fit"])[::-1]
    for y, own, fresh, error, model in zip(
        place, data.own.values, data.fresh.values, data.fresh_stderr.values, data.model.values, strict=True
    ):
        ax.plot(own, y, "o", color=colors[model], markerfacecolor="none")
        ax.errorbar(fresh, y, xerr=error, fmt="o", color=colors[model], markersize=4)
    ax.plot([], [], "o", color="0.4", markerfacecolor="none", label="chains it was fitted to")
    ax.plot([], [], "o", color="0.4", markersize=4, label="fresh chains")
    ax.axvline(data.noise, color="k", linestyle=":", label="two ensembles of chains")
    ax.set_yticks(place, _names(data), fontsize="small")
    ax.set(xlabel="total variation from the chains", xscale="log", title="(a) error")
    ax.grid(axis="y", alpha=0.3)
    ax.legend(fontsize="small", loc="lower right")


def _costs(ax: Axes, data: xarray.Dataset) -> None:
    colors = _colors(data)
    markers = dict(zip(dict.fromkeys(data.method.values), "os^vDP*Xhd<>p8H", strict=False))
    for cost, fresh, method, model in zip(
        data.cost.values, data.fresh.values, data.method.values, data.model.values, strict=True
    ):
        ax.plot(cost, fresh, markers[method], color=colors[model], markersize=7)
    ax.axhline(data.noise, color="k", linestyle=":")
    handles = [
        ax.plot([], [], marker, color="0.4", linestyle="none", label=name)[0] for name, marker in markers.items()
    ]
    handles += [ax.plot([], [], color=color, linewidth=5, label=name)[0] for name, color in colors.items()]
    ax.legend(handles=handles, fontsize="small", loc="center left", bbox_to_anchor=(1.02, 0.5))
    ax.set(xlabel="processor time of the fit / of the ensemble", ylabel="total variation from fresh chains",
           xscale="log", yscale="log", title="(b) error and cost")  # fmt: skip
    for label in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
        label("{x:g}")
    ax.xaxis.set_minor_formatter("")


def _gradients(ax: Axes, data: xarray.Dataset) -> None:
    """Every tool of every case: what it costs and how near it comes."""
    tools = dict(zip(dict.fromkeys(data.gradient_tool.values), "xo^sDP", strict=False)) | {"logistic regression": "*"}
    points = list(zip(*(data[f"gradient_{name}"].values for name in ("case", "tool", "seconds", "error")), strict=True))
    for label, case, tool in (
        ("linear", "constant rates", "linear least squares"), ("adam, exact", "constant rates", "Adam"),
        ("logistic", "odds, no rates", "logistic regression"),
    ):  # fmt: skip
        part = data.isel(fit=np.flatnonzero(data.method.values == label))
        best = part.isel(fit=int(part.fresh.argmin()))
        points.append((case, tool, float(best.seconds), float(best.fresh) / data.noise))
    cases = list(dict.fromkeys(point[0] for point in points))
    for case, tool, seconds, error in points:
        place, number = (max(seconds, 1e-3), error), cases.index(case)
        ax.plot(*place, tools[tool], color=f"C{number}", markersize=7)
        ax.annotate(f"{number + 1}", place, xytext=(5, 4), textcoords="offset points", fontsize="small")
    ax.axhline(1, color="k", linestyle=":")
    handles = [ax.plot([], [], color=f"C{i}", linewidth=5, label=f"{i + 1}: {case}")[0] for i, case in enumerate(cases)]
    handles += [
        ax.plot([], [], marker, color="0.4", linestyle="none", label=tool)[0] for tool, marker in tools.items()
    ]
    ax.legend(handles=handles, fontsize="small", loc="center left", bbox_to_anchor=(1.02, 0.5))
    ax.set(xlabel="processor seconds of the fit", ylabel="error / that of two ensembles", xscale="log", yscale="log", title="(c) gradients")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("{x:g}")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, name in enumerate(_names(data)):
        fit = data.isel(fit=i)
        note = (
            f"own chains {float(fit.own):.4f}, leak of Q {float(fit.leak):.0e}, "
            f"energy - 1 at t = {config.horizon:g}: {float(fit.drift):+.0e}, lowest rate {float(fit.lowest_rate):.0e}, "
            f"lowest energy {float(fit.lowest_energy):.0e}, cost {float(fit.cost):.0e}"
        )
        rows.append(Row(name, float(fit.fresh), float(fit.fresh_stderr), note=note))
    rows.append(Row("two ensembles of chains", float(data.noise)))
    for i in range(data.sizes["gradient_fit"]):
        fit = data.isel(gradient_fit=i)
        note = f"over that of two ensembles; {float(fit.gradient_seconds):.2g} s of processor time"
        rows.append(Row(f"{fit.gradient_case.item()}: {fit.gradient_tool.item()}", float(fit.gradient_error), note=note))
    return rows


def _names(data: xarray.Dataset) -> list[str]:
    return [f"{method}: {model}" for method, model in zip(data.method.values, data.model.values, strict=True)]


def explain(data: xarray.Dataset, config: Config) -> str:
    names = _names(data)
    best = int(data.fresh.values.argmin())
    growing = [name for name, drift in zip(names, data.drift.values, strict=True) if drift > 1]
    lines = [
        f"measured: total variation from {config.realizations} fresh chains, mean over sources and 0 < t <= {config.stop:g}; "
        "own: from the chains of the fit;\nenergy - 1: of the source that is furthest off; "
        f"cost: processor time over the {data.ensemble_seconds:.1f} s of the ensemble.",
        f"Nearest to fresh chains: {names[best]}, {float(data.fresh[best]):.4f} where two ensembles differ by {data.noise:.4f}.",
        "What stays behind matters more than how Q is fitted. Best of every model: "
        + ", ".join(f"{model} {float(part.min()):.4f}" for model, part in data.fresh.groupby(data.model))
        + f";\nwith Eq. 50 for Q: {_analytic(data)}.",
    ]
    lines += [
        "Where gradients are the right tool: rates that depend on amplitude, from bands of wavenumber at two times. Couplings show only in where trajectories end; without "
        "the modes of\nevery chain no equation is linear in them, and differences need a solution for each coupling. L-BFGS by the same gradients comes as near as Adam.",
        "Where they are not: with the modes of every chain known linear least squares takes a hundredth of the time; constant rates, and rates in time, need thousands of numbers and stay behind "
        "odds that\nlogistic regression fits.",
    ]
    if growing:
        lines.append(
            f"Unstable: {', '.join(growing)}. A row sum of Q above zero makes energy, and it grows exponentially."
        )
    lines += dict.fromkeys(
        f"{m}: {text}" for m, text in zip(data.method.values, data.warning.values, strict=True) if text
    )
    return "\n".join(lines)


def _analytic(data: xarray.Dataset) -> str:
    part = data.isel(fit=data.method.values == "analytic")
    return ", ".join(f"{m} {f:.4f}" for m, f in zip(part.model.values, part.fresh.values, strict=True))


SCRIPT = harness.Script("calibration_methods", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
