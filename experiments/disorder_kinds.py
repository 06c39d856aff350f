"""Do shape and kind of the disorder matter? Masses of five distributions, stiffnesses, and both (claim of Section 2.7)."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import harness
import numpy as np
import torch
import xarray
from fig02 import Kick, each_realization, mean_and_error
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain import plots
from torchchain.chain.disorder import KINDS
from torchchain.energy.bands import band_of
from torchchain.ensemble import run as ensemble
from torchchain.ensemble.scene_file import regular_times

CASES = (*KINDS, "normal again", "stiffness", "both")  # the second normal ensemble shows what chance does
NONE = tc.Disorder(strength=0.0)


@dataclass(frozen=True)
class Config(Kick):
    strengths: tuple[float, ...] = (0.1, 0.3, 0.5)
    """disorders xi; "both" has xi / sqrt(2) in the masses and as much in the stiffnesses"""
    stop: float = 1024.0
    """last time of R and r^2 after the kick beside the wall"""
    early: float = 100.0
    """R and r^2 are compared from here"""
    ring_particles: int = 256
    """particles of the rings with a standing wave"""
    ring_realizations: int = 200
    """and how many rings"""
    n_bands: int = 32
    """wavenumber bands B"""
    tone: int = 90
    """of the standing wave, in band 23"""
    ring_stop: float = 50.0
    """last time of the band energies"""
    ring_early: float = 5.0
    """they are compared from here, behind the swing-in"""


SMOKE = Config(
    n_particles=64, realizations=6, strengths=(0.3,), stop=60.0, early=20.0, ring_particles=64, ring_realizations=6,
    n_bands=8, tone=22, ring_early=1.0, ring_stop=5.0,
)  # fmt: skip


def disorders(case: str, xi: float) -> dict[str, tc.Disorder]:
    """The scene's fields of a case."""
    if case == "stiffness":
        return {"disorder": NONE, "stiffness_disorder": tc.Disorder("normal", xi)}
    if case == "both":
        half = tc.Disorder("normal", xi / math.sqrt(2))
        return {"disorder": half, "stiffness_disorder": half}
    return {"disorder": tc.Disorder(case.split()[0], xi)}


def measure(config: Config, device: str) -> xarray.Dataset:
    times, ring_times = regular_times(0.0, config.stop, 1.0), regular_times(0.0, config.ring_stop, 0.25)
    band = band_of(config.tone, config.ring_particles, config.n_bands)
    columns: dict[str, list[Any]] = {}
    for xi in config.strengths:
        for number, case in enumerate(CASES):
            fields = {**disorders(case, xi), "seed": config.seed + number}  # independent ensembles
            kick = config.scene(xi, times, ("center", "width"), **fields)
            ring = config.scene(
                xi, ring_times, ("band_energy", "long_time_band_energy"), n_particles=config.ring_particles, boundary="periodic",
                excitation=tc.StandingWave(tones=(config.tone,)), realizations=config.ring_realizations, n_bands=config.n_bands,
                **fields,
            )  # fmt: skip
            rings = {name: values[:, 0] for name, values in each_realization_of_ring(ring, device).items()}
            found = each_realization(kick, config.method, device) | {
                "share": rings["band_energy"][..., band - 1], "long_time": rings["long_time_band_energy"]
            }  # fmt: skip
            for name, values in found.items():
                mean, error = mean_and_error(values)
                columns.setdefault(name, []).append(mean)
                columns.setdefault(f"{name}_stderr", []).append(error)
            for name, value in moments(kick).items():
                columns.setdefault(name, []).append(value)
    axes = {"center": ("time",), "width": ("time",), "share": ("ring_time",), "long_time": ("band",)}
    shape = (len(config.strengths), len(CASES))
    return xarray.Dataset(
        {name: (("strength", "case", *axes.get(name.removesuffix("_stderr"), ())), np.reshape(column, (*shape, *np.shape(column[0]))))
         for name, column in columns.items()},
        coords={
            "strength": list(config.strengths),
            "case": list(CASES),
            "time": ("time", times.numpy(), harness.TIME),
            "ring_time": ("ring_time", ring_times.numpy(), harness.TIME),
            "band": np.arange(1, config.n_bands + 1),
        },
    )  # fmt: skip


def each_realization_of_ring(scene: tc.Scene, device: str) -> dict[str, Tensor]:
    """Band energies over time and their infinite-time average, of every ring, from its modes."""
    parts: dict[str, list[Tensor]] = {"band_energy": [], "long_time_band_energy": []}
    measured = ensemble.stream(
        scene, lambda chunk: chunk.observe(["band_energy", "long_time_band_energy"]), "modes", device=device
    )
    for _, values in measured:
        for name, part in parts.items():
            part.append(values[name].cpu())
    return {name: torch.cat(part) for name, part in parts.items()}


