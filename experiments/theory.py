"""Band energies from the theory of disorder beside chains: rates, spectral functions, decay, error against cost, and edges."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter
from torch import Tensor

import torchchain as tc
from torchchain import plots
from torchchain.energy.bands import band_of, center_tones
from torchchain.master.fits import analytic_prefactor, linear_rates, profile
from torchchain.theory import born_rates, effective_medium, theory_transfer

WAYS = ("theory", "ladder alone")
HISTOGRAM = 60
FAILS = 0.02  # total variation of one source at one time
STYLES = ("-", "--", ":", "-.")


@dataclass(frozen=True)
class Config(Ensemble):
    realizations: int = 400
    """chains that the theory is held against"""
    stop: float = 400.0
    """last time"""
    step: float = 8.0
    """time step after t = 2"""
    strengths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
    """disorders xi"""
    strength: float = 0.3
    """disorder of the rates and spectral functions"""
    window: tuple[float, float] = (0.5, 2.0)
    """times of procedure L"""
    tone: int = 90
    """the decay shown, in band 23"""
    spectral_tones: tuple[int, ...] = (40, 90, 118)
    """tones of the spectral functions"""
    fresh_seed: int = 1
    """seed of the ensembles whose own error is measured"""
    sizes: tuple[int, ...] = (10, 100, 1000)
    """chains in them"""


SMOKE = Config(
    n_particles=32, n_bands=4, realizations=4, stop=6.0, step=2.0, strengths=(0.1, 0.3), tone=10, spectral_tones=(6,),
    sizes=(2, 4),
)  # fmt: skip


def times_of(config: Config) -> Tensor:
    early = torch.arange(0, 2.01, 0.25, dtype=torch.float64)
    return torch.cat([early, torch.arange(config.step, config.stop + 1e-9, config.step, dtype=torch.float64)]).unique()


def distance(a: Tensor, b: Tensor) -> Tensor:
    """Total variation, mean over sources, (time,)."""
    return (a - b).abs().sum(-1).mean(0) / 2


def measure(config: Config, device: str) -> xarray.Dataset:
    t = times_of(config)
    band = band_of(config.tone, config.n_particles, config.n_bands) - 1
    shape = (len(config.strengths), len(t))
    error, late = np.empty((2, *shape)), np.empty((2, shape[0]))
    noise, estimate, decay = np.empty(shape), np.empty(shape), np.empty((3, *shape))
    late_noise, by_band = np.empty(shape[0]), np.empty((*shape, config.n_bands))
    cost = np.empty((2, shape[0]))
    sampled, sampled_cost = np.empty((len(config.sizes), shape[0])), np.empty((len(config.sizes), shape[0]))
    rates = {}
    counted = (t > 0) & (t >= min(config.step, config.stop))
    for i, xi in enumerate(config.strengths):
        scene = config.scene(xi, times=t)
        chains = tc.band_transfer(scene, device=device)
        results = []
        for way, whole in enumerate((True, False)):
            began = time.process_time()
            results.append(theory_transfer(scene.disorder, config.n_particles, config.n_bands, t, localization=whole))
            cost[way, i] = time.process_time() - began
            error[way, i] = distance(results[-1].mean, chains.mean)
            late[way, i] = distance(results[-1].long_time[:, None], chains.long_time[:, None])[0]
        by_band[i] = (results[0].mean - chains.mean).abs().sum(-1).T / 2
        expected = math.sqrt(2 / math.pi) / 2
        noise[i] = expected * chains.stderr.sum(-1).mean(0)
        late_noise[i] = expected * float(chains.long_time_stderr.sum(-1).mean())
        estimate[i] = results[0].systematic.mean(0)
        single = theory_transfer(scene.disorder, config.n_particles, config.n_bands, t, tones=[config.tone])
        decay[0, i] = single.mean[0, :, band]
        alone = tc.simulate(config.scene(xi, (config.tone,), times=t), device=device).isel(tone=0, band=band)
        decay[1, i], decay[2, i] = alone.band_energy.values, alone.band_energy_stderr.values
        for j, size in enumerate(config.sizes):
            began = time.process_time()
            other = tc.band_transfer(
                config.scene(xi, times=t, realizations=size, seed=config.fresh_seed), device=device
            )
            sampled_cost[j, i] = time.process_time() - began
            sampled[j, i] = distance(other.mean, chains.mean)[counted].mean()
        if xi == config.strength:
            rates = _rates(config, t, chains, results[0].mean)
    w, spectral, histogram = _spectral(config)
    k = 2 * math.pi / config.n_particles * torch.tensor(center_tones(config.n_particles, config.n_bands))
    return xarray.Dataset(
        {
            "error": (("way", "strength", "time"), error, {"long_name": "mean total variation from chains"}),
            "by_band": (("strength", "time", "source"), by_band, {"long_name": "total variation of each source"}),
            "late_error": (("way", "strength"), late, {"long_name": "the same at infinite time"}),
            "noise": (("strength", "time"), noise, {"long_name": "part of it that is the chains' own error"}),
            "late_noise": (("strength",), late_noise),
            "estimate": (("strength", "time"), estimate, {"long_name": "the theory's own estimate"}),
            "decay": (("curve", "strength", "time"), decay),
            "cost": (("way", "strength"), cost, {"units": "s"}),
            "sampled_error": (("size", "strength"), sampled),
            "sampled_cost": (("size", "strength"), sampled_cost, {"units": "s"}),
            "spectral": (("tone", "frequency"), spectral),
            "histogram": (("tone", "frequency"), histogram),
            "born": (("source",), born_rates(config.strength, k).numpy(), harness.RATE),
            **{name: (("source", "receiver"), value.numpy(), harness.RATE) for name, value in rates.items()},
        },
        {
            "time": ("time", t.numpy(), harness.TIME), "strength": list(config.strengths), "way": list(WAYS),
            "curve": ["theory", "chains", "stderr"], "size": list(config.sizes), "tone": list(config.spectral_tones),
            "frequency": w, "source": np.arange(1, config.n_bands + 1), "receiver": np.arange(1, config.n_bands + 1),
        },
    )  # fmt: skip


def _rates(config: Config, t: Tensor, chains: tc.BandTransfer, theory: Tensor) -> dict[str, Tensor]:
    """Q by procedure L from chains and from the theory, and Eq. 50 with its best prefactor; nothing held back."""
    free = torch.ones(config.n_bands, dtype=torch.float64)
    measured, derived = (linear_rates(t, mean, free, config.window) for mean in (chains.mean, theory))
    eq50 = analytic_prefactor(measured)[0] * profile(config.n_bands)
    return {"rates_chains": measured, "rates_theory": derived, "rates_eq50": eq50}


def _spectral(config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A_k(w) of the medium in bins, and the chains' histogram of the waves' energy over their modes."""
    edges = torch.linspace(0, 2.6, HISTOGRAM + 1, dtype=torch.float64)
    fine = ((torch.arange(40 * HISTOGRAM, dtype=torch.float64) + 0.5) / (40 * HISTOGRAM)) * 2.6
    k = 2 * math.pi / config.n_particles * torch.tensor(config.spectral_tones, dtype=torch.float64)
    medium = effective_medium(tc.Disorder(strength=config.strength), fine)
    spectral = medium.spectral_function(k).reshape(len(k), HISTOGRAM, 40).mean(-1)
    scene = config.scene(config.strength, config.spectral_tones)
    chain = scene.chain(range(min(config.realizations, 100)))
    modes = tc.normal_modes(chain)
    start = scene.state(chain).displacement
    share = (modes.frequencies[:, None] * ((start * chain.masses[:, None]) @ modes.shapes)).square()
    share = share / share.sum(-1, keepdim=True)
    bins = torch.bucketize(modes.frequencies, edges)
    histogram = torch.zeros(len(k), HISTOGRAM + 2, dtype=torch.float64)
    for i in range(len(k)):
        histogram[i].index_add_(0, bins.flatten(), share[:, i].flatten())
    density = histogram[:, 1:-1] / len(modes.frequencies) / float(edges[1] - edges[0])
    return ((edges[1:] + edges[:-1]) / 2).numpy(), spectral.numpy(), density.numpy()


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 3)
    if "rates_chains" in data:
        _draw_rates(axes[0, 0], data, config)
    _draw_spectral(axes[0, 1], data, config)
    t = data.time.values
    for i, xi in enumerate(config.strengths):
        theory, chains, stderr = data.decay.isel(strength=i).values
        axes[0, 2].plot(t, theory, color=f"C{i}", label=f"$\\xi$ = {xi:g}")
        some = slice(None, None, max(1, len(t) // 25))
        axes[0, 2].errorbar(t[some], chains[some], 2 * stderr[some], fmt=".", ms=4, color=f"C{i}")
        axes[1, 0].plot(t[1:], data.error.isel(way=0, strength=i)[1:], color=f"C{i}", label=f"$\\xi$ = {xi:g}")
        axes[1, 0].plot(t[1:], data.error.isel(way=1, strength=i)[1:], "--", color=f"C{i}", lw=0.8)
        axes[1, 0].plot(t[1:], data.noise.isel(strength=i)[1:], ":", color=f"C{i}", lw=0.8)
    band = band_of(config.tone, config.n_particles, config.n_bands)
    axes[0, 2].set(xlabel=plots.TIME_LABEL, ylabel="share left in it", ylim=(0, 1.02),
                   title=f"band {band}")  # fmt: skip
    axes[0, 2].legend(fontsize=8)
    axes[1, 0].set(xscale="log", yscale="log", xlabel=plots.TIME_LABEL, ylabel="mean total variation from chains", ylim=(1e-5, 0.2),
                   title="theory (lines), ladder alone (dashed), noise (dotted)")  # fmt: skip
    axes[1, 0].legend(fontsize=8)
    _draw_cost(axes[1, 1], data, config)
    _draw_edges(axes[1, 2], data, config)
    figure.suptitle(
        f"theory without chains, N = {config.n_particles}, B = {config.n_bands}, against {config.realizations} chains"
    )
    return figure


def _draw_rates(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    for name, label, style in (("chains", "chains", "o"), ("theory", "theory", "-"), ("eq50", "Eq. 50", "--")):
        value = -np.diag(data[f"rates_{name}"].values)
        ax.plot(
            data.source, value, style, ms=3, label=f"$-Q_{{ss}}$, L: {label}" if name != "eq50" else "$-Q_{ss}$, Eq. 50"
        )
        row = data[f"rates_{name}"].values[config.n_bands * 23 // 32 - 1].copy()
        row[config.n_bands * 23 // 32 - 1] = np.nan
        ax.plot(data.source, 10 * row, style, ms=2, lw=0.8, color=ax.lines[-1].get_color())
    ax.plot(data.source, data.born, ":", color="gray", label="Born: loss of coherence")
    top = 1.3 * max(float(-np.diag(data.rates_chains.values).min()), float(-np.diag(data.rates_chains.values).max()))
    ax.set(xlabel="band", ylabel="rate", ylim=(0, max(top, 1e-3)),
           title=f"rates; thin: 10 $Q_{{sr}}$, source {config.n_bands * 23 // 32}")  # fmt: skip
    ax.legend(fontsize=8)


def _draw_spectral(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    for i, tone in enumerate(data.tone.values):
        ax.stairs(data.histogram[i], np.linspace(0, 2.6, HISTOGRAM + 1), color=f"C{i}", fill=True, alpha=0.3)
        ax.plot(data.frequency, data.spectral[i], color=f"C{i}", label=f"tone {tone}")
    ax.set(xlabel=r"frequency $\omega$", ylabel=r"$A_k(\omega)$; bars: chains", title=f"$\\xi$ = {config.strength:g}")
    ax.legend(fontsize=8)


def _draw_cost(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    mean = _mean_error(data, config)
    for i, xi in enumerate(config.strengths):
        ax.plot(data.sampled_cost.isel(strength=i), data.sampled_error.isel(strength=i), ".-", color=f"C{i}", lw=0.6)
        ax.plot(data.cost[0, i], mean[0, i], "*", ms=11, color=f"C{i}", label=f"$\\xi$ = {xi:g}")
        ax.plot(data.cost[1, i], mean[1, i], "^", ms=5, mfc="none", color=f"C{i}")
    sizes = ", ".join(f"{size}" for size in config.sizes)
    ax.set(xscale="log", yscale="log", xlabel="processor time (s)", ylabel="mean total variation from the chains",
           title=f"stars: theory, triangles: ladder,\nlines: {sizes} chains")  # fmt: skip
    ax.legend(fontsize=8)


def _draw_edges(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    labels = [f"$\\xi$ = {xi:g}" for xi in config.strengths]
    outline(ax, data.by_band.sel(time=slice(config.step, None)).rename(strength="case"), labels)


def outline(ax: Axes, off: xarray.DataArray, labels: list[str]) -> None:
    """Lines around where a source's energies are wrong by FAILS or more, of (case, time, source)."""
    for i, label in enumerate(labels):
        smooth = gaussian_filter(off.isel(case=i).values, 1.0)
        style = STYLES[i % len(STYLES)]
        ax.plot([], [], style, color=f"C{i}", label=label)
        if smooth.max() > FAILS > smooth.min() and min(smooth.shape) > 1:
            ax.contour(off.time, off.source, smooth.T, [FAILS], colors=f"C{i}", linestyles=style)
    ax.set(xscale="log", xlabel=plots.TIME_LABEL, ylabel="source band", xlim=(float(off.time[0]), float(off.time[-1])),
           ylim=(1, off.sizes["source"] + 1), title=f"off by {FAILS:g}: inside")  # fmt: skip
    ax.legend(fontsize=8, loc="upper right")


def _mean_error(data: xarray.Dataset, config: Config) -> np.ndarray:
    """Mean over times from the first step on, [way, strength]."""
    return data.error.where(data.time >= config.step).mean("time").values


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows, mean = [], _mean_error(data, config)
    worst = data.error[0].idxmax("time").values
    for i, xi in enumerate(config.strengths):
        label = f"$\\xi$ = {xi:g}"
        rows += [
            Row(f"{label}: theory, mean over times", float(mean[0, i]), note=f"chains' own {float(data.noise[i, -1]):.4f}"),
            Row(f"{label}: theory, infinite time", float(data.late_error[0, i]), note=f"chains' own {float(data.late_noise[i]):.4f}"),
            Row(f"{label}: theory, worst time", float(data.error[0, i].max()), note=f"t = {worst[i]:g}"),
            _worst_source(data, i, label),
            Row(f"{label}: ladder alone, mean over times", float(mean[1, i])),
            Row(f"{label}: theory, processor seconds", float(data.cost[0, i])),
        ]  # fmt: skip
    return rows


def _worst_source(data: xarray.Dataset, i: int, label: str) -> Row:
    one = data.by_band.isel(strength=i)
    place = one.argmax(("time", "source"))
    worst = one.isel(place)
    share = float((one > FAILS).mean())
    note = (
        f"band {int(worst.source)}, t = {float(worst.time):g}; {100 * share:.0f} % of sources and times above {FAILS:g}"
    )
    return Row(f"{label}: theory, worst source and time", float(worst), note=note)


def explain(data: xarray.Dataset, config: Config) -> str:
    mean = _mean_error(data, config)
    beaten = [config.sizes[j] for j in range(len(config.sizes)) if (data.sampled_error.values[j] > mean[0]).all()]
    size = f"an ensemble of {max(beaten)} chains at every disorder" if beaten else "no ensemble at every disorder"
    return (
        f"Numbers are mean total variation from {config.realizations} chains, whose own error is part of them. The theory is nearer\n"
        f"than {size}. It is worst at times between the ladder's and localization's, where the\n"
        f"interference sets in; localization takes the error at infinite time down to "
        f"{float((data.late_error[0] / data.late_error[1]).max()):.2f} of the ladder's or less."
    )


SCRIPT = harness.Script("theory", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
