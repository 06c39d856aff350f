"""Error of every reduced model on fresh chains, against the cost of its calibration and of its predictions, by number of bands."""

from __future__ import annotations

import statistics
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import calibration_methods
import harness
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import plots

SEARCHES = ("nonlinear", "adam")
SEARCHED = ("paper", "basis_matrix", "swing_in")
"""Models that these are shown with."""
PREDICTED_TIMES = 500


@dataclass(frozen=True)
class Config(Ensemble):
    n_particles: int = 512
    """particles per chain: up to 128 bands of two tones"""
    step: float = 0.5
    """time step of the output"""
    realizations: int = 40
    """chains in the ensemble, and in the fresh one"""
    strength: float = 0.3
    """disorder xi"""
    fresh_seed: int = 1
    """seed of the chains that no method has seen"""
    bands: tuple[int, ...] = (4, 8, 16, 32, 64, 128)
    """numbers of bands B"""
    largest_search: int = 32
    """bands beyond which 'nonlinear' and 'adam' are left out"""
    adam_steps: int = 200
    """at most"""
    horizon: float = 1000.0
    """late time at which the total energy is looked at"""
    repeats: int = 7
    """timed predictions after a first"""


SMOKE = Config(n_particles=32, realizations=4, stop=5.0, bands=(4,), largest_search=4, adam_steps=2, repeats=1)


def candidates(config: Config, n_bands: int) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """What :mod:`calibration_methods` compares, without error bars, and the searches only where they take seconds."""
    for label, method, model, settings in calibration_methods.candidates(replace(config, n_bands=n_bands)):  # type: ignore[arg-type]
        if method not in SEARCHES or (n_bands <= config.largest_search and model in SEARCHED):
            yield label, method, model, settings | {"bootstrap": 0}


def measure(config: Config, device: str) -> xarray.Dataset:
    entries: list[dict[str, Any]] = []
    predictions: list[dict[str, Any]] = []
    noise, ensembles = [], []
    tc.band_transfer(
        replace(config, n_bands=config.bands[0], realizations=2).scene(config.strength), device=device
    )  # compiles
    for n_bands in config.bands:
        scene = replace(config, n_bands=n_bands).scene(config.strength)
        began = time.process_time()
        own = tc.band_transfer(scene, device=device)
        ensembles.append(time.process_time() - began)
        fresh = tc.band_transfer(replace(scene, seed=config.fresh_seed), device=device)
        noise.append(float(tc.total_variation(own.mean, fresh.mean)[:, own.times > 0].mean()))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if not entries:  # the first call pays for loading libraries
                tc.calibrate(own, "adam", "paper", steps=2)
            for candidate in candidates(config, n_bands):
                judged = calibration_methods._judge(config, candidate, own, fresh, ensembles[-1])  # type: ignore[arg-type]
                entries.append({"bands": n_bands} | judged)
        models = dict.fromkeys(entry["model"] for entry in entries if entry["bands"] == n_bands)
        predictions += [_prediction(config, own, model) | {"bands": n_bands} for model in models]
    data = {name: ("fit", [entry[name] for entry in entries]) for name in entries[0]}
    data |= {f"prediction_{name}": ("prediction", [p[name] for p in predictions]) for name in predictions[0]}
    data |= {"noise": ("n_bands", noise), "ensemble_seconds": ("n_bands", ensembles)}
    return xarray.Dataset(data, {"n_bands": list(config.bands)}, {"threads": torch.get_num_threads()})


def _prediction(config: Config, own: tc.BandTransfer, model: str) -> dict[str, Any]:
    """Seconds of a prediction from one start at 500 times, and its products of matrices in multiplications."""
    linear = {"method": "linear"} if "linear" in [fit.name for fit in tc.MODELS[model].fits] else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        master = tc.calibrate(own, model=model, bootstrap=0, **linear)
        start = torch.eye(own.n_bands, dtype=torch.float64)[0]
        times = torch.linspace(0, config.stop, PREDICTED_TIMES, dtype=torch.float64)
        samples = []
        for i in range(config.repeats + 1):
            asked = times + 1e-6 * i  # what was asked for before may be kept
            began = time.process_time()
            with torch.no_grad():
                master.solve(start, asked)
            samples.append(time.process_time() - began)
    states = master.model.embedding().generator.shape[0]
    return {"model": model, "seconds": statistics.median(samples[1:]), "states": states}


def _looks(data: xarray.Dataset) -> dict[str, dict[str, Any]]:
    """Color and dashes of every model."""
    colors, dashes = (*plots.COLORS, "0.6"), (*plots.DASHES, "-")
    return {
        model: {"color": colors[i % 8], "linestyle": dashes[i % 8]}
        for i, model in enumerate(dict.fromkeys(data.model.values))
    }


