"""How often error bars hold: energies of fresh ensembles within one standard error of a model, by window of time, beside another ensemble."""

from __future__ import annotations

import sys
import warnings
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain.ensemble.scene_file import regular_times
from torchchain.master import PredictionWarning
from torchchain.master.fits import FitWarning

WINDOWS = ((0.0, 1.0), (1.0, 5.0), (5.0, 50.0), (50.0, 400.0))
"""First time, which is not in it, and last."""
PARTS = ("source's own band", "other bands", "mixtures of bands")
WANTED = (0.60, 0.76)
NORMAL = 0.683
"""Of normal errors."""


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """Ensembles of every disorder: a model of each, compared with all others."""

    seed: int = 10
    """of the first ensemble; nothing in the library was chosen on those from 10 on"""
    ensembles: int = 12
    """of each disorder"""
    strengths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.5)
    """disorders xi"""
    stop: float = 400.0
    """last time"""
    mixtures: int = 16
    """random starts over several bands"""


SMOKE = Config(n_particles=32, n_bands=4, realizations=16, ensembles=3, strengths=(0.2, 0.3), stop=60.0, mixtures=4)


def times_of(stop: float) -> Tensor:
    """Times to ``stop``, close ones at first."""
    parts = (regular_times(0.0, 5.0, 0.2), regular_times(6.0, 50.0, 1.0), regular_times(55.0, 400.0, 5.0))
    every = torch.cat(parts)
    return every[every <= stop]


def windows(times: Tensor) -> list[Tensor]:
    """Which of the times lie in each window."""
    return [(times > low) & (times <= high) for low, high in WINDOWS]


def within(found: Tensor, error: Tensor, mean: Tensor, stderr: Tensor, times: Tensor) -> Tensor:
    """Share of energies [source, time, receiver] within one standard error of both, (own or others, window)."""
    inside = ((found - mean).square() <= error.square() + stderr.square()).double()
    own = torch.eye(len(mean), dtype=torch.bool)[:, None]
    parts = []
    for here in windows(times):
        part = inside[:, here]
        mask = own.expand_as(part)
        parts.append(torch.stack([part[mask].mean(), part[~mask].mean()]))
    return torch.stack(parts, -1)


def over_pairs(values: Tensor, same: bool) -> tuple[Tensor, Tensor]:
    """Mean over pairs (one, other, ...) and its standard error by leaving out one ensemble at a time.

    Energies of an ensemble err alike, so that pairs are not independent and energies less so.

    Args:
        values: of each pair.
        same: one and other are the same ensembles, and none is a pair with itself.
    """
    rows, columns = values.shape[:2]
    weight = torch.ones(rows, columns, dtype=values.dtype) - (torch.eye(rows, dtype=values.dtype) if same else 0)

    def mean(weight: Tensor) -> Tensor:
        return torch.einsum("ij,ij...->...", weight / weight.sum(), values)

    def spread(left_out: list[Tensor]) -> Tensor:
        found = torch.stack(left_out)
        return (len(found) - 1) * found.var(0, correction=0)

    def without(row: int | None, column: int | None) -> Tensor:
        kept = weight.clone()
        if row is not None:
            kept[row] = 0
        if column is not None:
            kept[:, column] = 0
        return mean(kept)

    if same:
        return mean(weight), spread([without(i, i) for i in range(rows)]).sqrt()
    by_rows, by_columns = (
        spread([without(i, None) for i in range(rows)]),
        spread([without(None, j) for j in range(columns)]),
    )
    return mean(weight), (by_rows + by_columns).sqrt()


def distance(found: Tensor, other: Tensor, times: Tensor) -> Tensor:
    """Mean total variation in each window, (window,)."""
    off = tc.total_variation(found, other).mean(0)
    return torch.stack([off[here].mean() for here in windows(times)])


