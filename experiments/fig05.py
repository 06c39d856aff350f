"""Fig. 5: (a) energy of the kicked particle over time, (b) what is left of it at a late time against the disorder."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from fig02 import Kick, each_realization, mean_and_error
from fig04 import power_law, restored, stored
from harness import Row
from matplotlib.figure import Figure

from torchchain import plots


@dataclass(frozen=True)
class Config(Kick):
    strengths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
    """disorders xi"""
    early: float = 20.0
    """times up to here are a step of 1/8 apart, then 5 % apart"""
    late: tuple[float, ...] = (250.0, 500.0, 1000.0)
    """what is left is measured here: mean over 21 times in this +- 2 %"""
    shown: float = 500.0
    """the one that (b) shows"""


SMOKE = Config(n_particles=128, realizations=8, strengths=(0.1, 0.2, 0.3, 0.5), late=(40.0, 80.0), shown=80.0)


def around(late: float) -> np.ndarray:
    return late * np.linspace(0.98, 1.02, 21)


def instants(config: Config) -> np.ndarray:
    """All output times: an eighth apart at first, then evenly in log t, and evenly around each late time."""
    end = 1.02 * max(config.late)
    spread = np.geomspace(config.early, end, max(2, int(np.log(end / config.early) / 0.05)))
    return np.unique(np.concatenate([np.arange(0, config.early, 0.125), spread, *map(around, config.late)]))


def measure(config: Config, device: str) -> xarray.Dataset:
    times = instants(config)
    windows = [np.isin(times, around(late)) for late in config.late]
    means, errors, left = [], [], []
    for xi in (0.0, *config.strengths):
        scene = config.scene(xi, times, ("source_energy",))
        energy = each_realization(scene, config.method, device)["source_energy"] / config.initial_energy
        mean, error = mean_and_error(energy)
        means.append(mean)
        errors.append(error)
        if xi > 0:
            left.append(torch.stack([energy[:, torch.from_numpy(inside)].mean(-1) for inside in windows], dim=-1))
    residual = torch.stack(left, dim=1)  # (realization, strength, late)
    strengths = np.array(config.strengths)
    fits = [power_law(strengths, part, (strengths.min(), strengths.max())) for part in residual.unbind(-1)]
    mean, error = mean_and_error(residual)
    units = {"units": "energy of the kick"}
    return xarray.Dataset(
        {
            "energy": (("case", "time"), np.array(means), units | {"long_name": "mean energy of the kicked particle"}),
            "energy_stderr": (("case", "time"), np.array(errors), units),
            "residual": (("strength", "late"), mean, units | {"long_name": "mean energy left in the kicked particle"}),
            "residual_stderr": (("strength", "late"), error, units),
            **stored(fits, "late"),
        },
        coords={
            "case": [0.0, *config.strengths],
            "strength": list(config.strengths),
            "time": ("time", times, harness.TIME),
            "late": ("late", list(config.late), harness.TIME),
        },
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2, width=5.6, height=4.4)
    left, right = axes[0]
    for i, xi in enumerate(data.case.values):
        part = data.isel(case=i)
        color = "k" if xi == 0 else f"C{i - 1}"
        plots.curve(left, data.time.values, part.energy.values, part.energy_stderr.values, color=color, lw=0.9,
                    label=f"$\\xi$ = {xi:g}")  # fmt: skip
    left.set(xlabel=plots.TIME_LABEL, ylabel="mean energy / energy of kick", xscale="log", yscale="log",
             title=f"(a) particle {config.site}", xlim=(0.1, None), ylim=(1e-6, 2))  # fmt: skip
    left.legend(fontsize="small", loc="lower left")
    strengths = np.array(config.strengths)
    for j, (late, fit) in enumerate(zip(config.late, restored(data), strict=True)):
        part = data.isel(late=j)
        main = late == config.shown
        right.errorbar(strengths, part.residual.values, part.residual_stderr.values, fmt="o" if main else ".", capsize=3,
                       color="k" if main else f"C{j}", mfc="none", label=f"t = {late:g}, exponent {fit.exponent:.2f} $\\pm$ {fit.stderr:.2f}")  # fmt: skip
        if main:
            right.plot(strengths, fit(strengths), "k--", lw=0.8, label=f"power law at t = {late:g}")
    right.set(
        xlabel="disorder $\\xi$",
        ylabel="mean energy left / energy of the kick",
        xscale="log",
        yscale="log",
        title="(b)",
    )
    right.set_xticks(strengths, [f"{xi:g}" for xi in strengths])
    right.set_xticks([], minor=True)
    right.legend(fontsize="small")
    figure.suptitle(f"{config.realizations} chains, shaded and bars: standard error", fontsize="medium")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for j, (late, fit) in enumerate(zip(config.late, restored(data), strict=True)):
        for i, xi in enumerate(config.strengths):
            part = data.isel(strength=i, late=j)
            rows.append(
                Row(f"t = {late:g}, xi = {xi:g}: energy left", float(part.residual), float(part.residual_stderr))
            )
        rows += fit.rows(f"t = {late:g}: energy left ~ xi^a")[:1]
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    residual, error = data.residual.values, data.residual_stderr.values
    rising = "grows" if (np.diff(residual, axis=0) > 0).all() else "does not always grow"
    change = np.abs(residual[:, -1] / residual[:, 0] - 1)
    fit = restored(data)[config.late.index(config.shown)] if config.shown in config.late else restored(data)[-1]
    verdict = (
        f"not one power law: the slope falls from {fit.lower:.2f} to {fit.upper:.2f} as the disorder grows"
        if fit.bends
        else "a power law within the error"
    )
    return (
        f"The energy left in the kicked particle {rising} with the disorder, as the paper says, and is {verdict}.\n"
        f"It is at rest: from t = {config.late[0]:g} to {config.late[-1]:g} it changes by {100 * change.max():.1f} % at most, "
        f"where the error is {100 * (error / residual).max():.1f} %.\n"
        "For weak disorder it goes as one over the localization length, which is xi^2; for strong disorder the modes are a few particles\n"
        "long and get no shorter. The exponent belongs to its window."
    )


SCRIPT = harness.Script("fig05", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
