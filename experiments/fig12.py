"""Fig. 12: binned energy after a standing wave of tone 90 (band 23), in a single chain and averaged over 100."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import harness
import numpy as np
import xarray
from harness import Ensemble, Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import plots
from torchchain.energy.bands import band_of


@dataclass(frozen=True)
class Config(Ensemble):
    strength: float = 0.3
    """disorder xi"""
    tone: int = 90
    """of the standing wave"""


SMOKE = Config(realizations=4, stop=5.0)


def measure(config: Config, device: str) -> xarray.Dataset:
    many = config.scene(config.strength, (config.tone,))
    one = config.scene(config.strength, (config.tone,), realizations=1)
    data = tc.simulate(many, device=device).isel(tone=0)
    single = tc.simulate(one, device=device).band_energy.isel(tone=0)
    return data.assign(single=single.assign_attrs(long_name="share of the energy in a band, the first chain alone"))


def draw(data: xarray.Dataset, config: Config) -> Figure:
    band = band_of(config.tone, config.n_particles, config.n_bands)
    figure, axes = harness.panels(1, 2)
    for ax, name, title in (
        (axes[0, 0], "single", "(a) a single chain"),
        (axes[0, 1], "band_energy", f"(b) mean over {config.realizations} chains"),
    ):
        plots.band_map(ax, data.time.values, data[name].values, title)
    figure.suptitle(f"tone {config.tone}, in band {band}, $\\xi$ = {config.strength:g}")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    band = band_of(config.tone, config.n_particles, config.n_bands)
    late = data.time >= 0.8 * config.stop
    source = data.sel(band=band).where(late, drop=True)
    noise = float(np.sqrt(((data.single - data.band_energy) ** 2).where(late, drop=True).mean()))
    error = float(np.sqrt((data.band_energy_stderr**2).where(late, drop=True).mean()))
    return [
        Row("band of the tone", band, paper="23" if config.tone == 90 else ""),
        Row(f"its share, mean over t >= {0.8 * config.stop:g}, one chain", float(source.single.mean())),
        Row(
            f"its share, mean over t >= {0.8 * config.stop:g}, {config.realizations} chains",
            float(source.band_energy.mean()),
            float(source.band_energy_stderr.mean()),
        ),
        Row("scatter of one chain about the mean (rms over bands)", noise),
        Row(f"standard error of {config.realizations} chains (rms over bands)", error),
    ]


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"The mean over {config.realizations} chains is smoother by the square root of their number, as in the paper."
    )


SCRIPT = harness.Script("fig12", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