def of_mixtures(transfer: tc.BandTransfer, starts: Tensor) -> tuple[Tensor, Tensor]:
    """Energies of an ensemble after starts (start, band), and their standard errors, [start, time, receiver].

    Energies from several bands of a chain are not independent: the errors are those of blocks of chains.
    """
    weight = torch.tensor(transfer.block_counts, dtype=torch.float64)[:, None, None, None] / sum(transfer.block_counts)
    blocks = torch.einsum("ms,bstr->bmtr", starts, transfer.block_mean.double())
    mean = torch.einsum("ms,str->mtr", starts, transfer.mean)
    return mean, ((weight * (blocks - mean).square()).sum(0) / (len(blocks) - 1)).sqrt()


@dataclass(frozen=True, eq=False)
class Measured:
    """An ensemble and its model: energies and errors from every band, and of mixtures of bands."""

    mean: Tensor
    stderr: Tensor
    found: Tensor
    error: Tensor
    mixed: tuple[Tensor, Tensor, Tensor, Tensor]


def measured(scene: tc.Scene, starts: Tensor, device: str) -> Measured:
    """Of one ensemble.

    Args:
        scene: of the chains.
        starts: mixtures (start, band) of unit energy.
        device: of the ensemble.
    """
    own = tc.band_transfer(scene, starts=False, device=device)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        warnings.simplefilter("ignore", PredictionWarning)
        master = tc.calibrate(own)
        eye = torch.eye(own.n_bands, dtype=torch.float64)
        found, mixed = (master.solve(each, own.times).detach() for each in (eye, starts))
    return Measured(
        own.mean, own.stderr, found, master.standard_error(eye, own.times),
        (mixed, master.standard_error(starts, own.times), *of_mixtures(own, starts)),
    )  # fmt: skip


def measure(config: Config, device: str) -> xarray.Dataset:
    times = times_of(config.stop)
    torch.manual_seed(0)
    starts = torch.rand(config.mixtures, config.n_bands, dtype=torch.float64) ** 8
    starts = starts / starts.sum(-1, keepdim=True)
    entries = []
    for strength in config.strengths:
        scenes = [config.scene(strength, seed=config.seed + i, times=times) for i in range(config.ensembles)]
        every = [measured(scene, starts, device) for scene in scenes]
        inside = torch.zeros(2, len(every), len(every), len(PARTS), len(WINDOWS), dtype=torch.float64)
        for i, one in enumerate(every):
            for j, other in enumerate(every):
                for kind, (found, error) in enumerate(((one.found, one.error), (one.mean, one.stderr))):
                    inside[kind, i, j, :2] = within(found, error, other.mean, other.stderr, times)
                both = ((one.mixed[0], one.mixed[1]), (one.mixed[2], one.mixed[3]))
                for kind, (found, error) in enumerate(both):
                    held = (found - other.mixed[2]).square() <= error.square() + other.mixed[3].square()
                    inside[kind, i, j, 2] = torch.stack([held[:, here].double().mean() for here in windows(times)])
        total = torch.stack([each.mean for each in every]).sum(0)
        off = torch.zeros(2, len(every), len(WINDOWS), dtype=torch.float64)
        for i, one in enumerate(every):
            rest = (total - one.mean) / (len(every) - 1)
            off[:, i] = torch.stack([distance(each, rest, times) for each in (one.found, one.mean)])
        shares, errors = zip(*(over_pairs(each, True) for each in inside), strict=True)
        entries.append((torch.stack(shares), torch.stack(errors), off[0].mean(0) / off[1].mean(0)))
    axes = ("strength", "predicted_by", "part", "window")
    share, error, ratio = (torch.stack(each).numpy() for each in zip(*entries, strict=True))
    return xarray.Dataset(
        {"within": (axes, share), "within_stderr": (axes, error), "distance": (("strength", "window"), ratio)},
        coords={"strength": list(config.strengths), "predicted_by": ["model", "another ensemble"], "part": list(PARTS)},
    )


def window_names() -> list[str]:
    return [f"{low:g} to {high:g}" for low, high in WINDOWS]


