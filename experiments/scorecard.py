"""Every model of the ladder on fresh chains: error, error bars and cost, over disorder, length and number of bands."""

from __future__ import annotations

import statistics
import sys
import time
import warnings
from dataclasses import dataclass
from typing import Any

import error_bars
import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.master import PredictionWarning
from torchchain.master.fits import FitWarning
from torchchain.master.ladder import fitted_by
from torchchain.master.memory import ORDERS

TARGET = 0.012
"""Largest mean total variation wanted from disorder 0.25 up; below, 1.25 times that of two ensembles."""


@dataclass(frozen=True)
class Config:
    """Calibrate on one seed, score on another."""

    seed: int = 0
    """seed of the chains of the calibration"""
    fresh_seed: int = 1
    """seed of the chains that nothing was calibrated on"""
    realizations: int = 400
    """chains of a calibration"""
    fresh_realizations: int = 400
    """chains of a score"""
    strengths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.5)
    """disorders xi of the calibrations, which make one family"""
    unseen: tuple[float, ...] = (0.07, 0.25)
    """disorders that the family predicts without chains"""
    n_particles: int = 256
    """particles per chain"""
    n_bands: int = 32
    """wavenumber bands B"""
    others: tuple[str, ...] = ("384/24", "384/24/0.25")
    """more particles/bands, at the strength below, or particles/bands/strength"""
    other_strength: float = 0.3
    """disorder of these, and of the chart over parameters"""
    other_realizations: int = 400
    """chains of their scores"""
    stop: float = 500.0
    """last time"""
    mixtures: int = 64
    """random starts over several bands"""
    adam_steps: int = 300
    """at most"""

    def scene(self, strength: float, seed: int, realizations: int, n_particles: int, n_bands: int) -> tc.Scene:
        fine = np.concatenate(
            [np.arange(0, 5, 0.25), np.arange(5, 25, 0.5), np.arange(25, 50, 1), np.arange(50, 100, 2.5), np.arange(100, 1e4, 10)]
        )  # fmt: skip
        times = [*fine[fine < self.stop], self.stop]
        return tc.Scene(
            n_particles=n_particles, n_bands=n_bands, realizations=realizations, seed=seed, times=times,
            disorder=tc.Disorder(strength=strength),
        )  # fmt: skip


SMOKE = Config(
    realizations=4, fresh_realizations=4, strengths=(0.1, 0.3), unseen=(0.2,), n_particles=32, n_bands=4,
    others=("48/4",), other_realizations=2, stop=20.0, mixtures=2, adam_steps=2,
)  # fmt: skip


def rungs(config: Config) -> list[tuple[str, str | None, str | None, dict[str, Any]]]:
    """Label, method, model and settings of all that is scored; the last is the library's own choice."""
    found: list[tuple[str, str | None, str | None, dict[str, Any]]] = [("paper, Eq. 50", "analytic", "paper", {})]
    for model in (record.name for record in fitted_by("adam")):
        found.append((f"{model}, L", "linear", model, {}))
        if model == "basis_matrix":  # the others' Adam is in calibration_methods
            found.append((f"{model}, Adam", "adam", model, {"steps": config.adam_steps}))
    found += [
        (f"memory {single}+{pairs}", "projection", "memory", {"order": (single, pairs), "bootstrap": 0})
        for single, pairs in ORDERS[::2]
    ]
    found.append(("memory, certified", "projection", "memory", {"bootstrap": 0}))
    return [*found, ("chosen", None, None, {})]


