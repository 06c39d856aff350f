"""Decay of plane waves in square and triangular lattices with mass disorder against the golden rule of Born and Tamura."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import network as nw
from torchchain.chain import State

CASES = ("square scalar", "triangular longitudinal", "triangular transverse")


@dataclass(frozen=True)
class Config:
    """Lattices, disorder and waves."""

    seed: int = 0
    """seed of the masses"""
    size: int = 320
    """particles along each direction"""
    realizations: int = 2
    """lattices of each disorder; each carries waves along every bond, sine and cosine"""
    strengths: tuple[float, ...] = (0.1, 0.2)
    """disorders xi, of uniformly distributed masses"""
    square_scalar: tuple[float, ...] = (0.1, 0.12, 0.145, 0.17, 0.2, 0.23)
    """wavelengths per spacing of the waves along an axis"""
    triangular_longitudinal: tuple[float, ...] = (0.08125, 0.0875, 0.1, 0.10625, 0.11875, 0.13125)
    """the same along a bond"""
    triangular_transverse: tuple[float, ...] = (0.11, 0.13, 0.155, 0.18, 0.21, 0.25)
    """the same along a bond"""
    weak: float = 0.15
    """below this disorder the waves are shorter: in lines so narrow that few modes of the lattice lie in them, nothing decays"""
    square_scalar_weak: tuple[float, ...] = (0.145, 0.165, 0.19, 0.215, 0.245, 0.275)
    """wavelengths per spacing at weak disorder"""
    triangular_longitudinal_weak: tuple[float, ...] = (0.1, 0.10625, 0.1125, 0.11875, 0.13125, 0.1375)
    """the same along a bond"""
    triangular_transverse_weak: tuple[float, ...] = (0.175, 0.1875, 0.2, 0.2125, 0.225, 0.24375)
    """the same along a bond"""
    begin: float = 0.1
    """the slope is taken from this share of a decay time on"""
    end: float = 1.0
    """and up to this one"""
    grid: int = 1200
    """points of the grid behind the density of states"""


SMOKE = Config(
    size=32, realizations=1, strengths=(0.2,), square_scalar=(0.2, 0.25), triangular_longitudinal=(0.15, 0.2),
    triangular_transverse=(0.2, 0.25), grid=100,
)  # fmt: skip


def turns_of(kind: str, m: int) -> list[tuple[int, int]]:
    """Waves of one length along every bond: q along a bond fits a ring along both primitive directions."""
    return [(m, 0), (0, m)] if kind == "square" else [(2 * m, m), (-m, -2 * m), (m, -m)]


def decay(config: Config, case: str, share: float, xi: float) -> tuple[float, float, float, float, float]:
    """|q|, w, the rate of Born, the measured rate and its standard error over the waves."""
    kind, polarization = case.split()
    ordered = nw.lattice(kind, (config.size, config.size), "scalar" if polarization == "scalar" else "vector")
    m = round(share * config.size / (1 if kind == "square" else 2))
    turns = turns_of(kind, m)
    where = nw.zone(ordered)
    index = (turns[0][0] % config.size) * config.size + turns[0][1] % config.size
    q = float(where.lengths[index])
    waves = torch.cat(
        [
            nw.plane_wave(ordered, t, polarization, 1.0, phase).displacement[None]
            for t in turns
            for phase in ("sin", "cos")
        ]
    )
    force = -(ordered.force(waves) * waves).sum((-2, -1)) / waves.square().sum((-2, -1))
    w = float(force.mean().sqrt())
    born = float(nw.born_rate(ordered, [w], xi, points=config.grid)[0])
    times = torch.linspace(config.begin, config.end, 24, dtype=torch.float64) / born
    dual = waves / waves.square().sum((-2, -1), keepdim=True)
    envelope = []
    for realization in range(config.realizations):
        disorder = tc.Disorder(kind="uniform", strength=xi)
        network = nw.disordered(ordered, disorder, realizations=[realization], seed=config.seed)
        for wave, one in zip(waves, dual, strict=True):
            path = nw.evolve(
                network, State(wave[None], torch.zeros_like(wave)[None]), times, "chebyshev", accuracy=1e-8
            )
            along, speed = ((x * one).sum((-2, -1))[0] for x in (path.displacement, path.velocity))
            envelope.append(along.square() + speed.square() / w**2)
    energy = torch.stack(envelope)

    def slope(mean: torch.Tensor) -> float:
        return -float(np.polyfit(times.numpy(), mean.log().numpy(), 1)[0])

    rate, n = slope(energy.mean(0)), len(energy)
    left_out = np.array([slope(energy[torch.arange(n) != i].mean(0)) for i in range(n)])
    return q, w, born, rate, math.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum())


def measure(config: Config, device: str) -> xarray.Dataset:
    rows = []
    for c, case in enumerate(CASES):
        for xi in config.strengths:
            for share in getattr(config, case.replace(" ", "_") + ("_weak" if xi < config.weak else "")):
                q, w, born, rate, error = decay(config, case, share, xi)
                rows.append((c, xi, q, w, born, rate, error))
    names = ("case", "strength", "wavenumber", "frequency", "born", "rate", "rate_stderr")
    columns = np.array(rows).T
    return xarray.Dataset({name: ("wave", column) for name, column in zip(names, columns, strict=True)})


def each(data: xarray.Dataset, config: Config) -> list[tuple[str, float, xarray.Dataset]]:
    return [
        (case, xi, data.isel(wave=np.flatnonzero((data.case.values == c) & (data.strength.values == xi))))
        for c, case in enumerate(CASES)
        for xi in config.strengths
    ]


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    for (case, xi, part), color in zip(each(data, config), ("C0", "C1", "C2", "C3", "C4", "C5"), strict=False):
        left, right = axes[0]
        left.errorbar(part.wavenumber, part.rate, part.rate_stderr, fmt="o", color=color, label=f"{case}, $\\xi$ = {xi:g}")
        left.plot(part.wavenumber, part.born, color=color)
        right.errorbar(part.frequency, part.rate / part.born, part.rate_stderr / part.born, fmt="o-", color=color)
    axes[0, 0].set(xscale="log", yscale="log", xlabel="$|q|$", ylabel="decay rate of the energy")
    axes[0, 0].legend(fontsize=7)
    axes[0, 1].axhspan(0.9, 1.1, color="0.9")
    axes[0, 1].set(xlabel="frequency", ylabel="measured / Born", ylim=(0.7, 1.3))
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for case, xi, part in each(data, config):
        ratio, error = part.rate.values / part.born.values, part.rate_stderr.values / part.born.values
        for q, r, e in zip(part.wavenumber.values, ratio, error, strict=True):
            rows.append(Row(f"{case}, xi = {xi:g}, |q| = {q:.3f}: rate over Born's", r, e))
        exponent = np.polyfit(np.log(part.wavenumber.values), np.log(part.rate.values), 1)[0]
        born = np.polyfit(np.log(part.wavenumber.values), np.log(part.born.values), 1)[0]
        rows.append(Row(f"{case}, xi = {xi:g}: exponent of the rate in |q|", exponent, note=f"Born: {born:.2f}"))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    worst = float(np.abs(data.rate / data.born - 1).max())
    return f"The rates differ from (pi / 2) xi^2 w^2 g(w) by at most {100 * worst:.0f} %."


SCRIPT = harness.Script("network_born", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: Sequence[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
