"""Is the energy in the bands Markovian? Chapman-Kolmogorov test and implied timescales of the chains."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import plots


@dataclass(frozen=True)
class Config(Ensemble):
    strength: float = 0.3
    """disorder xi"""
    realizations: int = 400
    """chains in the ensemble"""
    stop: float = 80.0
    """last time"""
    step: float = 1.0
    """time step of the output"""
    lags: tuple[float, ...] = (2.0, 5.0, 10.0, 20.0)
    """lag times of the Chapman-Kolmogorov test"""


SMOKE = Config(n_particles=64, n_bands=8, realizations=8, stop=16.0, lags=(2.0, 4.0))


def measure(config: Config, device: str) -> xarray.Dataset:
    chains = tc.band_transfer(config.scene(config.strength), device=device)
    data: dict[str, tuple[tuple[str, ...], np.ndarray]] = {}
    for i, lag in enumerate(config.lags):
        multiples = [n for n in (2, 3, 4, 6, 8, 12, 16, 24, 32, 40) if n * lag <= config.stop]
        result = tc.chapman_kolmogorov(chains, lag, multiples)
        data[f"time_{i}"] = (f"multiple_{i}",), result.times.numpy()
        data[f"distance_{i}"] = ("source", f"multiple_{i}"), result.distance.numpy()
        data[f"statistical_{i}"] = ("source", f"multiple_{i}"), result.statistical.numpy()
    lags = chains.times[(chains.times > 0) & (chains.times <= config.stop / 2)]
    scales, stderr = tc.implied_timescales(chains, lags)
    master = tc.calibrate(chains, bootstrap=0)
    eye = torch.eye(config.n_bands, dtype=torch.float64)
    predicted = master.solve(eye, chains.times).detach()
    error = tc.total_variation(predicted, chains.mean)
    data |= {
        "timescale": (("lag", "eigenvalue"), scales.numpy()),
        "timescale_stderr": (("lag", "eigenvalue"), stderr.numpy()),
        "model_distance": (("source", "time"), error.numpy()),
    }
    return xarray.Dataset(data, coords={"lag": lags.numpy(), "time": chains.times.numpy()})


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2, width=5.4, height=4.2)
    ax = axes[0, 0]
    for i, lag in enumerate(config.lags):
        values = (data[f"{name}_{i}"].values for name in ("time", "distance", "statistical"))
        plots.chapman_kolmogorov(ax, *values, label=f"lag {lag:g}")
    ax.plot(data.time[1:], data.model_distance.mean("source")[1:], "k-", label="model with memory and chains")
    ax.set(yscale="log", title="(a) Chapman-Kolmogorov (dotted: noise)")
    ax.legend(fontsize="small")
    ax = plots.implied_timescales(axes[0, 1], data.lag.values, data.timescale.values, data.timescale_stderr.values)
    finite = data.timescale.values[:, :5]
    top = float(finite[np.isfinite(finite)].max())
    ax.set(title="(b) implied timescales (gray: shorter than the lag)", ylim=(1, 2 * top))
    ax.legend(fontsize="small")
    figure.suptitle(f"$\\xi$ = {config.strength:g}, {config.realizations} chains", fontsize="medium")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, lag in enumerate(config.lags):
        distance, noise = data[f"distance_{i}"][:, 0], data[f"statistical_{i}"][:, 0]
        ratio = float((distance / noise).mean())
        rows.append(
            Row(f"T(2 lag) and T(lag)^2, lag {lag:g}", float(distance.mean()), note=f"{ratio:.0f} times the noise")
        )
    for place in (0, len(data.lag) // 4, len(data.lag) - 1):
        rows.append(
            Row(
                f"slowest timescale at lag {float(data.lag[place]):g}", float(data.timescale[place, 0]),
                float(data.timescale_stderr[place, 0]),
            )
        )  # fmt: skip
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Rates without memory would give T(2 lag) = T(lag)^2 and timescales that no lag changes. Neither holds: what stays in a "
        "band for good makes the timescales grow with the lag."
    )


SCRIPT = harness.Script("markov_tests", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
