"""How time and memory grow with the number of particles and with the time span, each run in a process of its own."""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import checks

WHOLE, KICK = "whole chain", "kick in the middle"
LOOKS = {"chebyshev": "C0", "tridiagonal": "C1", "modes": "C2"}


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the chain"""
    strength: float = 0.3
    """disorder xi"""
    particles: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
    """chains for 'chebyshev'"""
    tridiagonal: tuple[int, ...] = (256, 512, 1024, 2048, 4096)
    """chains for 'tridiagonal'"""
    modes: tuple[int, ...] = (256, 512, 1024, 2048)
    """chains for 'modes'"""
    stop: float = 1000.0
    """time span"""
    spans: tuple[float, ...] = (125.0, 250.0, 500.0)
    """and shorter ones, for the growth with time"""
    span_particles: int = 100_000
    """chain of the shorter ones"""
    fresh: bool = True
    """each run in a process of its own; without, memory is the peak of all runs so far"""


SMOKE = Config(
    particles=(1_000,), tridiagonal=(64,), modes=(64,), stop=20.0, spans=(10.0,), span_particles=1_000, fresh=False
)


@dataclass(frozen=True)
class Case:
    """One run: a chain of N particles from its start to one output time."""

    method: str
    start: str
    n_particles: int
    stop: float
    strength: float
    seed: int


def cases(config: Config) -> Iterator[Case]:
    def case(method: str, start: str, n: int, stop: float) -> Case:
        return Case(method, start, n, stop, config.strength, config.seed)

    for start in (KICK, WHOLE):
        yield from (case("chebyshev", start, n, config.stop) for n in config.particles)
    for stop in (*config.spans, config.stop):
        yield case("chebyshev", WHOLE, config.span_particles, stop)
    yield from (case("tridiagonal", WHOLE, n, config.stop) for n in config.tridiagonal)
    yield from (case("modes", WHOLE, n, config.stop) for n in config.modes)


def peak_memory() -> float:
    """Largest resident memory of this process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def evolve(case: Case) -> dict[str, float]:
    """Seconds, and what is wrong with the result."""
    masses = tc.Disorder(strength=case.strength).masses(case.n_particles, 1, case.seed)[0]
    chain = tc.Chain(masses, boundary="fixed")
    if case.start == KICK:
        state = tc.impulse(chain, (case.n_particles + 1) // 2)
    else:  # every particle displaced: nothing can be skipped
        noise = torch.Generator().manual_seed(case.seed)
        displacement = 0.01 * torch.randn(case.n_particles, dtype=torch.float64, generator=noise)
        state = tc.State(displacement, torch.zeros_like(displacement))
    before = tc.total_energy(chain, tc.Trajectory(torch.zeros(1), state.displacement[None], state.velocity[None]))
    began, worked = time.perf_counter(), time.process_time()
    trajectory = tc.evolve(chain, state, [case.stop], method=case.method)
    seconds, cpu = time.perf_counter() - began, time.process_time() - worked
    drift = float((tc.total_energy(chain, trajectory)[-1] / before - 1).abs())
    highest = float(chain.squared_frequency_bound(sweeps=8).sqrt())
    return {"seconds": seconds, "cpu_seconds": cpu, "energy_error": drift, "highest_frequency": highest}


def measured(case: Case) -> dict[str, float]:
    """Time and memory of a case, in this process."""
    evolve(replace(case, n_particles=64, stop=10.0))  # compile and load first
    base = peak_memory()
    return evolve(case) | {"base_memory": base, "memory": peak_memory()}


def work() -> None:
    """In a process of its own: a case from standard input, its measurements to standard output."""
    torch.set_num_threads(1)
    print(json.dumps(measured(Case(**json.load(sys.stdin)))))


def apart(case: Case) -> dict[str, float]:
    """Time and memory of a case, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", "import growth; growth.work()"],
        input=json.dumps(asdict(case)), text=True, capture_output=True, cwd=Path(__file__).parent, check=False,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{case} failed: {done.stderr[-2000:]}")
    return json.loads(done.stdout)


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', whose time and memory this experiment measures", repr(device))
    chosen = list(dict.fromkeys(cases(config)))
    found = [apart(case) if config.fresh else measured(case) for case in chosen]
    units = {
        "seconds": "s",
        "cpu_seconds": "s",
        "base_memory": "byte",
        "memory": "byte",
        "energy_error": "1",
        "highest_frequency": "1",
    }
    return xarray.Dataset(
        {
            **{
                name: ("run", [asdict(case)[name] for case in chosen])
                for name in ("method", "start", "n_particles", "stop")
            },
            **{name: ("run", [values[name] for values in found], {"units": unit}) for name, unit in units.items()},
        }
    )


def select(data: xarray.Dataset, method: str, start: str, stop: float) -> xarray.Dataset:
    return data.isel(run=np.flatnonzero((data.method == method) & (data.start == start) & (data.stop == stop)))


def series(config: Config) -> list[tuple[str, str]]:
    return [("chebyshev", KICK), ("chebyshev", WHOLE), ("tridiagonal", WHOLE), ("modes", WHOLE)]


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 3, width=5.0, height=4.2)
    for method, start in series(config):
        part = select(data, method, start, config.stop)
        style = {"color": LOOKS[method], "mfc": "none" if start == KICK else None, "ls": "--" if start == KICK else "-"}
        label = f"{method}, {start}" if method == "chebyshev" else method
        axes[0, 0].plot(part.n_particles, part.cpu_seconds, "o", label=label, **style)
        axes[0, 1].plot(part.n_particles, extra_megabytes(part), "o", label=label, **style)
    whole = select(data, "chebyshev", WHOLE, config.stop)
    guide(axes[0, 0], whole.n_particles.values, whole.cpu_seconds.values, "~ N")
    guide(axes[0, 1], whole.n_particles.values, extra_megabytes(whole), "~ N")
    axes[0, 0].set(
        xlabel="particles N",
        ylabel="CPU seconds",
        xscale="log",
        yscale="log",
        title=f"(a) one chain to t = {config.stop:g}",
    )
    axes[0, 1].set(
        xlabel="particles N",
        ylabel="peak memory above a small chain's / MB",
        xscale="log",
        yscale="log",
        title="(b)",
    )
    spans = long_enough(data, config)
    axes[0, 2].plot(spans.stop, spans.cpu_seconds, "o-", color=LOOKS["chebyshev"], label="chebyshev, whole chain")
    guide(axes[0, 2], spans.stop.values, spans.cpu_seconds.values, "~ t")
    axes[0, 2].set(
        xlabel="time span t", ylabel="CPU seconds", xscale="log", yscale="log", title=f"(c) N = {config.span_particles}"
    )
    axes[0, 0].set_ylim(bottom=1e-4)
    axes[0, 2].set_xticks(spans.stop.values, [f"{t:g}" for t in spans.stop.values])
    axes[0, 2].set_xticks([], minor=True)
    for ax in axes[0]:
        ax.legend(fontsize="small")
    figure.suptitle(
        f"$\\xi$ = {config.strength:g}, one thread{', each run in a process of its own' if config.fresh else ''}",
        fontsize="medium",
    )
    return figure


def extra_megabytes(part: xarray.Dataset) -> np.ndarray:
    """Peak memory above that of a chain of 64 in the same process, 0.1 MB where it is less: a few pages."""
    return np.maximum((part.memory - part.base_memory).values / 1e6, 0.1)


def guide(ax: Axes, x: np.ndarray, y: np.ndarray, label: str) -> None:
    """A straight line of slope 1 through the last point."""
    ends = np.array([x[0], x[-1]], dtype=float)
    ax.plot(ends, y[-1] * ends / ends[1], "k:", lw=0.8, label=label)


def long_enough(data: xarray.Dataset, config: Config) -> xarray.Dataset:
    """The runs of one chain over different time spans."""
    runs = (data.method == "chebyshev") & (data.start == WHOLE) & (data.n_particles == config.span_particles)
    return data.isel(run=np.flatnonzero(runs)).sortby("stop")


def growth(x: np.ndarray, y: np.ndarray) -> float:
    """Exponent over the last decade, or between the last two points."""
    last = x >= min(x[-1] / 10.001, x[-2]) if len(x) > 1 else x > 0
    return float(np.polyfit(np.log(x[last]), np.log(np.maximum(y[last], 1e-9)), 1)[0]) if last.sum() > 1 else math.nan


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for method, start in series(config):
        part = select(data, method, start, config.stop)
        name = f"{method}, {start}"
        for i in range(part.sizes["run"]):
            one = part.isel(run=i)
            extra = float(one.memory - one.base_memory)
            rows.append(Row(f"{name}, N = {int(one.n_particles)}: CPU seconds", float(one.cpu_seconds),
                            note=f"wall {float(one.seconds):.3g} s, peak {float(one.memory) / 1e6:.0f} MB, {extra / float(one.n_particles):.0f} "
                                 f"byte a particle, energy error {float(one.energy_error):.0e}"))  # fmt: skip
        if part.sizes["run"] > 1:
            rows.append(Row(f"{name}: growth of time, N^a", growth(part.n_particles.values, part.cpu_seconds.values)))
    spans = long_enough(data, config)
    if spans.sizes["run"] > 1:
        name = f"chebyshev, {WHOLE}, N = {config.span_particles}"
        rows.append(Row(f"{name}: growth of time, t^a", growth(spans.stop.values, spans.cpu_seconds.values)))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    kick, whole = (select(data, "chebyshev", start, config.stop).isel(run=-1) for start in (KICK, WHOLE))
    n, w = int(whole.n_particles), float(whole.highest_frequency)
    updates = n * w * config.stop / 2
    return (
        f"{n} particles to t = {config.stop:g} by 'chebyshev': {float(whole.seconds) / 60:.2f} minutes if the whole chain moves, "
        f"{float(kick.seconds) / 60:.2f} minutes after one kick,\nwhose wave reaches {2 * config.stop:g} particles: the rest is skipped, and the time "
        "left is that of the chain's bounds and its output.\n"
        f"The highest frequency bound is {w:.2f}, so that the whole chain takes {updates:.2g} stencil updates,\n{updates / float(whole.cpu_seconds) / 1e9:.2f} G a second "
        "with their four sums: less than a short chain's, which stays in cache.\n"
        "'tridiagonal' and 'modes' hold all vectors, N^2 numbers, which take between N^2 and N^3 work."
    )


SCRIPT = harness.Script("growth", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
