"""What a digit of an ensemble mean costs: plain realizations, opposite masses, sine and cosine, shifted starts."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import harness
import numpy as np
import stencil_rates
import torch
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain import checks
from torchchain.energy.bands import center_tones
from torchchain.ensemble import fused
from torchchain.threads import single_blas_thread

BANDS, WIDTH = "standing wave: energy in bands", "kick: squared width"


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the masses"""
    n_particles: int = 128
    """particles per ring"""
    n_bands: int = 16
    """wavenumber bands B"""
    band: int = 11
    """band of the standing wave"""
    strength: float = 0.3
    """disorder xi"""
    stop: float = 40.0
    """last time; the kick must not come around"""
    step: float = 1.0
    """time step of the output"""
    samples: int = 1024
    """independent samples of every way; all ways' together are the reference"""
    shifts: tuple[int, ...] = (4, 16)
    """starts per ring of the ways with shifted starts"""
    repeats: int = 5
    """timed runs after a first"""


SMOKE = Config(n_particles=32, n_bands=4, band=3, stop=5.0, samples=8, shifts=(2,), repeats=1)


@dataclass(frozen=True)
class Way:
    """One unbiased estimate of the ensemble mean from one draw of the masses.

    Attributes:
        observable: what is averaged.
        name: of the way.
        opposite: also the ring with the opposite masses, as ``Scene(opposite_pairs=True)`` draws them.
        starts: how many starts on each ring; for standing waves sine and cosine.
    """

    observable: str
    name: str
    opposite: bool
    starts: int

    @property
    def evolutions(self) -> int:
        """Chains evolved for one sample."""
        return self.starts * (1 + self.opposite)


def ways(config: Config) -> list[Way]:
    return [
        Way(BANDS, "plain", False, 1),
        Way(BANDS, "opposite masses", True, 1),
        Way(BANDS, "sine and cosine", False, 2),
        Way(BANDS, "opposite masses, sine and cosine", True, 2),
        Way(WIDTH, "plain", False, 1),
        Way(WIDTH, "opposite masses", True, 1),
        *(Way(WIDTH, f"{n} starts", False, n) for n in config.shifts),
    ]


def drawn(config: Config, count: int, opposite: bool, stream: int) -> Tensor:
    """Masses of some draws, (draw, ring of the pair, particle)."""
    size = 1 + opposite
    numbers = range(stream * 2 * config.samples, stream * 2 * config.samples + count * size)
    disorder = tc.Disorder(strength=config.strength)
    masses = disorder.masses(config.n_particles, numbers, config.seed, opposite_pairs=opposite)
    return masses.unflatten(0, (count, size))