def _markers(data: xarray.Dataset) -> dict[str, str]:
    return dict(zip(dict.fromkeys(data.method.values), "os^vDP*Xhd<>p8H", strict=False))


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 3, width=4.4, height=6.6)
    _errors(axes[0, 0], data)
    _costs(axes[0, 1], data)
    _predictions(axes[0, 2], data)
    handles = [axes[0, 0].plot([], [], label=model, **look)[0] for model, look in _looks(data).items()]
    handles += [
        axes[0, 0].plot([], [], m, ls="", color="0.3", mfc="none", label=f"fit: {name}")[0]
        for name, m in _markers(data).items()
    ]
    handles += [
        axes[0, 0].plot([], [], "k:", lw=2, label="two ensembles of chains")[0],
        axes[0, 0].plot([], [], color="0.6", ls="--", lw=2, label="seconds of the ensemble")[0],
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5)
    figure.suptitle(
        f"$\\xi$ = {config.strength:g}, {config.realizations} chains of {config.n_particles}, 0 < $t$ ≤ {config.stop:g}"
    )
    return figure


def _errors(ax: Axes, data: xarray.Dataset) -> None:
    looks, markers = _looks(data), _markers(data)
    for method in markers:
        for model in looks:
            curve = data.isel(fit=(data.method.values == method) & (data.model.values == model))
            if curve.sizes["fit"]:
                ax.plot(
                    curve.bands,
                    curve.fresh,
                    marker=markers[method],
                    markersize=4,
                    linewidth=0.9,
                    mfc="none",
                    **looks[model],
                )
    ax.plot(data.n_bands, data.noise, "k:", lw=2)
    ax.set(
        xscale="log", yscale="log", xlabel="bands $B$", ylabel="total variation", title="(a) error, from fresh chains"
    )
    ax.set_xticks(data.n_bands.values, [f"{b}" for b in data.n_bands.values], minor=False)
    ax.minorticks_off()


def _costs(ax: Axes, data: xarray.Dataset) -> None:
    looks, markers = _looks(data), _markers(data)
    shown = 32 if 32 in data.n_bands.values else int(data.n_bands[-1])
    part = data.isel(fit=data.bands.values == shown)
    for i in range(part.sizes["fit"]):
        one = part.isel(fit=i)
        ax.errorbar(
            one.seconds, one.fresh, yerr=one.fresh_stderr, color=looks[str(one.model.values)]["color"], lw=0.8,
            marker=markers[str(one.method.values)], markersize=5, mfc="none",
        )  # fmt: skip
    where = list(data.n_bands.values).index(shown)
    ax.axhline(float(data.noise[where]), color="k", linestyle=":", lw=2)
    ax.axvline(float(data.ensemble_seconds[where]), color="0.6", linestyle="--", lw=2)
    ax.set(xscale="log", yscale="log", xlabel="processor seconds", ylabel="total variation",
           title=f"(b) calibration, {shown} bands")  # fmt: skip
    ax.xaxis.set_minor_formatter("")


def _predictions(ax: Axes, data: xarray.Dataset) -> None:
    for model, look in _looks(data).items():
        curve = data.isel(prediction=data.prediction_model.values == model)
        ax.plot(curve.prediction_bands, curve.prediction_seconds, marker=".", **look)
    ax.plot(data.n_bands, data.ensemble_seconds, "--", color="0.6", lw=2)
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="bands $B$",
        ylabel=f"processor seconds, {PREDICTED_TIMES} times",
        title="(c) prediction, one start",
    )
    ax.set_xticks(data.n_bands.values, [f"{b}" for b in data.n_bands.values], minor=False)
    ax.minorticks_off()


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, n_bands in enumerate(data.n_bands.values):
        part = data.isel(fit=data.bands.values == n_bands)
        predictions = data.isel(prediction=data.prediction_bands.values == n_bands)
        for j in range(part.sizes["fit"]):
            one = part.isel(fit=j)
            seconds = float(
                predictions.prediction_seconds.values[list(predictions.prediction_model.values).index(one.model.values)]
            )
            note = f"calibration {float(one.seconds):.2g} s, prediction {seconds:.1e} s, {int(one.parameters)} numbers"
            rows.append(
                Row(
                    f"B = {n_bands}, {one.method.values}: {one.model.values}",
                    float(one.fresh),
                    float(one.fresh_stderr),
                    note=note,
                )
            )
        rows.append(
            Row(
                f"B = {n_bands}, two ensembles",
                float(data.noise[i]),
                note=f"ensemble {float(data.ensemble_seconds[i]):.2g} s",
            )
        )
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    lines = [
        f"measured: total variation from {config.realizations} fresh chains, mean over sources and 0 < t <= {config.stop:g}; "
        f"{data.threads} threads.",
        f"'nonlinear' and 'adam' (at most {config.adam_steps} steps) up to B = {config.largest_search}. Prediction: one start, "
        f"{PREDICTED_TIMES} times, median of {config.repeats} after a first.",
    ]
    for i, n_bands in enumerate(data.n_bands.values):
        part = data.isel(fit=data.bands.values == n_bands)
        best = part.isel(fit=int(part.fresh.values.argmin()))
        lines.append(
            f"B = {n_bands}: nearest {best.method.values}, {best.model.values}, {float(best.fresh):.4f}, "
            f"{float(best.fresh) / float(data.noise[i]):.1f} times the distance of two ensembles"
        )
    return "\n".join(lines)


SCRIPT = harness.Script("chart_models", Config(), SMOKE, measure, draw, compare, explain, pieces="bands")


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