def measure(config: Config, device: str) -> xarray.Dataset:
    torch.manual_seed(config.seed)  # of the mixtures alone
    weights = torch.rand(config.mixtures, 128, dtype=torch.float64) ** 8
    entries: list[dict[str, Any]] = []
    members, owns = [], []
    fresh: dict[float, tc.BandTransfer] = {}
    size = (config.n_particles, config.n_bands)
    for strength in config.strengths:
        own, seconds = _timed(
            lambda xi=strength: _ensemble(config, xi, config.seed, config.realizations, *size, device)
        )
        fresh[strength] = _ensemble(config, strength, config.fresh_seed, config.fresh_realizations, *size, device)
        for rung in rungs(config):
            master, fit = _calibrated(own, rung)
            entries.append(_score(rung[0], master, own, fresh[strength], weights, fit, seconds))
        members.append(master)
        owns.append(own)
    family = tc.calibrate_family(owns)
    for strength in config.unseen:
        own = _ensemble(config, strength, config.seed, config.realizations, *size, device)  # for its error alone
        other = _ensemble(config, strength, config.fresh_seed, config.fresh_realizations, *size, device)
        master, fit = _timed(lambda xi=strength: family.at(xi))
        entries.append(_score("family", master, own, other, weights, fit, np.nan))
    for text in config.others:
        n_particles, n_bands, strength = _chains(text, config)
        made = (strength, config.seed, config.realizations, n_particles, n_bands, device)
        own, seconds = _timed(lambda made=made: _ensemble(config, *made))
        other = _ensemble(
            config, strength, config.fresh_seed, config.other_realizations, n_particles, n_bands, device
        )
        for rung in rungs(config):
            master, fit = _calibrated(own, rung)
            entries.append(_score(rung[0], master, own, other, weights, fit, seconds))
        if n_bands == config.n_bands:
            near = members[int(np.argmin([abs(xi - strength) for xi in config.strengths]))]
            entries.append(_score(f"of N = {config.n_particles}", near, own, other, weights, np.nan, np.nan))
    data = xarray.Dataset({name: ("entry", np.array([entry[name] for entry in entries])) for name in entries[0]})
    left_out = family.leave_one_out(own.times[own.times > 0])
    return data.assign(left_out=(("member", "what"), np.array(left_out).reshape(-1, 2)))


def _chains(text: str, config: Config) -> tuple[int, int, float]:
    """Particles, bands and disorder of other chains."""
    n_particles, n_bands, *strength = text.split("/")
    return int(n_particles), int(n_bands), float(strength[0]) if strength else config.other_strength


def _timed(work: Any) -> tuple[Any, float]:
    begin = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begin


def _ensemble(
    config: Config, strength: float, seed: int, realizations: int, n_particles: int, n_bands: int, device: str
) -> tc.BandTransfer:
    return tc.band_transfer(config.scene(strength, seed, realizations, n_particles, n_bands), device=device)


def _calibrated(own: tc.BandTransfer, rung: tuple[str, str | None, str | None, dict[str, Any]]) -> tuple[Any, float]:
    _, method, model, settings = rung
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        return _timed(lambda: tc.calibrate(own, method, model, **settings))


def _score(
    label: str, master: tc.MasterEquation, own: tc.BandTransfer, fresh: tc.BandTransfer, weights: torch.Tensor,
    seconds: float, ensemble_seconds: float,
) -> dict[str, Any]:  # fmt: skip
    """One line of the card: how far the predictions are from fresh chains, and what they cost."""
    times, eye = fresh.times, torch.eye(fresh.n_bands, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PredictionWarning)
        predicted = master.solve(eye, times).detach()
        # energies are sums over sources of shares of what each began with: no start is below the lowest of the sources
        far = master.solve(eye, torch.logspace(-3, 6, 200, dtype=torch.float64)).detach()
        one = statistics.median(_timed(lambda: master.solve(eye[:1], times))[1] for _ in range(9))
    later = times > 0
    share = torch.diff(times, prepend=times[:1])[later]  # of the time axis
    share = share / share.sum()
    early = times[later] <= 25
    first, both = later & (times <= 5), ((own.stderr.square() + fresh.stderr.square()) / 2).sqrt()

    def mean(distance: torch.Tensor) -> float:
        return float((distance[:, later] * share).sum(-1).mean())

    distance = tc.total_variation(predicted, fresh.mean)
    start = weights[:, : fresh.n_bands] / weights[:, : fresh.n_bands].sum(-1, keepdim=True)
    mixed = torch.einsum("ms,str->mtr", start, predicted - fresh.mean)
    covered, covered_mixed = np.nan, np.nan
    if master.uncertainty is not None:
        error = master.standard_error(eye, times).square() + fresh.stderr.square()
        covered = float(((predicted - fresh.mean).square() < error)[:, later].double().mean())
        error = master.standard_error(start, times).square() + error_bars.of_mixtures(fresh, start)[1].square()
        covered_mixed = float((mixed.square() < error)[:, later].double().mean())
    return {
        "label": label,
        "model": master.calibration.model,
        "order": str(list(getattr(master.calibration.report.fit, "order", ())) or ""),
        "strength": fresh.scene.disorder.strength,
        "n_particles": fresh.scene.n_particles,
        "n_bands": fresh.n_bands,
        "distance": mean(distance),
        "worst": float(distance.max()),
        "early": float(distance[:, later][:, early].mean()),
        "late": float(distance[:, later][:, ~early].mean()) if bool((~early).any()) else np.nan,
        "mixtures": mean(mixed.abs().sum(-1) / 2),
        "noise": mean(tc.statistical_distance(own.stderr)),
        "noise_early": float(tc.statistical_distance(own.stderr)[:, later][:, early].mean()),
        "defect": float((predicted.sum(-1) - 1).abs().max()),
        "lowest": min(float(predicted.min()), float(far.min())),
        "worst_first": float((distance.mean(0) / tc.statistical_distance(both).mean(0))[first].max()),
        "parameters": master.n_parameters,
        "seconds": seconds,
        "ensemble_seconds": ensemble_seconds,
        "prediction_seconds": one,
        "covered": covered,
        "covered_mixed": covered_mixed,
    }


