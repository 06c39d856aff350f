"""Master equations of lattices on fresh lattices: every model's distance beside that of two ensembles."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.master import PredictionWarning
from torchchain.master.fits import FitWarning

MODELS = (("paper", "analytic"), ("paper", "linear"), ("basis_matrix", "linear"), (None, None))
"""Model and method of each; the last is what calibrate chooses."""


@dataclass(frozen=True)
class Config:
    """Calibrate on one seed, score on another."""

    seed: int = 0
    """seed of the lattices of the calibration"""
    fresh_seed: int = 1
    """seed of the lattices that nothing was calibrated on"""
    lattice: str = "triangular"
    """kind of lattice"""
    size: int = 48
    """particles along each direction"""
    motion: str = "vector"
    """displacements along all directions, or "scalar": one"""
    n_bands: int = 16
    """shells of |q| times polarizations"""
    realizations: int = 40
    """lattices of each ensemble"""
    strengths: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5)
    """disorders xi of the masses"""
    stop: float = 50.0
    """last time"""

    def scene(self, strength: float, seed: int) -> tc.Scene:
        times = np.unique(np.append(np.concatenate([np.arange(0, 5, 0.5), np.arange(5, self.stop)]), self.stop))
        return tc.Scene(
            lattice=self.lattice, shape=(self.size, self.size), motion=self.motion, n_bands=self.n_bands, realizations=self.realizations,
            seed=seed, times=times[times <= self.stop].tolist(), disorder=tc.Disorder(strength=strength),
        )  # fmt: skip


SMOKE = Config(size=12, n_bands=6, realizations=6, strengths=(0.1, 0.5), stop=8.0)


def measure(config: Config, device: str) -> xarray.Dataset:
    """Total variation of every model from fresh lattices, [strength, model], and of two ensembles from each other."""
    distances, worst, noise, numbers, names = [], [], [], [], []
    for strength in config.strengths:
        own, fresh = (
            tc.band_transfer(config.scene(strength, s), device=device) for s in (config.seed, config.fresh_seed)
        )
        later = fresh.times > 0
        share = torch.diff(fresh.times, prepend=fresh.times[:1])[later]
        share = share / share.sum()

        def mean(distance: torch.Tensor, later: torch.Tensor = later, share: torch.Tensor = share) -> float:
            return float((distance[:, later] * share).sum(-1).mean())

        eye = torch.eye(own.n_bands, dtype=torch.float64)
        row, far, count = [], [], []
        for model, method in MODELS:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FitWarning)
                warnings.simplefilter("ignore", PredictionWarning)
                master = tc.calibrate(own, method, model)
                predicted = master.solve(eye, fresh.times).detach()
            distance = tc.total_variation(predicted, fresh.mean)
            row.append(mean(distance))
            far.append(float(distance.max()))
            count.append(master.n_parameters)
        distances.append(row)
        worst.append(far)
        numbers.append(count)
        names.append(master.calibration.model)
        noise.append((mean(tc.total_variation(own.mean, fresh.mean)), mean(tc.statistical_distance(own.stderr))))
    return xarray.Dataset(
        {
            "distance": (("strength", "model"), np.array(distances)),
            "worst": (("strength", "model"), np.array(worst)),
            "numbers": (("strength", "model"), np.array(numbers)),
            "chosen": ("strength", names),
            "two": ("strength", [pair[0] for pair in noise]),
            "expected": ("strength", [pair[1] for pair in noise]),
        },
        coords={
            "strength": list(config.strengths),
            "model": [f"{model}, {method}" if model else "chosen" for model, method in MODELS],
        },
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 1, width=5.4, height=4)
    axis = axes[0, 0]
    for name, marker in zip(data.model.values, "svdo", strict=True):
        axis.plot(data.strength, data.distance.sel(model=name), f"{marker}-", label=name)
    axis.plot(data.strength, data.two, "k:", label=f"two ensembles of {config.realizations}")
    axis.set(
        xlabel=r"disorder $\xi$", ylabel="total variation from fresh lattices", yscale="log",
        title=f"{config.size} x {config.size} {config.lattice}, {config.motion}, {config.n_bands} bands, 0 < $t$ ≤ {config.stop:g}",
    )  # fmt: skip
    axis.legend(fontsize="small")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for strength in data.strength.values:
        line = data.sel(strength=strength)
        note = f"expected from their errors {float(line.expected):.4f}"
        rows.append(Row(f"xi = {strength:g}: two ensembles", float(line.two), note=note))
        for name in data.model.values:
            one = line.sel(model=name)
            kind = f" ({line.chosen.item()})" if name == "chosen" else ""
            note = f"/ two ensembles {float(one.distance / line.two):.2f}, worst {float(one.worst):.4f}, {int(one.numbers)} numbers"
            rows.append(Row(f"    {name}{kind}", float(one.distance), note=note))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    ratio = data.distance.sel(model="chosen") / data.two
    return (
        "measured: total variation from fresh lattices, mean over sources and, evenly, over time. The chosen model is at "
        f"{float(ratio.min()):.2f} to {float(ratio.max()):.2f} times the distance of two ensembles (wanted 1.25)."
    )


SCRIPT = harness.Script("network_models", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: Sequence[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
