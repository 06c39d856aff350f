"""Bond updates per second of the network kernels beside sparse matrix products of SciPy and torch; a million unknowns to t = 100."""

from __future__ import annotations

import resource
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure
from stencil_rates import in_turn

import torchchain as tc
from torchchain import network as nw
from torchchain.chain import State
from torchchain.network import chebyshev, layouts

WAYS = ("scipy CSR", "scipy recursion", "torch CSR", "one field", "two fields")
"""The product alone, and with the recursion 2 x + w K x - T_k-2 around it as our steps have it; torch's product alone."""


@dataclass(frozen=True)
class Config:
    """Networks for the rates, and the long run."""

    seed: int = 0
    """seed of the masses"""
    triangular: tuple[int, ...] = (60, 250, 700)
    """particles along each direction of triangular lattices, and of the same with moved particles"""
    fcc: tuple[int, ...] = (60,)
    """of fcc lattices"""
    packings: tuple[int, ...] = (60, 250, 700)
    """disks along each direction of packings, in both motions"""
    strength: float = 0.1
    """disorder xi of the masses"""
    repeats: int = 7
    """timed runs of each way, after one that is not counted"""
    threads: int = 1
    """of torch and of the kernels; SciPy's products have one"""
    size: int = 700
    """of the lattice of the long run"""
    stop: float = 100.0
    """its end"""


SMOKE = Config(triangular=(20,), fcc=(6,), packings=(20,), repeats=2, size=40, stop=5.0)


def networks(config: Config) -> list[tuple[str, nw.Network]]:
    """Lattices by rows, and the same with moved particles, which are gathered like any packing."""
    made: list[tuple[str, nw.Network]] = []
    for kind, sizes in (("triangular", config.triangular), ("fcc", config.fcc)):
        for size in sizes:
            ordered = nw.lattice(kind, (size,) * (2 if kind == "triangular" else 3))
            masses = tc.Disorder(strength=config.strength).masses(ordered.n_particles, 1, config.seed)[0]
            ordered = replace(ordered, masses=masses)
            made += [(f"{kind} lattice", ordered), (f"{kind}, moved", nw.displaced(ordered, 0.02, seed=config.seed))]
    for size in config.packings:
        grid = nw.displaced(nw.lattice("square", (size, size)), 0.35, seed=config.seed)
        radii = torch.full((grid.n_particles,), 0.62, dtype=torch.float64)
        disks = tc.packing(grid.positions, radii, grid.masses, [float(size)] * 2, prestress=False)
        made += [("packing", disks), ("packing, scalar", replace(disks, motion="scalar"))]
    return made