def moments(scene: tc.Scene) -> dict[str, float]:
    """What long waves feel: slowness sqrt(<b> <1 / kappa>), and the relative variances of mass and softness, summed."""
    chain = scene.chain(range(min(100, scene.realizations)))
    softness = 1 / chain.contact_stiffness
    slowness = math.sqrt(chain.masses.mean() * softness.mean())
    spread = sum(float(x.var() / x.mean() ** 2) if x.numel() > 1 else 0.0 for x in (chain.masses, softness))
    return {"slowness": slowness, "effective_strength": math.sqrt(spread)}


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(5, max(3, len(config.strengths)), width=5.0, height=3.0)
    band = band_of(config.tone, config.ring_particles, config.n_bands)
    for i, xi in enumerate(config.strengths):
        for j, case in enumerate(CASES):
            part = data.isel(strength=i, case=j)
            style = {
                "color": f"C{j}" if case != "normal again" else "k",
                "lw": 1.0,
                "label": case,
                "ls": "-" if j < 5 else "--",
            }
            plots.curve(axes[0, i], data.time.values, part.center.values, part.center_stderr.values, **style)
            ratio(axes[1, i], data.isel(strength=i), part, style)
            plots.curve(axes[2, i], data.ring_time.values, part.share.values, part.share_stderr.values, **style)
            plots.curve(axes[3, i], data.band.values, part.long_time.values, part.long_time_stderr.values, **style)
        axes[0, i].set(xlabel=plots.TIME_LABEL, ylabel="center of energy $R$", title=f"$\\xi$ = {xi:g}")
        axes[1, i].set(
            xlabel=plots.TIME_LABEL, ylabel="r$^2$ / that of normal masses", xlim=(config.early, config.stop)
        )
        axes[2, i].set(xlabel=plots.TIME_LABEL, ylabel=f"share of the energy in band {band}")
        axes[3, i].set(xlabel=plots.BAND_LABEL, ylabel="share at infinite time", yscale="log")
    collapse(axes[4], data)
    for ax in (*axes[:4, len(config.strengths) :].flat, *axes[4, 3:]):
        ax.set_axis_off()
    axes[0, 0].legend(fontsize="x-small", ncols=2)
    figure.suptitle(
        f"kick beside the wall, {config.realizations} chains of {config.n_particles}; below: rings, tone {config.tone}, "
        f"{config.ring_realizations} rings of {config.ring_particles}; shaded: standard error", fontsize="medium",
    )  # fmt: skip
    return figure


def collapse(axes: np.ndarray, data: xarray.Dataset) -> None:
    """The last R, r^2 and the infinite-time share against what long waves feel of the disorder, all cases and strengths."""
    last = data.isel(time=-1)
    source = int(data.long_time.values.mean((0, 1)).argmax())
    for ax, values, label in zip(
        axes, (last.center, last.width, data.long_time.isel(band=source)),
        (f"R at t = {float(last.time):g}", f"r$^2$ at t = {float(last.time):g}", f"share at infinite time, band {source + 1}"), strict=False,
    ):  # fmt: skip
        order = np.argsort(data.effective_strength.sel(case="normal").values)
        for j, case in enumerate(CASES):
            x, y = data.effective_strength.values[order, j], values.values[order, j]
            style = {"color": f"C{j}" if case != "normal again" else "k", "mfc": "none", "label": case}
            ax.plot(x, y, "o-" if j == 0 else "sd^vx*o"[j - 1], lw=0.8, **style)
        ax.set(xlabel="effective strength for long waves", ylabel=label, xscale="log", yscale="log")
    axes[0].legend(fontsize="x-small")


def ratio(ax: Axes, parts: xarray.Dataset, part: xarray.Dataset, style: dict[str, Any]) -> None:
    late = parts.time.values >= parts.time.values[-1] / 10
    normal = parts.isel(case=0).width.values[late]
    plots.curve(
        ax, parts.time.values[late], part.width.values[late] / normal, part.width_stderr.values[late] / normal, **style
    )


@dataclass(frozen=True)
class Deviation:
    """How far a case is from normal masses.

    Attributes:
        relative: mean over the times of the relative difference; its error if all times rise and fall together.
        relative_stderr: see above.
        ratio: root mean square over the times of the difference in standard errors; about 1 by chance.
    """

    relative: float
    relative_stderr: float
    ratio: float


