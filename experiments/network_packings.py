"""Master equations of a jammed packing with random masses or stiffnesses on fresh realizations, beside two ensembles' distance."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import harness
import network_pictures
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import network as nw
from torchchain.master import PredictionWarning
from torchchain.master.fits import FitWarning

KINDS = ("masses", "stiffness", "removed bonds")


@dataclass(frozen=True)
class Config:
    """One packing; calibrate on one seed, score on another."""

    seed: int = 0
    """seed of the packing and of the ensemble of the calibration"""
    fresh_seed: int = 1
    """seed of the realizations that nothing was calibrated on"""
    n_particles: int = 400
    """disks of two sizes, pressed together"""
    n_shells: int = 4
    """shells of |q| per polarization; what is in none is one more band"""
    realizations: int = 40
    """of each ensemble"""
    strength: float = 0.3
    """disorder of the masses, or of the stiffnesses, the latter without the forces in the contacts, which they would unbalance"""
    removed: float = 0.1
    """probability that a contact is missing, without the forces in the contacts, too"""
    stop: float = 50.0
    """last time"""


SMOKE = Config(n_particles=100, n_shells=1, realizations=4, stop=8.0)


def measure(config: Config, device: str) -> xarray.Dataset:
    """Total variation from fresh realizations of the chosen model and of two ensembles from each other, [kind]."""
    packing = nw.without_rattlers(network_pictures.jammed(network_pictures.Config(config.seed, config.n_particles)))
    relaxed = nw.Network(packing.masses, packing.positions, packing.bonds, box=packing.box, images=packing.images)
    law = tc.Disorder(strength=config.strength)
    times = np.unique(np.append(np.concatenate([np.arange(0, 5, 0.5), np.arange(5, config.stop)]), config.stop))
    share = torch.from_numpy(np.diff(times) / times[-1])
    model, two, numbers, names = [], [], [], []
    for kind, network in zip(KINDS, (packing, relaxed, relaxed), strict=True):
        settings = {"removed_bonds": config.removed} if kind == "removed bonds" else {kind: law}
        own, fresh = (
            tc.ensemble.network_transfer(
                network, times, config.n_shells, realizations=config.realizations, seed=seed, **settings
            )
            for seed in (config.seed, config.fresh_seed)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            warnings.simplefilter("ignore", PredictionWarning)
            master = tc.calibrate(own)
            predicted = master.solve(torch.eye(own.n_bands, dtype=torch.float64), own.times).detach()
        for found, values in ((model, predicted), (two, own.mean)):
            found.append(float((tc.total_variation(values, fresh.mean)[:, 1:] * share).sum(-1).mean()))
        numbers.append(master.n_parameters)
        names.append(master.calibration.model)
    return xarray.Dataset(
        {
            "distance": ("kind", model),
            "two": ("kind", two),
            "numbers": ("kind", numbers),
            "chosen": ("kind", names),
            "contacts": packing.n_contacts,
            "particles": packing.n_particles,
        },
        coords={"kind": list(KINDS)},
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 1, width=5, height=3.5)
    axis, place = axes[0, 0], np.arange(len(data.kind))
    axis.bar(place - 0.2, data.distance, 0.4, color="C0", label="calibrated model")
    axis.bar(place + 0.2, data.two, 0.4, color="0.7", hatch="//", label=f"two ensembles of {config.realizations}")
    axis.set_xticks(place, data.kind.values)
    axis.set(ylabel="total variation", ylim=(0, 1.4 * float(max(data.distance.max(), data.two.max()))))
    axis.set_title(f"{int(data.particles)} disks, {int(data.contacts)} contacts, 0 < $t$ ≤ {config.stop:g}")
    axis.legend(fontsize="small")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for kind in data.kind.values:
        line = data.sel(kind=kind)
        note = f"two ensembles {float(line.two):.4f}, {line.chosen.item()} of {int(line.numbers)} numbers"
        rows.append(Row(f"{kind}: chosen model", float(line.distance), note=note))
        rows.append(Row("    over two ensembles", float(line.distance / line.two)))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"Total variation from {config.realizations} fresh realizations of one packing, mean over sources and, evenly, over time. "
        "Its contacts are the same in all; masses, stiffnesses or the bonds that are left differ."
    )


SCRIPT = harness.Script("network_packings", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: Sequence[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
