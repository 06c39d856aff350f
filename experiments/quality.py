"""The quality claim of the README: how far every model, the theory and smaller ensembles are from chains that none has seen.

Calibrated on one ensemble, scored on a larger one of another seed: mean total variation, the share of the energy that is in
the wrong band, over all sources and times t > 0.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import harness
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.figure import Figure

import torchchain as tc

MODELS: dict[str, dict[str, Any]] = {
    "Eq. 50": {"model": "paper", "method": "analytic"},
    "procedure L": {"model": "paper", "method": "linear"},
    "exact_psi": {"model": "exact_psi", "method": "linear"},
    "basis_matrix": {"model": "basis_matrix", "method": "linear"},
    "swing_in": {"model": "swing_in", "method": "linear"},
    "memory": {"model": "memory"},
    "chosen": {},
}
"""By their names in the figure: the paper's two, the rungs of the ladder, and what calibrate chooses."""
MARKERS = "os^vDP*"


@dataclass(frozen=True)
class Config(Ensemble):
    strength: float = 0.3
    """disorder xi"""
    fresh_seed: int = 1
    """seed of the chains that nothing was calibrated on"""
    fresh_realizations: int = 400
    """how many of them"""
    sizes: tuple[int, ...] = (1, 3, 10, 30, 100)
    """ensembles of chains to compare with; the last is the one that models are calibrated on"""
    repeats: int = 5
    """timings of a prediction, of which the median counts"""


SMOKE = Config(n_particles=32, n_bands=4, realizations=8, fresh_realizations=16, sizes=(2, 8), stop=5.0, repeats=1)


def measure(config: Config, device: str) -> xarray.Dataset:
    scene = replace(config, realizations=config.sizes[-1]).scene(config.strength)
    tc.band_transfer(replace(scene, realizations=1), device=device)  # loads the kernels
    fresh = tc.band_transfer(
        replace(scene, seed=config.fresh_seed, realizations=config.fresh_realizations), device=device
    )

    def entry(
        name: str, energy: torch.Tensor, numbers: int, seconds: float, calibration: float = 0.0
    ) -> dict[str, Any]:
        off = tc.total_variation(energy.detach(), fresh.mean)[:, fresh.times > 0]
        return {
            "name": name,
            "error": float(off.mean()),
            "numbers": numbers,
            "seconds": seconds,
            "calibration": calibration,
        }

    rows, own = [], fresh
    for size in config.sizes:
        own, seconds = timed(
            lambda size=size: tc.band_transfer(replace(scene, realizations=size), device=device, long_time=False)
        )
        rows.append(entry(f"{size} chains", own.mean, 0, seconds))
    own = tc.band_transfer(scene, device=device)
    found, seconds = timed(lambda: tc.band_transfer(scene, method="theory"))
    rows.append(entry("theory", found.mean, 0, seconds))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, settings in MODELS.items():
            master, calibration = timed(lambda settings=settings: tc.calibrate(own, bootstrap=0, **settings))
            new = [own.times + 1e-6 * (i + 1) for i in range(config.repeats)]  # what was asked for before may be kept
            spent = sorted(timed(lambda t=t, master=master: master.transfer(t))[1] for t in new)
            row = entry(name, master.transfer(own.times), master.n_parameters, spent[len(spent) // 2], calibration)
            rows.append(row | {"name": f"{name}: {master.calibration.model}" if name == "chosen" else name})
    return xarray.Dataset(
        {key: ("way", [row[key] for row in rows]) for key in rows[0]}, attrs={"threads": torch.get_num_threads()}
    )


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """What a run gives, and its processor time."""
    began = time.process_time()
    found = run()
    return found, time.process_time() - began


def parts(data: xarray.Dataset) -> tuple[xarray.Dataset, xarray.Dataset, xarray.Dataset]:
    """Ensembles, theory, models."""
    chains = [str(name).endswith("chains") for name in data.name.values]
    theory = [str(name) == "theory" for name in data.name.values]
    neither = [not (a or b) for a, b in zip(chains, theory, strict=True)]
    return data.isel(way=chains), data.isel(way=theory), data.isel(way=neither)


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2, width=4.8, height=4.0)
    chains, theory, models = parts(data)
    own = float(chains.error[-1])
    left, right = axes[0]
    for ax, x in ((left, models.numbers), (right, models.seconds)):
        for i, marker in zip(range(models.sizes["way"]), MARKERS, strict=True):
            name = str(models.name.values[i])
            size, face = (9, "#e69f00") if name.startswith("chosen") else (5, "none")
            ax.plot(float(x[i]), float(models.error[i]), marker, color="k", mfc=face, ms=size, label=name)
        ax.set(xscale="log", yscale="log", ylabel="total variation from fresh chains")
        ax.set_yticks((0.01, 0.03, 0.1, 0.3), ("0.01", "0.03", "0.1", "0.3"))
        ax.minorticks_off()
    left.axhline(own, color="0.4", ls=":", label=f"the {config.sizes[-1]} chains themselves")
    left.set(xlabel="fitted numbers", title="(a)")
    right.plot(chains.seconds, chains.error, "-x", color="#0072b2", label=f"{', '.join(map(str, config.sizes))} chains")
    right.plot(theory.seconds, theory.error, "h", color="#d55e00", ms=6, label="theory, no chains")
    right.set(xlabel="processor seconds, once calibrated", title="(b)")
    handles = {label: handle for ax in axes[0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    return [
        Row(
            str(data.name.values[i]), float(data.error[i]),
            note=f"{int(data.numbers[i])} numbers, {float(data.seconds[i]):.2g} s, calibration {float(data.calibration[i]):.2g} s",
        )
        for i in range(data.sizes["way"])
    ]  # fmt: skip


def explain(data: xarray.Dataset, config: Config) -> str:
    chains, _, models = parts(data)
    own, chosen = chains.isel(way=-1), models.isel(way=-1)
    return (
        f"Mean total variation from {config.fresh_realizations} fresh chains over 0 < t <= {config.stop:g}: {float(chosen.error):.4f} for the model that calibrate\n"
        f"chooses ({int(chosen.numbers)} numbers), {float(own.error):.4f} for the {config.sizes[-1]} chains it was calibrated on, {float(models.error[1]):.2f} for the paper's (procedure L).\n"
        f"A prediction takes 1 / {float(own.seconds / chosen.seconds):.0f} of the processor time of these chains."
    )


SCRIPT = harness.Script("quality", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
