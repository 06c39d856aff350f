"""Speed of the stencil: a bare recursion, the Chebyshev kernels and eager torch; an impulse by the kernels and by modes."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from matplotlib.figure import Figure
from numba import njit

import torchchain as tc
from torchchain.ensemble import fused
from torchchain.evolvers import chebyshev, coefficients, compiling, expansion
from torchchain.threads import single_thread


@dataclass(frozen=True)
class Config:
    """Lengths for the rates, and the paper's impulse beside the wall of a long chain."""

    seed: int = 0
    """seed of the ensemble"""
    lengths: tuple[int, ...] = (64, 256, 1024, 4096)
    """particles per chain for the rates"""
    updates: float = 4e7
    """stencil updates per timed run"""
    eager_chains: int = 100
    """chains in a batch of eager torch, which needs many; the kernels take one at a time in any case"""
    n_particles: int = 1024
    """particles per chain for the impulse"""
    strength: float = 0.1
    """disorder xi"""
    stop: float = 1024.0
    """last time; the step is 1"""
    realizations: int = 32
    """chains by the kernels"""
    modes_realizations: int = 4
    """chains by modes"""
    repeats: int = 7
    """timed runs of each way, after one that is not counted"""


SMOKE = Config(
    lengths=(64, 256),
    updates=4e5,
    eager_chains=2,
    n_particles=64,
    stop=32.0,
    realizations=2,
    modes_realizations=2,
    repeats=2,
)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def bare(older, old, weight, n, pairs):  # type: ignore[no-untyped-def]
    """T_k+1 = 2 x T_k - T_k-1 in place, 2 * pairs times, on n particles between two resting ones, and nothing else."""
    compiling.wide_vectors()  # as the kernels
    for _ in range(pairs):
        for p in range(1, n + 1):
            x = old[p]
            older[p] = weight[p] * ((old[p - 1] - x) + (old[p + 1] - x)) + (2.0 * x - older[p])
        for p in range(1, n + 1):
            x = older[p]
            old[p] = weight[p] * ((older[p - 1] - x) + (older[p + 1] - x)) + (2.0 * x - old[p])


