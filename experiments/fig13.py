"""Fig. 13: energy left in the source band over time, (a) in band 23 for six disorders, (b) for six tones."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import harness
import numpy as np
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import plots
from torchchain.energy.bands import band_of


@dataclass(frozen=True)
class Config(Ensemble):
    strengths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
    """(a): disorders xi"""
    tone: int = 90
    """(a): the tone, in band 23"""
    strength: float = 0.3
    """(b): disorder xi"""
    tones: tuple[int, ...] = (18, 38, 58, 78, 98, 118)
    """(b): the tones, in bands 5, 10, ..., 30"""


SMOKE = Config(realizations=4, stop=5.0)


def measure(config: Config, device: str) -> xarray.Dataset:
    seen = ("band_energy", "long_time_band_energy")
    band = band_of(config.tone, config.n_particles, config.n_bands)
    by_strength = [
        tc.simulate(config.scene(xi, (config.tone,), observables=seen), device=device).isel(tone=0).sel(band=band)
        for xi in config.strengths
    ]
    tones = tc.simulate(config.scene(config.strength, config.tones, observables=seen), device=device)
    bands = xarray.DataArray([band_of(n, config.n_particles, config.n_bands) for n in config.tones], dims="tone")
    a = xarray.concat(by_strength, xarray.Variable("strength", list(config.strengths)), combine_attrs="drop")
    b = tones.sel(band=bands).drop_attrs(deep=False)
    return xarray.merge([part.drop_vars("band").rename({name: f"{name}_{letter}" for name in part.data_vars})
                         for part, letter in ((a.drop_vars("tone"), "a"), (b, "b"))]).assign_coords(source=bands)  # fmt: skip


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    band = band_of(config.tone, config.n_particles, config.n_bands)
    curves(axes[0, 0], data, "a", "strength", [f"$\\xi$ = {xi:g}" for xi in config.strengths])
    axes[0, 0].set_title(f"(a) band {band}, tone {config.tone}")
    labels = [f"band {s} (tone {n})" for s, n in zip(data.source.values, config.tones, strict=True)]
    curves(axes[0, 1], data, "b", "tone", labels)
    axes[0, 1].set_title(f"(b) $\\xi$ = {config.strength:g}")
    figure.suptitle(f"mean over {config.realizations} chains, shaded: standard error; at the right edge: infinite time")
    return figure


def curves(ax: Axes, data: xarray.Dataset, letter: str, axis: str, labels: list[str]) -> None:
    """The share left in the source band over time, and its infinite-time average at the right edge."""
    for i, label in enumerate(labels):
        part = data.isel({axis: i})
        energy, error = part[f"band_energy_{letter}"].values, part[f"band_energy_stderr_{letter}"].values
        plots.curve(ax, data.time.values, energy, error, label=label, color=f"C{i}")
        ax.plot(1.0, part[f"long_time_band_energy_{letter}"], "<", color=f"C{i}", transform=ax.get_yaxis_transform(),
                clip_on=False)  # fmt: skip
    ax.set(xlabel=plots.TIME_LABEL, ylabel="share of the energy left in the source band", ylim=(0, 1.02))
    ax.set_xlim(0, float(data.time[-1]))
    ax.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.03, 0.5))


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for letter, axis, names in (
        ("a", "strength", [f"(a) xi = {xi:g}" for xi in config.strengths]),
        ("b", "tone", [f"(b) band {s}" for s in data.source.values]),
    ):
        for i, name in enumerate(names):
            part = data.isel({axis: i})
            last, at_end = part.isel(time=-1), "long_time_band_energy"
            rows += [
                Row(f"{name}: share at t = {config.stop:g}", float(last[f"band_energy_{letter}"]),
                    float(last[f"band_energy_stderr_{letter}"])),
                Row(f"{name}: share at infinite time", float(part[f"{at_end}_{letter}"]),
                    float(part[f"{at_end}_stderr_{letter}"])),
            ]  # fmt: skip
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    tones = data.tone.values
    falling = np.diff(data.long_time_band_energy_b.values) < 0
    stays = "throughout" if falling.all() else f"up to tone {tones[falling.argmin()]} and rises after it"
    gap = [(data[f"long_time_band_energy_{ab}"] - data[f"band_energy_{ab}"].isel(time=-1)).values for ab in "ab"]
    return (
        f"Stronger disorder leaves less in the band and a higher band keeps less, as the paper says; at infinite time the share\n"
        f"left falls with the tone {stays}. At t = {config.stop:g} the curves are flat, but {(np.concatenate(gap) > 0).sum()} "
        f"of {len(np.concatenate(gap))} lie below their exact infinite-time\n"
        f"average, by {max(part.max() for part in gap):.3f} at most: a little energy comes back later."
    )


SCRIPT = harness.Script("fig13", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