def deviation(data: xarray.Dataset, strength: int, case: str, name: str, begin: float = 0.0) -> Deviation:
    part, normal = data.isel(strength=strength).sel(case=case), data.isel(strength=strength, case=0)
    axis = part[name].dims[0]
    inside = part[axis].values >= begin
    difference = (part[name] - normal[name]).values[inside]
    error = np.hypot(part[f"{name}_stderr"].values, normal[f"{name}_stderr"].values)[inside]
    known = error > 0
    scale = normal[name].values[inside]
    return Deviation(
        float((difference / scale).mean()), float((error / scale).mean()),
        float(np.sqrt(np.mean((difference[known] / error[known]) ** 2))),
    )  # fmt: skip


def distance(data: xarray.Dataset, strength: int, case: str) -> tuple[float, float]:
    """Total variation of the infinite-time band energies from those of normal masses, and what chance makes of it."""
    part, normal = data.isel(strength=strength).sel(case=case), data.isel(strength=strength, case=0)
    p, q = (torch.from_numpy(x.long_time.values) for x in (part, normal))
    error = np.hypot(part.long_time_stderr.values, normal.long_time_stderr.values)
    return float(tc.total_variation(p, q)), float(tc.statistical_distance(torch.from_numpy(error / math.sqrt(2))))


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, xi in enumerate(config.strengths):
        for case in CASES[1:]:
            name = f"xi = {xi:g}, {case}"
            for what, text, begin in (("center", "R", config.early), ("width", "r^2", config.early)):
                d = deviation(data, i, case, what, begin)
                rows.append(
                    Row(
                        f"{name}: {text} less normal, relative",
                        d.relative,
                        d.relative_stderr,
                        note=f"rms {d.ratio:.1f} sigma",
                    )
                )
            d = deviation(data, i, case, "share", config.ring_early)
            tv, chance = distance(data, i, case)
            part = data.isel(strength=i).sel(case=case)
            rows += [
                Row(f"{name}: share in the source band less normal, relative", d.relative, d.relative_stderr, note=f"rms {d.ratio:.1f} sigma"),
                Row(f"{name}: infinite-time bands, total variation from normal", tv, note=f"{chance:.4f} by chance, ratio {tv / chance:.1f}"),
                Row(f"{name}: effective strength for long waves", float(part.effective_strength), note=f"slowness {float(part.slowness):.3f}"),
            ]  # fmt: skip
    return rows


SIGMAS = 3.0  # rms difference beyond which two ensembles of this size count as different


def differing(data: xarray.Dataset, strength: int, config: Config) -> dict[str, float]:
    """The cases that differ from normal masses, with the largest of their four ratios."""
    found = {}
    for case in CASES[1:]:
        tv, chance = distance(data, strength, case)
        ratios = [deviation(data, strength, case, name, config.early).ratio for name in ("center", "width")]
        worst = max(*ratios, deviation(data, strength, case, "share", config.ring_early).ratio, tv / chance)
        if worst > SIGMAS:
            found[case] = worst
    return found


def within(data: xarray.Dataset, strength: int, cases: tuple[str, ...], config: Config) -> str:
    """The largest mean relative differences from normal masses."""
    begins = {"center": config.early, "width": config.early, "share": config.ring_early}
    worst = {
        name: max(abs(deviation(data, strength, case, name, t).relative) for case in cases)
        for name, t in begins.items()
    }
    return f"R {100 * worst['center']:.0f} %, r^2 {100 * worst['width']:.0f} %, share in the source band {100 * worst['share']:.0f} %"


def explain(data: xarray.Dataset, config: Config) -> str:
    lines = []
    for i, xi in enumerate(config.strengths):
        found = differing(data, i, config)
        same = [case for case in CASES[1:] if case not in found]
        text = ", ".join(f"{case} ({worst:.0f})" for case, worst in found.items()) or "none"
        lines += [
            f"xi = {xi:g}: like normal masses within {SIGMAS:g} errors: {', '.join(same) or 'none'}; different (largest ratio to the error): {text}.",
            f"  largest mean difference, masses of other shape: {within(data, i, KINDS[1:], config)};",
            f"  chance (normal again): {within(data, i, ('normal again',), config)}; stiffness and both: {within(data, i, ('stiffness', 'both'), config)}.",
        ]
    return "\n".join(lines) + (
        "\nWhere the claim ends: long waves (R, r^2) feel above all the mean and the variance of mass and of softness 1 / kappa; against these the\n"
        "shapes of the masses nearly fall on one curve (last row of the figure). Equal xi is not equal variance: the cut at 0.05 takes a tenth of the\n"
        "standard deviation from normal masses at xi = 0.5, and the variance of 1 / kappa grows without bound with the xi of the stiffness, where a few\n"
        "very soft contacts make a strength that localizes less than it says. Band 23 is a short wave, of 3 particles: it sees the whole\n"
        "distribution, and shapes differ there by more than the error even at xi = 0.1 (binary)."
    )


SCRIPT = harness.Script("disorder_kinds", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