def ways(network: nw.Network, config: Config, products: int) -> dict[str, Callable[[], Any]]:
    """Some products or Chebyshev steps each."""
    matrix = network.sparse_stiffness()
    n, c = network.n_particles, network.n_components
    rng = np.random.default_rng(config.seed)
    x = rng.standard_normal(n * c)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch calls its sparse matrices a beta
        theirs = torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int64)), torch.from_numpy(matrix.indices.astype(np.int64)),
            torch.from_numpy(matrix.data), size=matrix.shape, check_invariants=False,
        )  # fmt: skip
    vector, weight = torch.from_numpy(x), np.full(n * c, -1e-3)
    terms = [x, x.copy()]

    def recursion() -> None:
        for _ in range(products):
            new = matrix @ terms[1]
            new *= weight
            new += terms[1]
            new += terms[1]
            new -= terms[0]
            terms[:] = terms[1], new

    top = float(chebyshev.highest_frequency(network))
    layout = layouts.layout_of(network)
    run = layout.bind(0, top)
    pool = ThreadPoolExecutor(config.threads)
    parts = range(config.threads)
    cuts = [layout.parts * i // config.threads for i in range(config.threads + 1)]

    def steps(fields: int) -> Callable[[], None]:
        cells = layout.cells([rng.standard_normal((n, c)) for _ in range(fields)])
        sums, table = layout.sums(0), np.zeros((0, products + 1, 2, fields))

        def go() -> None:
            if config.threads == 1 or network.n_unknowns < chebyshev.SPLIT:
                run((1, products + 1), products, 0, layout.parts, cells, sums, table)
                return
            for k in range(1, products + 1):
                list(
                    pool.map(lambda i, k=k: run((k, k + 1), products, cuts[i], cuts[i + 1], cells, sums, table), parts)
                )

        return go

    return {
        "scipy CSR": lambda: [matrix @ x for _ in range(products)],
        "scipy recursion": recursion,
        "torch CSR": lambda: [theirs @ vector for _ in range(products)],
        "one field": steps(1),
        "two fields": steps(2),
    }


def measure(config: Config, device: str) -> xarray.Dataset:
    torch.set_num_threads(config.threads)
    long = nw.lattice("triangular", (config.size, config.size))
    masses = tc.Disorder(strength=config.strength).masses(long.n_particles, 1, config.seed)[0]
    began = time.process_time()
    network = replace(long, masses=masses)
    kick = torch.zeros(network.n_particles, 2, dtype=torch.float64)
    kick[network.n_particles // 2, 0] = 1.0
    path = nw.evolve(network, State(torch.zeros_like(kick), kick), [config.stop], "chebyshev")
    took = time.process_time() - began
    energy = float(nw.total_energy(network, path)[0])
    start = float(network.masses[network.n_particles // 2]) / 2
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    names, unknowns, rates = [], [], []
    for name, network in networks(config):
        products = max(12, min(60, int(3e6 / network.n_bonds)))
        seconds = in_turn(ways(network, config, products), config.repeats, time.process_time)
        work = {way: products * network.n_bonds * (2 if way == "two fields" else 1) for way in WAYS}
        names.append(name)
        unknowns.append(network.n_unknowns)
        rates.append([work[way] / float(np.median(seconds[way])) for way in WAYS])
    return xarray.Dataset(
        {
            "rate": (("case", "way"), np.array(rates), {"units": "bond updates / s"}),
            "unknowns": ("case", unknowns),
            "name": ("case", names),
            "long_seconds": took,
            "long_unknowns": long.n_unknowns,
            "long_energy_error": abs(energy / start - 1),
            "peak_gigabytes": peak,
        },
        coords={"way": list(WAYS)},
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 1, width=6)
    axis = axes[0, 0]
    for way, marker in zip(WAYS, "spDov", strict=True):
        for style in ("lattice", "moved"):
            pick = [i for i, name in enumerate(data.name.values) if str(name).endswith(style) and "tri" in str(name)]
            label = f"{way}, {style}" if way in WAYS[3:] else (way if style == "moved" else None)
            if pick and label:
                line = "-" if style == "lattice" else "--"
                axis.plot(data.unknowns[pick], data.rate.sel(way=way)[pick] / 1e6, line + marker, label=label)
    axis.set(xscale="log", yscale="log", xlabel="unknowns (triangular)", ylabel="million bond updates / s")
    axis.legend(fontsize=7)
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, (name, unknowns) in enumerate(zip(data.name.values, data.unknowns.values, strict=True)):
        rate = {way: float(data.rate.sel(way=way)[i]) for way in WAYS}
        note = f"torch {rate['torch CSR'] / 1e6:.0f}, one field {rate['one field'] / 1e6:.0f}, two {rate['two fields'] / 1e6:.0f}"
        rows.append(Row(f"{name}, {unknowns} unknowns: scipy CSR, 1e6 bonds / s", rate["scipy CSR"] / 1e6, note=note))
        for other in WAYS[:3]:
            both = f"one field {rate['one field'] / rate[other]:.1f}"
            rows.append(Row(f"    two fields over {other}", rate["two fields"] / rate[other], note=both))
    rows.append(
        Row(
            f"{int(data.long_unknowns)} unknowns to t = {config.stop:g}, processor seconds with compilation",
            float(data.long_seconds),
        )
    )
    rows.append(Row("    relative error of the energy", float(data.long_energy_error)))
    rows.append(Row("    peak memory, GB", float(data.peak_gigabytes)))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Per processor second. A step is a product and the recursion around it; one field serves a start "
        "of displacements or velocities alone, two any start."
    )


SCRIPT = harness.Script("network_rates", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: Sequence[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
