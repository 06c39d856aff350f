"""How few fitted numbers reach the noise of an ensemble: every reduced model calibrated on it, against fresh chains."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.master.sample import decade_weights

RUNGS: tuple[tuple[str, dict[str, tuple[int, ...]]], ...] = (
    ("theory", {}),
    *(("corrected_theory", {"degrees": d}) for d in ((1, 1, 2), (2, 2, 4), (3, 3, 6), (4, 4, 8), (6, 5, 10))),
    *(("compact", {"degrees": d}) for d in ((4, 3, 6), (6, 4, 8), (8, 5, 10), (8, 6, 12), (10, 7, 16))),
    ("paper", {}), ("basis_matrix", {}), ("memory", {}),
)  # fmt: skip
STYLES = {"theory": "*", "corrected_theory": "o", "compact": "s", "paper": "v", "basis_matrix": "^", "memory": "D"}


@dataclass(frozen=True)
class Config(Ensemble):
    realizations: int = 100
    """chains that the models are calibrated on"""
    fresh: int = 400
    """chains that they are held against"""
    fresh_seed: int = 1
    """seed of these"""
    stop: float = 400.0
    """last time"""
    step: float = 4.0
    """time step after t = 4"""
    strengths: tuple[float, ...] = (0.1, 0.3)
    """disorders xi"""


SMOKE = Config(n_particles=32, n_bands=4, realizations=8, fresh=8, stop=20.0, step=2.0, strengths=(0.3,))


def times_of(config: Config) -> Tensor:
    early = torch.arange(0, 4.01, 0.25, dtype=torch.float64)
    return torch.cat([early, torch.arange(4.0, config.stop + 1e-9, config.step, dtype=torch.float64)]).unique()


def measure(config: Config, device: str) -> xarray.Dataset:
    t = times_of(config)
    weight = decade_weights(t)
    shape = (len(config.strengths), len(RUNGS))
    numbers, error = np.zeros(shape), np.zeros(shape)
    noise = np.zeros((len(config.strengths), 2))
    for i, xi in enumerate(config.strengths):
        seen = tc.band_transfer(config.scene(xi, times=t), device=device)
        scene = config.scene(xi, times=t, realizations=config.fresh, seed=config.fresh_seed)
        fresh = tc.band_transfer(scene, device=device)
        # of an endless ensemble, sqrt(2) nearer than a second one
        noise[i, 1] = float(statistical_distance(fresh.stderr).mean(0) @ weight) / np.sqrt(2)
        noise[i, 0] = float(total_variation(seen.mean, fresh.mean).mean(0) @ weight)
        for j, (name, settings) in enumerate(RUNGS):
            master = tc.calibrate(seen, model=name, bootstrap=0, **settings)
            found = master.model.transfer(t).detach()
            numbers[i, j] = master.n_parameters
            error[i, j] = float(total_variation(found, fresh.mean).mean(0) @ weight)
    labels = [f"{name} {' '.join(map(str, next(iter(settings.values()), ())))}".strip() for name, settings in RUNGS]
    return xarray.Dataset(
        {
            "numbers": (("strength", "model"), numbers, {"long_name": "fitted numbers"}),
            "error": (("strength", "model"), error, {"long_name": "mean total variation from fresh chains"}),
            "noise": (("strength", "of"), noise),
        },
        {"strength": list(config.strengths), "model": labels, "of": ["calibrating ensemble", "fresh chains"]},
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, len(config.strengths), height=3.0)
    lowest, highest = 0.8 * float(data.noise.min()), 1.2 * float(data.error.max())
    for ax, xi in zip(axes[0], config.strengths, strict=True):
        part = data.sel(strength=xi)
        for name, style in STYLES.items():
            chosen = [j for j, (model, _) in enumerate(RUNGS) if model == name]
            at = np.maximum(part.numbers.values[chosen], 1)  # the theory's none at the left edge
            ax.plot(at, part.error.values[chosen], style + "-", ms=12 if name == "theory" else 5, lw=0.8,
                    label=f"{name}, no number" if name == "theory" else name)  # fmt: skip
        ax.axhline(float(part.noise[0]), color="gray", ls=":", label=f"{config.realizations} chains themselves")
        ax.axhline(float(part.noise[1]), color="k", ls="--", lw=0.8, label=f"noise of {config.fresh} chains")
        ax.set(xscale="log", yscale="log", ylim=(lowest, highest), xlabel="fitted numbers", title=f"$\\xi$ = {xi:g}")
        ax.set_xticks([1, 10, 100, 1000, 10_000], ["0", "10", "100", "1000", "10000"])  # none stands where 1 would
        ax.label_outer()
    axes[0, 0].set_ylabel("total variation")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=7)
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    return [
        Row(f"xi = {xi:g}: {model}", float(data.error.sel(strength=xi, model=model)),
            note=f"{int(data.numbers.sel(strength=xi, model=model))} numbers; ensemble itself "
            f"{float(data.noise.sel(strength=xi)[0]):.4f}, fresh chains' own {float(data.noise.sel(strength=xi)[1]):.4f}")
        for xi in config.strengths for model in data.model.values
    ]  # fmt: skip


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Total variation from fresh chains, mean over sources, each decade of time counting alike; the fresh chains' own noise is\n"
        "part of it. A model below the dotted line is nearer to fresh chains than the ensemble that it was calibrated on."
    )


SCRIPT = harness.Script("few_numbers", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
