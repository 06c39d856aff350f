"""Families of models on fresh chains of disorders that none of their members has: distance and error bars, by window of time."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import error_bars
import harness
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc

PARTS = error_bars.PARTS[:2]
APART = 100
"""Between the seeds of families, of members and of fresh chains."""


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """Families, each of ensembles of its own, and fresh ensembles as large as those of the members."""

    seed: int = 10
    """of the first family's members; weights and degrees of families were chosen on the ensembles of seed 0"""
    families: int = 6
    """of the same strengths"""
    members: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.5)
    """disorders xi of the members"""
    strengths: tuple[float, ...] = (0.02, 0.035, 0.07, 0.14, 0.25, 0.4)
    """disorders that no member has"""
    fresh: int = 8
    """ensembles of each of these"""
    stop: float = 400.0
    """last time"""


SMOKE = Config(
    n_particles=32, n_bands=4, realizations=16, families=2, fresh=3, members=(0.1, 0.2, 0.4), strengths=(0.05, 0.3), stop=60.0
)  # fmt: skip


def measure(config: Config, device: str) -> xarray.Dataset:
    times = error_bars.times_of(config.stop)

    def ensemble(strength: float, seed: int) -> tc.BandTransfer:
        return tc.band_transfer(config.scene(strength, seed=seed, times=times), starts=False, device=device)

    families = [
        tc.calibrate_family([ensemble(strength, config.seed + APART * i) for strength in config.members])
        for i in range(config.families)
    ]
    eye, entries = torch.eye(config.n_bands, dtype=torch.float64), []
    for strength in config.strengths:
        first = config.seed + APART * config.families
        fresh = [
            (each.mean, each.stderr) for each in (ensemble(strength, first + APART * j) for j in range(config.fresh))
        ]
        masters = [family.at(strength) for family in families]
        told = [(master.transfer(times).detach(), master.standard_error(eye, times)) for master in masters]
        shares = []
        for ones, same in ((told, False), (fresh, True)):
            inside = torch.stack(
                [torch.stack([error_bars.within(*one, *other, times) for other in fresh]) for one in ones]
            )
            shares.append(error_bars.over_pairs(inside, same))
        total = torch.stack([mean for mean, _ in fresh]).sum(0)
        rest = [(total - mean) / (len(fresh) - 1) for mean, _ in fresh]
        off = torch.stack([error_bars.distance(found, each, times) for found, _ in told for each in rest])
        noise = torch.stack(
            [error_bars.distance(mean, each, times) for (mean, _), each in zip(fresh, rest, strict=True)]
        )
        share, error = (torch.stack(each) for each in zip(*shares, strict=True))
        entries.append((share, error, off.mean(0) / noise.mean(0)))
    axes = ("strength", "predicted_by", "part", "window")
    share, error, ratio = (torch.stack(each).numpy() for each in zip(*entries, strict=True))
    return xarray.Dataset(
        {"within": (axes, share), "within_stderr": (axes, error), "distance": (("strength", "window"), ratio)},
        coords={
            "strength": list(config.strengths),
            "predicted_by": ["family", "another ensemble"],
            "part": list(PARTS),
        },
        attrs={"parameters": families[0].n_parameters},
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 3, width=4.8, height=4.4)
    for i, ratios in enumerate(data.distance):
        axes[0, 0].plot(range(len(error_bars.WINDOWS)), ratios, "o-", ms=4, color=f"C{i}")
    axes[0, 0].axhline(1.0, color="k", lw=0.8, ls=":")
    axes[0, 0].set_xticks(range(len(error_bars.WINDOWS)), error_bars.window_names())
    axes[0, 0].set(xlabel="time", ylabel="distance over that of an ensemble", title="(a) distance", ylim=(0, None))
    for ax, part, letter in zip(axes[0, 1:], PARTS, "bc", strict=True):
        here = data.sel(part=part)
        family, other = (here.sel(predicted_by=name) for name in ("family", "another ensemble"))
        error_bars.draw_shares(ax, family.within, family.within_stderr, other.within)
        ax.set_title(f"({letter}) {part}")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7)
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for strength in data.strength.values:
        here = data.sel(strength=strength)
        words = ", ".join(f"{float(x):.2f}" for x in here.distance)
        rows.append(Row(f"xi {float(strength):g}, distance", float(here.distance.mean()), note=words))
        for part in PARTS:
            family, other = (here.sel(part=part, predicted_by=name) for name in ("family", "another ensemble"))
            rows.append(
                Row(
                    f"xi {float(strength):g}, {part}", float(family.within.mean()),
                    note=error_bars.cells(family.within, family.within_stderr, other.within),
                )
            )  # fmt: skip
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"Distances: total variation of families of {len(config.members)} ensembles ({', '.join(f'{xi:g}' for xi in config.members)}; {config.realizations} chains each, {data.attrs['parameters']} fitted numbers) from fresh\n"
        f"ensembles of disorders that no member has, over that of one such ensemble from the others, mean over windows and by window ({', '.join(error_bars.window_names())}).\n"
        f"{error_bars.words(config.realizations)}\n"
        f"Over all pairs of {config.families} families and {config.fresh} fresh ensembles. {error_bars.verdict(data, 'family')}"
    )


SCRIPT = harness.Script("family_windows", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
