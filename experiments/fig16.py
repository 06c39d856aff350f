"""Fig. 16: loss rates -Q_ss of every band for six disorders, by (a) the linear and (b) the nonlinear fit.

Symbols are the direct fits, lines the normalization -Q_ss = sum of Q_sr over r (Eq. 48).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain.master.fits import linear_rates, nonlinear_rates


@dataclass(frozen=True)
class Config(Ensemble):
    strengths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
    """disorders xi"""
    stop: float = 5.0
    linear_window: tuple[float, float] = (0.5, 2.0)
    """L: 2 to 8 steps of 0.25"""
    receiver_window: tuple[float, float] = (0.75, 2.25)
    """one step later, for the receivers alone: what two windows do to the normalization"""
    nonlinear_window: tuple[float, float] = (0.5, 4.5)
    """NL: 2 to 18 steps of 0.25"""
    first_band: int = 5
    """the table leaves out the lowest bands, which lose next to nothing"""
    groups: int = 5
    """groups of realizations left out in turn for the errors of NL"""


SMOKE = Config(n_bands=16, realizations=4, strengths=(0.1, 0.3), groups=2)
PROCEDURES = ("L", "L, receivers later", "NL")


def measure(config: Config, device: str) -> xarray.Dataset:
    parts = [measure_strength(config, xi, device) for xi in config.strengths]
    return xarray.concat(parts, xarray.Variable("strength", list(config.strengths)), combine_attrs="drop")


def measure_strength(config: Config, strength: float, device: str) -> xarray.Dataset:
    transfer = tc.band_transfer(config.scene(strength), long_time=False, device=device)
    free = 1 - tc.basis_fraction(strength, config.n_bands)
    value, error = [], []
    for procedure in PROCEDURES:
        fit = partial(_losses, procedure, transfer.times, free, config)
        groups = config.groups if procedure == "NL" else None
        for part, into in zip(harness.jackknife(transfer.block_mean, transfer.block_counts, fit, groups), (value, error),
                              strict=True):  # fmt: skip
            into.append(part.numpy())
    converged = nonlinear_rates(transfer.times, transfer.mean, free, config.nonlinear_window)[1]
    quantities = ("direct", "normalization", "typical", "largest")
    axes = ("procedure", "quantity", "band")
    return xarray.Dataset(
        {
            "loss": (axes, np.stack(value), harness.RATE),
            "loss_stderr": (axes, np.stack(error), harness.RATE),
            "converged": ("band", converged.diagonal().numpy()),
            "pairs_converged": float(converged.double().mean()),
            "mass_sd": transfer.attributes["mass_sd"],
        },
        coords={
            "procedure": list(PROCEDURES),
            "quantity": list(quantities),
            "band": np.arange(1, config.n_bands + 1),
        },
    )


def _losses(procedure: str, times: Tensor, free: Tensor, config: Config, mean: Tensor) -> Tensor:
    """-Q_ss, the sum of Q_sr, and the typical and the largest gap between them relative to -Q_ss, [quantity, band]."""
    rates = linear_rates(times, mean, free, config.linear_window)
    loss = -rates.diagonal()
    if procedure == "L, receivers later":
        rates = linear_rates(times, mean, free, config.receiver_window)
    elif procedure == "NL":
        fitted, converged, _ = nonlinear_rates(times, mean, free, config.nonlinear_window)
        rates = torch.where(converged, fitted, linear_rates(times, mean, free, config.nonlinear_window))
        loss = -rates.diagonal()
    total = rates.sum(-1) - rates.diagonal()
    gap = ((total - loss) / loss).abs()[config.first_band - 1 :]
    return torch.stack([loss, total, gap.median().expand_as(loss), gap.max().expand_as(loss)])


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2, width=5.2, height=4.2)
    for ax, procedure, title in zip(axes[0], ("L", "NL"), ("(a) linear fit", "(b) nonlinear fit"), strict=True):
        _panel(ax, data.sel(procedure=procedure), procedure, config)
        ax.set_title(title)
    axes[0, 1].legend(fontsize="small", loc="center left", bbox_to_anchor=(1.02, 0.5))
    figure.suptitle(
        "symbols: direct fit, open where it did not converge; lines: normalization $\\sum_{r \\neq s} Q_{sr}$"
    )
    return figure


def _panel(ax: Axes, data: xarray.Dataset, procedure: str, config: Config) -> None:
    band = data.band.values
    for i, (xi, marker) in enumerate(zip(config.strengths, "os^vDP*X<>" * 9, strict=False)):
        part = data.isel(strength=i)
        loss, error = part.loss.sel(quantity="direct").values, part.loss_stderr.sel(quantity="direct").values
        good = part.converged.values if procedure == "NL" else np.ones(len(band), dtype=bool)
        ax.plot(band, part.loss.sel(quantity="normalization"), color=f"C{i}", linewidth=1)
        ax.errorbar(band[good], loss[good], error[good], fmt=marker, color=f"C{i}", markersize=4, linewidth=1,
                    label=f"$\\xi$ = {xi:g}")  # fmt: skip
        ax.plot(band[~good], loss[~good], marker, color=f"C{i}", markersize=4, markerfacecolor="none")
    ax.set(xlabel="source band s", ylabel="loss rate $-Q_{ss}$", ylim=(0, None))


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for procedure in PROCEDURES:
        for i, xi in enumerate(config.strengths):
            part = data.isel(strength=i, band=0).sel(procedure=procedure)
            gap, worst = (float(part.loss.sel(quantity=name)) for name in ("typical", "largest"))
            rows.append(
                Row(
                    f"{procedure}, xi = {xi:g}: gap, median over bands",
                    gap,
                    float(part.loss_stderr.sel(quantity="typical")),
                    note=f"paper: 0.05 to 0.10; worst band {worst:.2f}",
                )
            )
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    share = ", ".join(f"{float(x):.0%}" for x in data.pairs_converged)
    sd = ", ".join(f"{float(x):.3f}" for x in data.mass_sd)
    return (
        "gap: |sum of Q_sr - (-Q_ss)| / (-Q_ss).\n"
        "L in one common window is linear in energies that sum to 1 at every time: its rows sum to zero exactly, and line and\n"
        "symbols of (a) coincide. The paper's gap of 5 to 10 % must come from fit ranges that differ between source and\n"
        "receivers, as Section 4.4 says they should: already one step of 0.25 later for the receivers leaves 5 to 20 %. NL\n"
        "fits every pair alone and conserves nothing: its gap has the paper's size, but for low bands it is far larger. It\n"
        "often finds no saturation in a curve that is straight or still swinging in: of all pairs, at xi = "
        f"{', '.join(f'{xi:g}' for xi in config.strengths)},\n"
        f"{share} converge; the rest keep the slope of a straight line in the NL window.\n"
        f"Masses below 0.05 are drawn again; realized standard deviations: {sd}."
    )


SCRIPT = harness.Script("fig16", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