def _main(data: xarray.Dataset, config: Config) -> xarray.Dataset:
    """The lines of the chains of most scores."""
    return data.isel(entry=(data.n_particles == config.n_particles).values & (data.n_bands == config.n_bands).values)


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 3, width=4.8, height=6.4)
    main = _main(data, config)
    _ladder(axes[0, 0], main.isel(entry=(main.strength == config.other_strength).values), config)
    _strengths(axes[0, 1], main)
    _coverage(axes[0, 2], main)
    handles = {label: handle for ax in axes[0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    figure.suptitle(
        f"calibrated on {config.realizations} chains, scored on {config.fresh_realizations} others: "
        f"N = {config.n_particles}, {config.n_bands} bands, 0 < $t$ ≤ {config.stop:g}",
        fontsize="medium",
    )
    return figure


def _ladder(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    for i, model in enumerate(dict.fromkeys(data.model.values)):
        kept = ~np.isin(data.label.values, ["chosen", "memory, certified"])
        part = data.isel(entry=(data.model == model).values & kept).sortby("parameters")
        if part.sizes["entry"]:
            line = "-" if model == "memory" else ""
            ax.plot(part.parameters, part.distance, "os^vDPXh"[i % 8], ls=line, color=f"C{i}", label=model)
    chosen = data.isel(entry=(data.label == "chosen").values)
    ax.plot(
        chosen.parameters, chosen.distance, "k*", markersize=10, markerfacecolor="none", label="chosen by calibrate"
    )
    ax.axhline(float(data.noise[0]), color="k", linestyle=":", label=f"two ensembles of {config.realizations}")
    ax.set(xscale="log", yscale="log", xlabel="fitted numbers", ylabel="total variation from fresh chains",
           title=f"(a) disorder {config.other_strength:g}")  # fmt: skip
    _plain_ticks(ax)


def _strengths(ax: Axes, data: xarray.Dataset) -> None:
    for label, style in (
        ("paper, Eq. 50", "C0s-"),
        ("paper, L", "C1v-"),
        ("basis_matrix, Adam", "C4^-"),
        ("chosen", "ko-"),
    ):
        part = data.isel(entry=(data.label == label).values)
        ax.plot(part.strength, part.distance, style, label=label, markersize=5)
    part = data.isel(entry=(data.label == "family").values)
    ax.plot(part.strength, part.distance, "C5*", markersize=9, mec="k", label="family, unseen disorder")
    part = data.isel(entry=np.isin(data.label.values, ["chosen", "family"])).sortby("strength")
    ax.plot(part.strength, part.noise, "k:", label="two ensembles")
    ax.set(
        xscale="log",
        yscale="log",
        xlabel=r"disorder $\xi$",
        ylabel="total variation from fresh chains",
        title="(b) over disorder",
    )
    _plain_ticks(ax)
    ax.set_xticks([0.05, 0.1, 0.2, 0.3, 0.5])


def _coverage(ax: Axes, data: xarray.Dataset) -> None:
    part = data.isel(entry=np.isin(data.label.values, ["chosen", "family"])).sortby("strength")
    ax.axhspan(0.60, 0.76, color="0.9", label="wanted")
    ax.axhline(0.683, color="k", linestyle=":")
    ax.plot(part.strength, part.covered, "ko-", label="one band at the start")
    ax.plot(part.strength, part.covered_mixed, "C3s--", label="mixtures of bands")
    ax.set(xscale="log", ylim=(0, 1), xlabel=r"disorder $\xi$", ylabel="energies within one error",
           title="(c) error bars")  # fmt: skip
    ax.set_xticks([0.05, 0.1, 0.2, 0.3, 0.5])
    _plain_ticks(ax)


def _plain_ticks(ax: Axes) -> None:
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i in range(data.sizes["entry"]):
        line = data.isel(entry=i)
        note = (
            f"/ statistical {float(line.distance / line.noise):.2f}, at each 0 < t <= 5 at most {float(line.worst_first):.2f}, worst {float(line.worst):.4f}, early {float(line.early):.4f}, "
            f"late {float(line.late):.4f}, mixtures {float(line.mixtures):.4f}, defect {float(line.defect):.0e}, "
            f"lowest {float(line.lowest):.0e}, {int(line.parameters)} parameters, fit {float(line.seconds):.2g} s, "
            f"within error {float(line.covered):.2f}, {float(line.covered_mixed):.2f}, "
            f"ensemble / prediction {float(line.ensemble_seconds / line.prediction_seconds):.2g}"
        )
        order = f" {line.order.item()}" if line.label.item() in ("chosen", "memory, certified") else ""
        name = (
            f"xi {float(line.strength):g}, N {int(line.n_particles)}, B {int(line.n_bands)}: {line.label.item()}{order}"
        )
        rows.append(Row(name, float(line.distance), note=note.replace("nan", "-")))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    main = _main(data, config)
    chosen = main.isel(entry=(main.label == "chosen").values)
    family = main.isel(entry=(main.label == "family").values)
    strong = chosen.isel(entry=(chosen.strength >= 0.25).values)
    weak = chosen.isel(entry=(chosen.strength < 0.25).values)
    lines = [
        "measured: total variation from fresh chains, mean over sources and, evenly, over time; statistical: expected between two "
        f"ensembles of {config.realizations}; early: t <= 25;\n"
        "at each 0 < t <= 5: largest ratio at a single time; lowest: of any start over the bands, up to t = 1e6; within error: share of "
        "energies within one standard error, of one-band starts and of mixtures.",
        f"Chosen by calibrate: from disorder 0.25 up at most {float(strong.distance.max()):.4f} (wanted {TARGET:g}); below, at most "
        + (f"{float((weak.distance / weak.noise).max()):.2f}" if weak.sizes["entry"] else "-")
        + " times the statistical error (wanted 1.25).",
        f"Family at unseen disorder: {', '.join(f'{float(r):.2f}' for r in family.distance / family.noise)} times (wanted 1.5). "
        "Each member left out and predicted by its neighbors, distance from itself: "
        + ", ".join(f"{xi:g}: {tv:.4f}" for xi, tv in data.left_out.values) + ".",
        f"Largest defect of conservation of the chosen {float(chosen.defect.max()):.0e}, lowest energy {float(chosen.lowest.min()):.1e}; "
        f"calibration at most {float(chosen.seconds.max()):.1f} s; prediction {float((chosen.ensemble_seconds / chosen.prediction_seconds).min()):.3g} "
        "times faster than the ensemble, at least.",
    ]  # fmt: skip
    return "\n".join(lines)


SCRIPT = harness.Script("scorecard", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
