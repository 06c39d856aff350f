"""The picture at the top of the README: a chain, its wavenumber bands, and where the energy goes by chains and by the model."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import plots


@dataclass(frozen=True)
class Config(Ensemble):
    strength: float = 0.3
    """disorder xi"""
    source: int = 15
    """band that holds all energy at the start"""
    beads: int = 48
    """of the first chain, drawn"""


SMOKE = Config(n_particles=64, n_bands=8, realizations=6, stop=10.0, source=4, beads=16)


def measure(config: Config, device: str) -> xarray.Dataset:
    scene = config.scene(config.strength)
    transfer = tc.band_transfer(scene, device=device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        master = tc.calibrate(transfer, bootstrap=0)
    masses = scene.disorder.masses(config.n_particles, 1, config.seed)[0]
    wave = tc.standing_wave(tc.Chain(masses), tone=scene.tones[config.source - 1]).displacement
    predicted = master.transfer(transfer.times).detach()
    at = config.source - 1
    return xarray.Dataset(
        {
            "masses": ("particle", masses.numpy()),
            "displacement": ("particle", wave.numpy()),
            "chains": (("time", "band"), transfer.mean[at].numpy()),
            "model": (("time", "band"), predicted[at].numpy()),
            "distance": ("time", tc.total_variation(predicted[at], transfer.mean[at]).numpy()),
        },
        {"time": transfer.times.numpy(), "band": np.arange(1, config.n_bands + 1)},
        {"numbers": master.n_parameters, "kind": master.calibration.model if master.calibration else ""},
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure = Figure(figsize=(plots.PAGE, 3.9), layout="constrained")
    axes = figure.subplot_mosaic([["chain"] * 3, ["bands", "chains", "model"]], height_ratios=(0.32, 1))
    _chain(axes["chain"], data, config)
    _bands(axes["bands"], config)
    plots.band_map(axes["chains"], data.time.values, data.chains.values, f"{config.realizations} chains")
    plots.band_map(axes["model"], data.time.values, data.model.values, f"model of {data.numbers} numbers")
    plots.lettered(axes.values())
    return figure


def _chain(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    """Beads as large as their masses, moved by the wave (enlarged)."""
    masses, wave = data.masses.values[: config.beads], data.displacement.values[: config.beads]
    places = np.arange(1, config.beads + 1)
    moved = places + 0.35 * wave / abs(wave).max()
    ax.scatter(
        moved,
        np.zeros(config.beads),
        s=70 * masses ** (2 / 3),
        c=masses,
        cmap="Greys",
        vmin=-0.5,
        edgecolors="k",
        linewidths=0.5,
    )
    ax.vlines(places, -1.25, -0.95, color="0.5", lw=0.6)
    ax.set(
        ylim=(-1.4, 1.0), yticks=[], xlabel="bead", title="beads of random masses in a standing wave; ticks: at rest"
    )
    ax.spines[["left", "right", "top"]].set_visible(False)


def _bands(ax: Axes, config: Config) -> None:
    """Frequencies of the ordered chain over wavenumber, cut into bands."""
    edges = np.linspace(0, np.pi, config.n_bands + 1)
    k = np.linspace(0, np.pi, 200)
    for band in range(config.n_bands):
        shade = "#d55e00" if band == config.source - 1 else ("0.88" if band % 2 else "1.0")
        ax.axvspan(edges[band], edges[band + 1], color=shade, lw=0)
    ax.plot(k, 2 * np.sin(k / 2), "k-")
    ax.set(
        xlabel="wavenumber $k$",
        ylabel=r"frequency $\omega$",
        xlim=(0, np.pi),
        ylim=(0, 2.1),
        title=f"{config.n_bands} bands, source {config.source}",
    )
    ax.set_xticks((0, np.pi / 2, np.pi), ("0", r"$\pi/2$", r"$\pi$"))


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    distance = torch.tensor(data.distance.values[1:])
    return [
        Row(
            f"source {config.source}: mean total variation of the two maps",
            float(distance.mean()),
            note=f"{data.kind}, {data.numbers} numbers",
        )
    ]


def explain(data: xarray.Dataset, config: Config) -> str:
    return f"{float(data.chains[-1, config.source - 1]):.3f} of the energy is still in band {config.source} at t = {config.stop:g}."


SCRIPT = harness.Script("overview", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
