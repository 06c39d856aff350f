"""Band energies of scalar lattices from theory beside ensembles: how far the conserving ladder is, over time and disorder."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import harness
import numpy as np
import xarray
from harness import TIME, Row
from matplotlib.figure import Figure

import torchchain as tc


@dataclass(frozen=True)
class Config:
    """Two ensembles of every lattice, for their own distance."""

    seed: int = 0
    """seed of the first ensemble"""
    other_seed: int = 1
    """seed of the second"""
    lattices: tuple[str, ...] = ("square", "triangular")
    """kinds"""
    size: int = 24
    """particles along each direction"""
    n_bands: int = 8
    """shells of |q|"""
    realizations: int = 100
    """lattices of each ensemble"""
    strengths: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5)
    """disorders xi of the masses"""
    stop: float = 50.0
    """last time"""

    def scene(self, kind: str, strength: float, seed: int) -> tc.Scene:
        times = np.concatenate([np.arange(0, min(5.0, self.stop), 0.5), np.arange(5, self.stop + 0.5)])
        return tc.Scene(
            lattice=kind, shape=(self.size, self.size), motion="scalar", n_bands=self.n_bands, seed=seed,
            realizations=self.realizations, times=times.tolist(), disorder=tc.Disorder(strength=strength),
        )  # fmt: skip


SMOKE = Config(lattices=("square",), size=12, n_bands=4, realizations=6, strengths=(0.1, 0.4), stop=8.0)


def measure(config: Config, device: str) -> xarray.Dataset:
    """Total variation, mean over sources, [lattice, strength, time]: theory from the second ensemble, and both ensembles."""
    shape = (len(config.lattices), len(config.strengths))
    theory, ensembles, seconds, chains = [], [], np.zeros(shape), np.zeros(shape)
    for i, kind in enumerate(config.lattices):
        for j, strength in enumerate(config.strengths):
            began = time.process_time()
            one, two = (
                tc.band_transfer(config.scene(kind, strength, s), device=device, long_time=False)
                for s in (config.seed, config.other_seed)
            )
            chains[i, j] = (time.process_time() - began) / 2
            began = time.process_time()
            found = tc.band_transfer(config.scene(kind, strength, config.seed), method="theory")
            seconds[i, j] = time.process_time() - began
            theory.append(
                (tc.total_variation(found.mean, two.mean) + tc.total_variation(found.mean, one.mean)).mean(0) / 2
            )
            ensembles.append(tc.total_variation(one.mean, two.mean).mean(0))
    return xarray.Dataset(
        {
            "theory": (("lattice", "strength", "time"), np.reshape([x.numpy() for x in theory], (*shape, -1))),
            "ensembles": (("lattice", "strength", "time"), np.reshape([x.numpy() for x in ensembles], (*shape, -1))),
            "seconds": (("lattice", "strength"), seconds),
            "ensemble_seconds": (("lattice", "strength"), chains),
        },
        coords={
            "lattice": list(config.lattices),
            "strength": list(config.strengths),
            "time": ("time", one.times.numpy(), TIME),
        },
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, len(config.lattices))
    for axis, kind in zip(axes[0], data.lattice.values, strict=True):
        for i, strength in enumerate(data.strength.values):
            line = data.sel(lattice=kind, strength=strength).isel(time=slice(1, None))
            axis.plot(line.time, line.theory, color=f"C{i}", label=rf"$\xi$ = {strength:g}")
            axis.plot(line.time, line.ensembles, ".", ms=2.5, color=f"C{i}")
        axis.set(xscale="log", yscale="log", xlabel="t", ylabel="total variation", title=f"{kind}, scalar")
        axis.legend(fontsize="small", title="lines: theory; dots: two ensembles", title_fontsize="small")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    weight = data.time.diff("time", label="upper")
    for kind in data.lattice.values:
        for strength in data.strength.values:
            line = data.sel(lattice=kind, strength=strength)
            own, two = (float(line[name].weighted(weight).mean("time")) for name in ("theory", "ensembles"))
            note = (
                f"two ensembles {two:.4f}, largest at any time {float(line.theory.max()):.4f}, "
                f"{float(line.seconds):.2f} s against {float(line.ensemble_seconds):.1f} s"
            )
            rows.append(Row(f"{kind}, xi = {strength:g}: theory", own, note=note))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"Total variation from ensembles of {config.realizations} lattices, mean over sources and, evenly, over time; processor "
        "seconds. The ladder has no fitted number and leaves interference out."
    )


SCRIPT = harness.Script("network_theory", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: Sequence[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