def draw_shares(ax: Axes, shares: xarray.DataArray, errors: xarray.DataArray, other: xarray.DataArray) -> None:
    """Shares (strength, window) with the error of each, and those of another ensemble, open."""
    ax.axhspan(*WANTED, color="0.9", label="wanted")
    ax.axhline(NORMAL, color="k", lw=0.8, ls=":")
    ax.plot([], [], "k_", ms=7, label="two ensembles")
    count = shares.sizes["strength"]
    for i, strength in enumerate(shares.strength.values):
        place = np.arange(len(WINDOWS)) + 0.1 * (i - (count - 1) / 2)
        color = f"C{i}"
        ax.errorbar(place, shares[i], errors[i], fmt="o", ms=4, color=color, label=rf"$\xi$ = {strength:g}")
        ax.plot(place, other[i], "_", color=color, ms=7)
    ax.set_xticks(range(len(WINDOWS)), window_names())
    ax.set(xlabel="time", ylabel="energies within one error", ylim=(0.4, 1.0))


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, len(PARTS), width=4.8, height=4.4)
    for ax, part, letter in zip(axes[0], PARTS, "abc", strict=True):
        here = data.sel(part=part)
        model, other = (here.sel(predicted_by=name) for name in ("model", "another ensemble"))
        draw_shares(ax, model.within, model.within_stderr, other.within)
        ax.set_title(f"({letter}) {part}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6)
    return figure


def cells(shares: xarray.DataArray, errors: xarray.DataArray, other: xarray.DataArray) -> str:
    """Shares by window in words, with their errors and those of another ensemble."""
    return "; ".join(
        f"{name}: {100 * float(a):.0f} +- {100 * float(e):.0f} ({100 * float(b):.0f}) %"
        for name, a, e, b in zip(window_names(), shares, errors, other, strict=True)
    )


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for strength in data.strength.values:
        here = data.sel(strength=strength)
        words = ", ".join(f"{float(x):.2f}" for x in here.distance)
        rows.append(Row(f"xi {float(strength):g}, distance", float(here.distance.mean()), note=words))
        for part in PARTS:
            model, other = (here.sel(part=part, predicted_by=name) for name in ("model", "another ensemble"))
            note = cells(model.within, model.within_stderr, other.within)
            rows.append(Row(f"xi {float(strength):g}, {part}", float(model.within.mean()), note=note))
    return rows


def words(realizations: int) -> str:
    """What a share is."""
    return (
        f"Shares of the energies of a fresh ensemble of {realizations} chains within one standard error of both, mean over windows; then by window, with its standard\n"
        "error (by leaving out one ensemble at a time) and, in brackets, the share of an ensemble's energies within one error of another. Energies of the source's own\n"
        "band err alike for all sources of an ensemble, and at all early times: of one pair of ensembles nearly all lie within one error, or few."
    )


def verdict(data: xarray.Dataset, name: str) -> str:
    """How many shares are as wanted."""
    found, other = (data.within.sel(predicted_by=each).values for each in (name, "another ensemble"))
    off = np.abs(found - np.clip(found, *WANTED))
    near = off <= data.within_stderr.sel(predicted_by=name).values
    wanted = f"{100 * WANTED[0]:.0f} to {100 * WANTED[1]:.0f} %"
    return (
        f"In the wanted {wanted}: {int((off == 0).sum())} of {found.size} shares, {int(near.sum())} within their standard error;\n"
        f"lowest {100 * np.nanmin(found):.0f}, highest {100 * np.nanmax(found):.0f} %; of ensembles {100 * np.nanmin(other):.0f} to {100 * np.nanmax(other):.0f} %."
    )


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"Distances: total variation from all other ensembles (N = {config.n_particles}, {config.n_bands} bands, masses: {config.kind}), of a model over that of the ensemble it was calibrated on,\n"
        f"mean over windows and by window ({', '.join(window_names())}).\n{words(config.realizations)}\n"
        f"Over all pairs of {config.ensembles} ensembles from seed {config.seed} on. {verdict(data, 'model')}"
    )


SCRIPT = harness.Script("error_bars", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
