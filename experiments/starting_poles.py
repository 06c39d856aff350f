"""Where the search for the poles of a model with memory begins: ladders and random poles, or those of ESPRIT."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.master.memory import ORDERS
from torchchain.master.projection import FEW_STEPS, MANY_STEPS, Order, Poles, Projection, search
from torchchain.master.sample import Sample, exact_basis

SPANS = ((40.0, 161), (500.0, 251))
"""Ends and numbers of the even times that ESPRIT sees: one span for fast poles, one for slow ones."""


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """Ensembles whose transfer is fitted by every order of the ladder."""

    seed: int = 3
    """seed of the ensembles"""
    strengths: tuple[float, ...] = (0.05, 0.1, 0.3, 0.5)
    """disorders xi of normal masses"""
    binary: tuple[float, ...] = (0.5,)
    """disorders of two-valued masses"""
    stop: float = 500.0
    """last time"""
    orders: int = 10
    """how many of the ladder's orders, from the second"""

    def times(self) -> np.ndarray:
        fine = [
            np.arange(0, 5, 0.25),
            np.arange(5, 25, 0.5),
            np.arange(25, 50, 1),
            np.arange(50, 100, 2.5),
            np.arange(100, 1e4, 10),
        ]
        every = np.concatenate(fine)
        return np.append(every[every < self.stop], self.stop)


SMOKE = Config(strengths=(0.3,), binary=(0.5,), n_particles=64, n_bands=8, realizations=8, stop=40.0, orders=2)


def esprit(problem: Projection, order: Order, span: tuple[float, int]) -> Poles:
    """Poles from the shift between rows of a block Hankel matrix (Roy and Kailath 1989), as many of each kind as asked for.

    The data are interpolated to even times. Poles are spread over those found by their size, and made up where too few
    are real or complex.
    """
    single, pairs = order
    times = np.linspace(0, min(span[0], problem.times[-1]), span[1])
    data = np.stack([np.interp(times, problem.times, row) for row in problem.data.T], axis=1)
    half = len(times) // 2
    hankel = np.stack([data[i : i + half] for i in range(len(times) - half + 1)], axis=1).reshape(half, -1)
    space = np.linalg.svd(hankel, full_matrices=False)[0][:, : single + 2 * pairs]
    found = np.log(np.linalg.eigvals(np.linalg.pinv(space[:-1]) @ space[1:]) + 0j) / times[1]
    decay, turns = np.sort(-found[np.abs(found.imag) < 1e-9].real), found[found.imag > 1e-9]
    decay = np.append(decay, np.geomspace(0.02, 1, max(single - len(decay), 0)))
    turns = np.append(
        turns[np.argsort(np.abs(turns))], [0.05 * (i + 1) * (1j - 1) for i in range(max(pairs - len(turns), 0))]
    )
    decay, turns = (
        x[np.linspace(0, len(x) - 1, count).round().astype(int)] for x, count in ((decay, single), (turns, pairs))
    )
    inside = [np.clip(x, low, 5) for x, low in ((decay, 2e-4), (-turns.real, 2e-4), (turns.imag, 0.011))]
    return Poles(*inside)


def by_esprit(problem: Projection, order: Order) -> Poles:
    """The search from the better of two spans' poles."""
    tries = [problem.polished(esprit(problem, order, span), FEW_STEPS) for span in SPANS]
    return problem.polished(min(tries, key=lambda found: found[1])[0], MANY_STEPS)[0]


WAYS: dict[str, Callable[[Projection, Order], Poles]] = {
    "ladders and random": lambda problem, order: search(problem, order)[0],
    "ESPRIT": by_esprit,
}


def problem_of(transfer: tc.BandTransfer) -> Projection:
    """What the poles are searched on: the leading singular vectors of what does not stay."""
    sample = Sample.of(transfer)
    basis = exact_basis(sample)
    data = (sample.mean - basis[:, None]).transpose(0, 1).reshape(len(sample.times), -1).numpy()
    start = (torch.eye(len(basis), dtype=basis.dtype) - basis).flatten().numpy()
    return Projection(sample.times.numpy(), data @ sample.leading, start @ sample.leading)


