"""Speed of the band transfer: batched modes and stencil against plain NumPy recipes, on the same masses, tones and times."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import harness
import numpy as np
import torch
import xarray
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.threads import single_blas_thread


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """The paper's case at whole times, and how often each way is timed."""

    step: float = 1.0
    """time step of the output"""
    strength: float = 0.3
    """disorder xi"""
    repeats: int = 5
    """timed runs of each way, after one that is not counted"""
    predicted_times: int = 500
    """times of the prediction"""
    literal_states: int = 6
    """states for which DFT TE DFT^-1 is formed in full; its time is scaled up to all"""


def per_chain_recipe(masses: np.ndarray, tones: np.ndarray, times: np.ndarray, n_bands: int) -> np.ndarray:
    """Band energies of one ring by numpy.linalg.eigh, matrix products and numpy.fft, [tone, time, band]."""
    n = len(masses)
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    stiffness[0, -1] = stiffness[-1, 0] = -1
    squared, vectors = np.linalg.eigh(stiffness / np.sqrt(np.outer(masses, masses)))
    w, shapes = np.sqrt(np.abs(squared)), vectors / np.sqrt(masses)[:, None]
    wave = 0.01 * np.sin(2 * np.pi / n * np.outer(tones, np.arange(1, n + 1)))
    modal = (wave * masses) @ shapes
    phase = np.outer(times, w)
    u = (np.cos(phase) * modal[:, None]) @ shapes.T
    v = (-w * np.sin(phase) * modal[:, None]) @ shapes.T
    hat_u, hat_v, hat_p = np.fft.rfft(u), np.fft.rfft(v), np.fft.rfft(masses * v)
    strain = 4 * np.sin(np.pi / n * np.arange(n // 2 + 1)) ** 2
    energy = (hat_p * hat_v.conj()).real + strain * np.abs(hat_u) ** 2
    energy[..., 1:-1] *= 2
    bands = energy[..., 1:].reshape(*energy.shape[:-1], n_bands, -1).sum(-1)
    return bands / energy.sum(-1, keepdims=True)


def literal_seconds(masses: np.ndarray, states: int) -> float:
    """Seconds to form DFT TE DFT^-1 of Eq. 42 in full for one state."""
    n = len(masses)
    generator = np.random.Generator(np.random.Philox(key=1))
    dft = np.fft.fft(np.eye(n), norm="ortho")
    inverse = dft.conj().T
    stiffness = -2 * np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1)
    samples = []
    for _ in range(states):
        u, v = generator.standard_normal((2, n))
        begin = time.process_time()
        total = (masses[:, None] * np.outer(v, v) - stiffness @ np.outer(u, u)) / 2
        np.diag(dft @ total @ inverse).real.sum()
        samples.append(time.process_time() - begin)
    return statistics.median(samples)


def measure(config: Config, device: str) -> xarray.Dataset:
    with single_blas_thread():  # processor time of one thread is what other processes disturb least
        return _measure(config, device)


def _measure(config: Config, device: str) -> xarray.Dataset:
    scene = config.scene(config.strength)
    masses = scene.disorder.masses(scene.n_particles, scene.realizations, scene.seed).numpy()
    tones, times = np.array(scene.tones), scene.times.numpy()

    def recipe() -> np.ndarray:
        return sum(per_chain_recipe(b, tones, times, scene.n_bands) for b in masses) / len(masses)

    ways: dict[str, Callable[[], np.ndarray]] = {
        "recipe": recipe,
        "modes": lambda: tc.band_transfer(scene, "modes", long_time=False, starts=False, device=device).mean.numpy(),
        "stencil": lambda: tc.band_transfer(
            scene, "chebyshev", long_time=False, starts=False, device=device, options={"accuracy": 1e-10}
        ).mean.numpy(),
    }
    reference = recipe()
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    errors = dict.fromkeys(ways, 0.0)
    for repeat in range(config.repeats + 1):  # the ways in turn, so that a slow spell of the machine meets them all
        for name, way in ways.items():
            begin = time.process_time()
            result = way()
            if repeat:
                seconds[name].append(time.process_time() - begin)
            errors[name] = max(errors[name], float(np.abs(result - reference).max()))
    long = replace(scene, times=torch.linspace(0.0, config.stop, config.predicted_times, dtype=torch.float64))
    begin = time.process_time()
    transfer = tc.band_transfer(long, device=device)
    ensemble = time.process_time() - begin
    master = tc.calibrate(transfer)
    every = torch.eye(scene.n_bands, dtype=torch.float64)
    predictions = {"one": every[:1], "every": every}
    predicted = {
        name: _median_of(lambda start=start: master.solve(start, long.times)) for name, start in predictions.items()
    }
    n, states = scene.n_particles, scene.realizations * len(tones) * len(times)
    literal = literal_seconds(masses[0], config.literal_states) * states
    wide = torch.ones(2048, 2048, dtype=torch.float64)
    products = []
    for _ in range(5):
        begin = time.process_time()
        wide @ wide
        products.append(time.process_time() - begin)
    eigen = 9 * n**3 * scene.realizations  # reduction 4/3, divide and conquer up to 17/3, back transformation 2
    product = 2 * 2 * n * n * states + 2 * n * n * len(tones) * scene.realizations
    return xarray.Dataset(
        {
            "seconds": (("way", "repeat"), np.array([seconds[name] for name in ways]), {"units": "s"}),
            "error": (
                ("way",),
                np.array([errors[name] for name in ways]),
                {"long_name": "largest difference to the recipe"},
            ),
            "literal_seconds": ((), literal, {"units": "s", "long_name": "DFT TE DFT^-1 for every state, scaled up"}),
            "ensemble_seconds": ((), ensemble, {"units": "s", "long_name": "ensemble that a prediction replaces"}),
            "prediction_seconds": (("start",), list(predicted.values()), {"units": "s"}),
            "flops_eigen": ((), float(eigen)),
            "flops_product": ((), float(product)),
            "machine_flops": ((), 2 * 2048**3 / statistics.median(products), {"units": "1/s"}),
        },
        coords={"way": list(ways), "start": list(predicted)},
    )


def _median_of(work: Callable[[], object], repeats: int = 50) -> float:
    work()
    samples = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        samples.append(time.process_time() - begin)
    return statistics.median(samples)


def _median(data: xarray.Dataset, way: str) -> float:
    return float(data.seconds.sel(way=way).median())


def compare(data: xarray.Dataset, config: Config) -> list[harness.Row]:
    recipe, literal = _median(data, "recipe"), float(data.literal_seconds)
    rows = [harness.Row("recipe: eigh + FFT per chain, seconds", recipe)]
    for way in ("modes", "stencil"):
        ratios = (data.seconds.sel(way="recipe") / data.seconds.sel(way=way)).values
        rows += [
            harness.Row(f"{way}: seconds", _median(data, way)),
            harness.Row(f"{way}: times faster than the recipe, median of pairs", float(np.median(ratios))),
            harness.Row(f"{way}: times faster than DFT TE DFT^-1", literal / _median(data, way)),
            harness.Row(f"{way}: largest difference to the recipe", float(data.error.sel(way=way))),
        ]
    total = float(data.flops_eigen + data.flops_product)
    rate = total / _median(data, "modes")
    rows += [
        harness.Row("modes: Gflop of eigen-decompositions (9 N^3)", float(data.flops_eigen) / 1e9),
        harness.Row("modes: Gflop of matrix products", float(data.flops_product) / 1e9),
        harness.Row("modes: Gflop/s reached", rate / 1e9),
        harness.Row("machine: Gflop/s of a large matrix product", float(data.machine_flops) / 1e9),
        harness.Row("modes: share of the machine's rate", rate / float(data.machine_flops)),
    ]
    ensemble = float(data.ensemble_seconds)
    rows.append(
        harness.Row(f"ensemble of {config.predicted_times} times, with its long-time average: seconds", ensemble)
    )
    for name, words in (("one", "from one start"), ("every", "from every band")):
        seconds = float(data.prediction_seconds.sel(start=name))
        rows += [
            harness.Row(f"prediction {words}: seconds", seconds),
            harness.Row(f"prediction {words}: times faster than that ensemble", ensemble / seconds),
        ]
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 1)
    ax = axes[0][0]
    ways = [str(way) for way in data.way.values]
    values = [_median(data, way) for way in ways] + [float(data.literal_seconds)]
    names = ["eigh + FFT\nper chain (NumPy)", "batched modes", "stencil\n(Chebyshev)", "DFT TE DFT$^{-1}$\n(scaled up)"]
    bars = ax.bar(names, values, color=["C7", "C0", "C1", "C3"])
    ax.bar_label(bars, [f"{value:.3g} s" for value in values])
    ax.set(
        yscale="log",
        ylabel="processor seconds, median",
        title=f"{config.realizations} chains, {config.n_bands} tones, to t = {config.stop:g}",
    )
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "All ways measure the same masses, tones and times, in turn in one run. The modes' arithmetic is the eigen-"
        "decomposition, which LAPACK cannot run at the rate of matrix products, and two products per state."
    )


SCRIPT = harness.Script(
    "transfer_speed", Config(), replace(Config(), n_particles=32, n_bands=4, realizations=4, stop=5.0, repeats=1, predicted_times=40, literal_states=2),
    measure, draw, compare, explain,
)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