def observed(config: Config, way: Way, masses: Tensor) -> Tensor:
    """The estimate of each draw, (draw, time, band) or (draw, time, 1)."""
    chain = tc.Chain(masses.flatten(0, 1))
    times = torch.arange(config.step, config.stop + config.step / 2, config.step, dtype=torch.float64)
    if way.observable == BANDS:
        tone = center_tones(config.n_particles, config.n_bands)[config.band - 1]
        phases = ("sin", "cos")[: way.starts]
        waves = [tc.standing_wave(chain, tone, phase=phase).displacement for phase in phases]
        start = torch.stack(waves, dim=1)
        energy = fused.band_energy(chain, tc.State(start, torch.zeros_like(start)), times, config.n_bands)
        return energy.reshape(len(masses), -1, *energy.shape[-2:]).mean(1)
    sites = [1 + i * config.n_particles // way.starts for i in range(way.starts)]
    start = torch.stack([tc.impulse(chain, site).velocity for site in sites], dim=1)
    trajectory = tc.evolve(chain, tc.State(torch.zeros_like(start), start), times, "chebyshev")
    energy = tc.particle_energy(chain, trajectory)
    middle = config.n_particles // 2 - 1
    energy = torch.stack([energy[:, i].roll(middle - (site - 1), -1) for i, site in enumerate(sites)], dim=1)
    place = torch.arange(config.n_particles, dtype=torch.float64) - middle
    width = (energy * place.square()).sum(-1, keepdim=True) / energy.sum(-1, keepdim=True)
    return width.reshape(len(masses), -1, *width.shape[-2:]).mean(1)


def distance(estimate: Tensor, exact: Tensor, observable: str) -> Tensor:
    """Total variation of bands, or the width's relative deviation, averaged over times; (*batch,)."""
    if observable == BANDS:
        return tc.total_variation(estimate, exact).mean(-1)
    return ((estimate - exact).abs() / exact)[..., 0].mean(-1)


def sizes(config: Config) -> list[int]:
    """Numbers of samples in a mean: up to an eighth of all, so that eight means are independent."""
    return [2**k for k in range(20) if 2**k <= config.samples // 8]


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', whose time this experiment measures", repr(device))
    if config.stop > config.n_particles / 2 - 5:
        raise checks.fail("stop", f"be at most n_particles/2 - 5 = {config.n_particles / 2 - 5:g}", config.stop)
    every = ways(config)
    results: list[Tensor] = []
    works: dict[str, Callable[[], object]] = {}
    for i, way in enumerate(every):
        masses = drawn(config, config.samples, way.opposite, i)
        results.append(torch.cat([observed(config, way, part) for part in masses.split(128)]))
        works[str(i)] = partial(observed, config, way, masses[:128])
    with single_blas_thread():  # processor time of one thread is what other processes disturb least
        samples = stencil_rates.in_turn(works, config.repeats, time.process_time)
    seconds = [statistics.median(samples[str(i)]) / min(128, config.samples) for i in range(len(every))]
    errors, biases, own = [], [], []
    for way, result in zip(every, results, strict=True):
        others = [r for w, r in zip(every, results, strict=True) if w.observable == way.observable]
        exact = torch.stack([r.mean(0) for r in others]).mean(0)
        errors.append([_error(result, n, exact, way.observable) for n in sizes(config)])
        biases.append(float(distance(result.mean(0), exact, way.observable)))
        own.append(errors[-1][-1] * (sizes(config)[-1] / config.samples) ** 0.5)
    return xarray.Dataset(
        {
            "observable": ("way", [way.observable for way in every]),
            "name": ("way", [way.name for way in every]),
            "evolutions": ("way", [way.evolutions for way in every], {"long_name": "chains evolved for a sample"}),
            "seconds": ("way", seconds, {"units": "s", "long_name": "of a sample"}),
            "error": (("way", "count"), np.array(errors)),
            "off": ("way", biases, {"long_name": "distance of the mean of all samples from the reference"}),
            "expected_off": ("way", own, {"long_name": "statistical error of that mean"}),
        },
        {"count": ("count", sizes(config), {"long_name": "samples in a mean"})},
    )


def _error(result: Tensor, count: int, exact: Tensor, observable: str) -> float:
    """Mean error of a mean of this many samples."""
    groups = result[: len(result) // count * count].reshape(-1, count, *result.shape[1:]).mean(1)
    return float(distance(groups, exact, observable).mean())


def price(data: xarray.Dataset, cost: str) -> np.ndarray:
    """Error times the square root of the cost, the same at any number of samples, (way,)."""
    scaled = data.error * np.sqrt(data["count"]) * np.sqrt(data[cost])
    return np.exp(np.log(scaled).mean("count")).values


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 2, width=5.4, height=3.9)
    for row, observable in enumerate((BANDS, WIDTH)):
        part = data.isel(way=data.observable.values == observable)
        for ax, cost in zip(axes[row], ("evolutions", "seconds"), strict=True):
            _panel(ax, part, cost, observable)
    for row, label in zip(axes, ("total variation from the ensemble", "relative error of $r^2$"), strict=True):
        row[0].set(xlabel="chains evolved", ylabel=label)
        row[1].set(xlabel="processor seconds", ylabel=label)
    return figure


def _panel(ax: Axes, part: xarray.Dataset, cost: str, title: str) -> None:
    prices = price(part, cost)
    plain = prices[list(part.name.values).index("plain")]
    for i, name in enumerate(part.name.values):
        spent = part["count"].values * float(part[cost][i])
        ax.plot(spent, part.error[i], marker="osv^D"[i % 5], color=f"C{i}", markersize=4,
                label=f"{name}: {(prices[i] / plain) ** 2:.2g}")  # fmt: skip
    ax.set(xscale="log", yscale="log", title=title)
    ax.title.set_fontsize("medium")
    ax.legend(title="cost of the same error, plain = 1")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for observable in (BANDS, WIDTH):
        part = data.isel(way=data.observable.values == observable)
        work, seconds = price(part, "evolutions"), price(part, "seconds")
        for i, name in enumerate(part.name.values):
            note = (
                f"times sqrt(seconds) {seconds[i]:.3g}; same error as plain at {(work[i] / work[0]) ** 2:.2g} times the chains, "
                f"{(seconds[i] / seconds[0]) ** 2:.2g} times the seconds; all samples' mean is off by {float(part.off[i]):.1e}, "
                f"expected {float(part.expected_off[i]):.1e}"
            )
            rows.append(Row(f"{observable}, {name}: error times sqrt(chains)", float(work[i]), note=note))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"measured: error of a mean of 1 to {sizes(config)[-1]} samples against all ways' {config.samples} samples each, mean "
        f"over times; xi = {config.strength:g}, rings of {config.n_particles}, t <= {config.stop:g}; processor time of one thread.\n"
        "A further digit costs 100 times as much in every way; the ways differ by a factor only. No way is biased as far as\n"
        "its samples tell: their mean is off by about its statistical error at most (table). A shift of a standing wave along its ring is a mixture\n"
        "of sine and cosine, so that these two are all that shifts can give there."
    )


SCRIPT = harness.Script("chart_ensemble", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