def measure(config: Config, device: str) -> xarray.Dataset:
    cases = [("normal", xi) for xi in config.strengths] + [("binary", xi) for xi in config.binary]
    orders = ORDERS[1 : 1 + config.orders]
    misfit, seconds = (np.zeros((len(WAYS), len(cases), len(orders))) for _ in range(2))
    for j, (kind, xi) in enumerate(cases):
        scene = config.scene(xi, times=config.times(), disorder=tc.Disorder(kind, xi))
        problem = problem_of(tc.band_transfer(scene, device=device, starts=False))
        for k, order in enumerate(orders):
            for i, way in enumerate(WAYS.values()):
                begin = time.process_time()
                poles = way(problem, order)
                seconds[i, j, k] = time.process_time() - begin
                misfit[i, j, k] = np.square(problem.amplitudes(poles)[1]).sum()
    names = [f"{kind} {xi:g}" for kind, xi in cases]
    labels = [f"{single}+{pairs}" for single, pairs in orders]
    return xarray.Dataset(
        {"misfit": (("way", "case", "order"), misfit), "seconds": (("way", "case", "order"), seconds, {"units": "s"})},
        {"way": list(WAYS), "case": names, "order": labels},
    )


def ratios(data: xarray.Dataset) -> xarray.DataArray:
    """Sum of squares that ESPRIT's poles lead to over that of the library's."""
    return data.misfit.sel(way="ESPRIT") / data.misfit.sel(way="ladders and random")


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    for i, case in enumerate(data.case.values):
        style = "osv^D"[i % 5] + "-"
        axes[0, 0].plot(data.order.values, ratios(data).sel(case=case), style, label=case)
        part = data.seconds.sel(case=case)
        axes[0, 1].plot(
            data.order.values, part.sel(way="ESPRIT") / part.sel(way="ladders and random"), style, label=case
        )
    for ax, label in zip(axes[0], ("sum of squares", "processor time"), strict=True):
        ax.axhline(1, color="k", linestyle=":")
        ax.set(yscale="log", xlabel="exponentials + pairs", ylabel=f"{label}, ESPRIT over library")
        ax.tick_params(axis="x", rotation=45)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("")
    axes[0, 0].set(yticks=[0.7, 1, 1.5, 2, 3])
    axes[0, 1].set(yticks=[0.5, 1, 2, 5])
    axes[0, 0].legend(title="masses")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    found = ratios(data)
    time_ratio = data.seconds.sum(("case", "order"))
    return [
        Row("fits", float(found.size)),
        Row("as near to 1 %", float((np.abs(found - 1) <= 0.01).sum())),
        Row("ESPRIT nearer", float((found < 0.99).sum()), note=f"at best {float(found.min()):.2f} times the squares"),
        Row("ESPRIT farther", float((found > 1.01).sum()), note=f"at worst {float(found.max()):.2f} times"),
        Row(
            "processor time, ESPRIT over library",
            float(time_ratio.sel(way="ESPRIT") / time_ratio.sel(way="ladders and random")),
        ),
    ]


def explain(data: xarray.Dataset, config: Config) -> str:
    time_ratio = data.seconds.sum(("case", "order"))
    saved = 1 - float(time_ratio.sel(way="ESPRIT") / time_ratio.sel(way="ladders and random"))
    return (
        "The library searches from two ladders of poles and three random sets; ESPRIT's poles, of two spans of even times, are polished alike.\n"
        f"They save {100 * saved:.0f} % of {float(time_ratio.sel(way='ladders and random')) / data.misfit[0].size:.2f} s a fit and end in a worse minimum "
        f"in {int((ratios(data) > 1.01).sum())} of {ratios(data).size} cases, in a better one in {int((ratios(data) < 0.99).sum())}."
    )


SCRIPT = harness.Script("starting_poles", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