def in_turn(
    ways: dict[str, Callable[[], object]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Seconds of each run, the ways one after the other so that a slow spell of the machine meets them all."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for repeat in range(repeats + 1):
        for name, way in ways.items():
            begin = clock()
            way()
            if repeat:
                seconds[name].append(clock() - begin)
    return seconds


def terms_at(frequency: float, time: float) -> int:
    """Terms of the expansion that the kernels take for one time, to rounding."""
    return coefficients.coefficients(frequency, time, expansion.ROUNDING, np.empty(1000), *np.empty((3, 1000)))


def rates(config: Config, n: int) -> dict[str, list[float]]:
    """Stencil updates per second of one core's time, each run of each way."""
    chain = tc.Chain(tc.Disorder(strength=config.strength).masses(n, 1, config.seed), "fixed")
    # A start of displacement and velocity everywhere, carried over one long time: every stencil is full.
    generator = torch.Generator().manual_seed(config.seed)
    state = tc.State(*(1e-3 * torch.randn(1, n, generator=generator, dtype=torch.float64) for _ in range(2)))
    copies = config.eager_chains
    batch = tc.Chain(chain.masses.repeat(copies, 1), "fixed")
    many = tc.State(state.displacement.repeat(copies, 1), state.velocity.repeat(copies, 1))
    frequency = chebyshev.highest_frequency(chain).item()
    terms = terms_at(frequency, expansion.LEAP / frequency)
    leaps = max(1, round(config.updates / (2 * terms * n)))
    fewer = max(1, leaps // copies)
    pairs = leaps * terms
    leap = (1 - 1e-9) * expansion.LEAP / frequency
    rows = np.zeros((2, n + 2))
    rows[:, 1:-1] = state.velocity.numpy()
    weight = np.zeros(n + 2)
    weight[1:-1] = 4 / (frequency**2 * chain.masses[0].numpy())
    options = {"accuracy": expansion.ROUNDING}
    ways = {
        "bare": lambda: bare(rows[0], rows[1], weight, n, pairs),
        "kernels": lambda: tc.evolve(chain, state, [leaps * leap], "chebyshev", **options),
        "eager torch": lambda: tc.evolve(batch, many, [fewer * leap], "chebyshev", compiled=False, **options),
    }
    updates = {"bare": pairs, "kernels": leaps * terms, "eager torch": fewer * terms * copies}
    with single_thread():
        return {
            name: [2 * updates[name] * n / t for t in seconds]
            for name, seconds in in_turn(ways, config.repeats, time.thread_time).items()
        }


def impulse_updates(config: Config, frequency: float) -> tuple[float, float]:
    """Particles times stencils, and particles times terms of the sums for outputs, of one chain after the kick.

    No more particles are counted than sound has reached, though the kernels go a little beyond.
    """
    count = min(expansion.LONGEST, int(expansion.SHARED_PHASE / frequency))
    terms = np.array([terms_at(frequency, 1.0 + j) for j in range(count)])
    reached = np.minimum(np.arange(0, config.stop, count), config.n_particles).sum()
    return reached * terms.max(), reached * 2 * terms.sum()


def measure(config: Config, device: str) -> xarray.Dataset:
    disorder = tc.Disorder(strength=config.strength)
    masses = disorder.masses(config.n_particles, max(config.realizations, config.modes_realizations), config.seed)
    many = tc.Chain(masses[: config.realizations].to(device), "fixed")
    few = tc.Chain(masses[: config.modes_realizations].to(device), "fixed")
    times = torch.arange(config.stop + 1, dtype=torch.float64, device=device)
    found: dict[str, list[torch.Tensor]] = {}

    def kernels() -> None:
        moments = fused.energy_moments(many, tc.impulse(many), times)
        found["kernels"] = [x[: config.modes_realizations].cpu() for x in (moments.center, moments.width)]

    def modes() -> None:
        energy = tc.particle_energy(few, tc.evolve(few, tc.impulse(few), times, "modes"))
        found["modes"] = [tc.energy_center(energy).cpu(), tc.energy_width(energy).cpu()]

    seconds = in_turn({"kernels": kernels, "modes": modes}, config.repeats)
    speed = [rates(config, n) for n in config.lengths]
    kinds = list(speed[0])
    chains = {"kernels": config.realizations, "modes": config.modes_realizations}
    shared = min(chains.values())
    counted = np.array([impulse_updates(config, w) for w in chebyshev.highest_frequency(many).tolist()]).mean(0)
    spent = np.array(seconds["kernels"]) / config.realizations * torch.get_num_threads()
    (center, width), (modal_center, modal_width) = found["kernels"], found["modes"]
    # The width starts from zero: relative to it from the first output after the start.
    errors = [
        (center[:shared] / modal_center[:shared] - 1).abs().max().item(),
        (width[:shared, 1:] / modal_width[:shared, 1:] - 1).abs().max().item(),
    ]
    return xarray.Dataset(
        {
            "rate": (
                ("particles", "kind", "repeat"),
                np.array([[one[kind] for kind in kinds] for one in speed]),
                {"units": "1/s", "long_name": "stencil updates per second of one core"},
            ),
            "impulse": (
                ("way", "repeat"),
                np.array([[t / chains[way] for t in seconds[way]] for way in seconds]),
                {"units": "s", "long_name": "seconds per chain, all cores"},
            ),
            "impulse_rate": (
                ("work", "repeat"),
                np.stack([counted[0] / spent, counted.sum() / spent]),
                {"units": "1/s", "long_name": "updates per second of one core, impulse by the kernels"},
            ),
            "error": (("quantity",), errors, {"long_name": "largest relative difference between the ways"}),
        },
        coords={
            "particles": list(config.lengths),
            "kind": kinds,
            "way": list(seconds),
            "quantity": ["center R", "width r^2"],
            "work": ["stencils", "stencils and terms of sums"],
        },
    )


def compare(data: xarray.Dataset, config: Config) -> list[harness.Row]:
    rows = []
    for n in config.lengths:
        rate = data.rate.sel(particles=n)
        for kind in data.kind.values:
            values = rate.sel(kind=kind).values / 1e9
            note = (
                ""
                if kind == "bare"
                else f"{statistics.median(rate.sel(kind='bare').values / 1e9 / values):.1f} times slower than bare"
            )
            rows.append(harness.Row(f"N = {n}, {kind}: 1e9 updates / s", statistics.median(values), note=note))
    for way in data.way.values:
        values = data.impulse.sel(way=way).values * 1e3
        rows.append(
            harness.Row(
                f"impulse, {way}: ms per chain",
                statistics.median(values),
                note=f"{values.min():.3g} to {values.max():.3g}",
            )
        )
    for work in data.work.values:
        rate = statistics.median(data.impulse_rate.sel(work=work).values / 1e9)
        rows.append(harness.Row(f"impulse, kernels, {work}: 1e9 updates / s", rate))
    medians = data.impulse.median("repeat")
    rows.append(harness.Row("impulse, modes / kernels", float(medians.sel(way="modes") / medians.sel(way="kernels"))))
    for quantity in data.quantity.values:
        rows.append(
            harness.Row(f"impulse, {quantity}: largest relative difference", float(data.error.sel(quantity=quantity)))
        )
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, ((left, right),) = harness.panels(1, 2)
    for kind in data.kind.values:
        rate = data.rate.sel(kind=kind) / 1e9
        left.plot(data.particles, rate.median("repeat"), "o-", label=kind)
        left.fill_between(data.particles, rate.min("repeat"), rate.max("repeat"), alpha=0.2)
    left.set(xscale="log", yscale="log", xlabel="particles $N$", ylabel="$10^9$ stencil updates / s, one core", title="speed of one core")
    left.set_xticks(data.particles.values, [str(n) for n in data.particles.values])
    left.set_xticks([], minor=True)
    left.legend()
    medians = data.impulse.median("repeat") * 1e3
    for place, (way, marker) in enumerate((("kernels", "o"), ("modes", "s"))):
        found = float(medians.sel(way=way))
        right.plot(place, found, marker, ms=7, color=f"C{place}")
        right.annotate(f"{found:.3g}", (place, found), (8, 0), textcoords="offset points", va="center")
    right.set_xticks([0, 1], ["compiled kernels", "modes"])
    right.margins(x=0.4, y=0.15)
    right.set(
        yscale="log",
        ylabel="ms per chain, all cores",
        title=f"R and r² of a kick, N = {config.n_particles}, {int(config.stop) + 1} times",
    )
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "bare: the three-term recursion alone, in place. kernels: the same with what makes it a solution, the sums for\n"
        "displacement and velocity (two per update) and the rest of a call. eager torch: the same in plain tensor operations,\n"
        "many chains at once. impulse: center and width of the energy after a kick at site 1, by tc.energy_moments\n"
        "and by batched eigen-decomposition, modal sums and particle_energy. Its rate counts the particles that sound has\n"
        "reached: the sums for 1025 outputs are most of the work, and a term of one is an update as cheap as a stencil."
    )


SCRIPT = harness.Script("stencil_rates", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
