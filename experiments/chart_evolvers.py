"""Work against precision of every way to evolve a chain, in both precisions, from a chain of 64 to one of 100,000."""

from __future__ import annotations

import math
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import special

import torchchain as tc
from torchchain import checks
from torchchain.evolvers import chebyshev, coefficients, expansion, ode
from torchchain.evolvers.energy_guard import EnergyDriftError
from torchchain.threads import single_blas_thread


@dataclass(frozen=True)
class Wave:
    """One chain, one start and one output time."""

    name: str
    n_particles: int
    boundary: str
    stop: float
    tone: int = 0
    """of a standing wave; 0 for a kick"""
    site: int = 1
    """of the kick"""


WAVES = {
    wave.name: wave
    for wave in (
        Wave("wall kick, N = 1024, t = 875", 1024, "fixed", 875.0),
        Wave("center kick, N = 2049, t = 750", 2049, "fixed", 750.0, site=1025),
        Wave("tone 90, N = 256, t = 50", 256, "periodic", 50.0, tone=90),
        Wave("tone 90, N = 256, t = 5000", 256, "periodic", 5000.0, tone=90),
        Wave("kick, N = 64, t = 100", 64, "periodic", 100.0, site=32),
        Wave("kick, N = 100000, t = 300", 100_000, "fixed", 300.0, site=50_000),
        Wave("kick, N = 32, t = 5", 32, "periodic", 5.0, site=16),
    )
}
QUICK = "kick, N = 32, t = 5"
PHASES = (1.6, 0.8, 0.4, 0.2, 0.1, 0.05, 0.025)
"""w_max step of the methods with a step"""
TOLERANCES = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
ACCURACIES = (1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)
REACH = 1.3  # of a wave, in particles per unit time, beyond which a long chain is at rest to 1e-16
LARGEST_DECOMPOSITION = 2500


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the chains"""
    strength: float = 0.3
    """disorder xi"""
    waves: tuple[str, ...] = tuple(name for name in WAVES if name != QUICK)
    """names of the scenes"""
    repeats: int = 3
    """timed runs after a first"""
    longest: float = 0.25
    """seconds of a run after which no finer one of the method follows"""


SMOKE = Config(waves=(QUICK,), repeats=1, longest=0.002)


@dataclass(frozen=True)
class Way:
    """A method with its options, coarse to fine."""

    method: str
    options: tuple[dict[str, Any], ...]


def ways(chain: tc.Chain, stop: float) -> Iterator[Way]:
    """Every method of the registry that can treat the chain."""
    highest = float(chain.squared_frequency_bound().sqrt())
    for name, entry in tc.METHODS.items():
        if chain.boundary not in entry.boundaries or name == "damped":
            continue  # 'damped' is 'modes' in twice the size
        if "hertz" in entry.contacts and entry.damped and name != "verlet" and not _affordable(name, chain, stop):
            continue
        if "accuracy" in entry.options:
            yield Way(name, tuple({"accuracy": a} for a in ACCURACIES))
        elif "step" in entry.options:
            yield Way(name, tuple({"step": p / highest} for p in PHASES))
        elif "rtol" in entry.options:
            yield Way(name, tuple({"rtol": r} for r in TOLERANCES))
        elif chain.n_particles <= LARGEST_DECOMPOSITION:
            yield Way(name, ({},))


def _affordable(peer: str, chain: tc.Chain, stop: float) -> bool:
    """Whether a general-purpose solver gets anywhere within seconds: they spend some 0.1 ms on an evaluation at least."""
    double = chain.masses.dtype == torch.float64
    if stop <= 100 and chain.n_particles <= 1000:
        return double or peer in ("dopri5", "rk4")
    return stop <= 1000 and chain.n_particles <= 3000 and double and peer in ("dopri8", "lsoda", "rk4")


def problem(wave: Wave, masses: torch.Tensor) -> tuple[tc.Chain, tc.State]:
    chain = tc.Chain(masses, wave.boundary)
    return chain, tc.standing_wave(chain, wave.tone) if wave.tone else tc.impulse(chain, wave.site)


def distance(chain: tc.Chain, state: tc.State, reference: tc.State) -> float:
    """Square root of the energy of the difference, over that of the reference."""

    def energy(displacement: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        return (chain.masses * velocity.square()).sum() + chain.elongation(displacement).square().sum()

    off = energy(state.displacement.double() - reference.displacement, state.velocity.double() - reference.velocity)
    return float((off / energy(reference.displacement, reference.velocity)).sqrt())


def by_modes(wave: Wave, masses: torch.Tensor) -> tc.State:
    """The state by eigen-decomposition: of the whole chain, or of the part that a kick reaches."""
    n = wave.n_particles
    first, last = 0, n
    if n > LARGEST_DECOMPOSITION:
        half = math.ceil(REACH * wave.stop) + 40
        first, last = wave.site - half, wave.site + half
    part = Wave(wave.name, last - first, wave.boundary, wave.stop, wave.tone, wave.site - first)
    chain, state = problem(part, masses[first:last])
    method = "tridiagonal" if wave.boundary == "fixed" else "modes"
    final = tc.evolve(chain, state, [wave.stop], method).final
    pad = (first, n - last)
    return tc.State(*(torch.nn.functional.pad(x, pad) for x in (final.displacement, final.velocity)))


def bessel_error(wave: Wave) -> float:
    """Error of 'chebyshev' on the ordered chain, where sums of Bessel functions over images are exact."""
    if wave.tone:
        w = 2 * math.sin(math.pi * wave.tone / wave.n_particles)
        chain, state = problem(wave, torch.ones(wave.n_particles, dtype=torch.float64))
        final = tc.evolve(chain, state, [wave.stop], "chebyshev").final
        exact = tc.State(
            state.displacement * math.cos(w * wave.stop), -w * state.displacement * math.sin(w * wave.stop)
        )
        return distance(chain, final, exact)
    n = wave.n_particles
    chain, state = problem(wave, torch.ones(n, dtype=torch.float64))
    final = tc.evolve(chain, state, [wave.stop], "chebyshev").final
    order = np.arange(2 * math.ceil(REACH * wave.stop) + 80)
    table = special.jv(order, 2 * wave.stop)

    def jv(at: np.ndarray) -> np.ndarray:
        at = np.abs(at)
        return np.where(at < len(table), table[np.minimum(at, len(table) - 1)], 0.0)

    p = np.arange(1, n + 1)
    velocity = np.zeros(n)
    period = n if wave.boundary == "periodic" else 2 * (n + 1)
    images = range(-math.ceil(2 * wave.stop / period) - 1, math.ceil(2 * wave.stop / period) + 2)
    for image in images:
        velocity += jv(2 * (p - wave.site - period * image))
        if wave.boundary == "fixed":
            velocity -= jv(2 * (p + wave.site - period * image))
    off = final.velocity.numpy() / 0.01 - velocity
    return float(np.sqrt(np.square(off).sum()))


def counted(
    chain: tc.Chain, method: str, options: dict[str, Any], stop: float, run: Callable[[], tc.State]
) -> tuple[tc.State, float]:
    """A run, and its stencil updates per particle; not a number for decompositions."""
    original, calls = ode._Motion.__call__, 0

    def counting(self: Any, t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return original(self, t, y)

    with mock.patch.object(ode._Motion, "__call__", counting):
        final = run()
    if method == "chebyshev":
        tolerance = max(options["accuracy"] / expansion.SEGMENTS, expansion.ROUNDING)
        highest = float(chebyshev.highest_frequency(chain))
        leaps = math.ceil(highest * stop / expansion.LEAP)
        table = coefficients.coefficients_of(np.array([highest]), np.array([stop / leaps]), tolerance)
        return final, 2.0 * leaps * table.shape[1]  # of displacement and of velocity
    if method in ("verlet", "symplectic4"):
        return final, math.ceil(stop / options["step"]) * (1.0 if method == "verlet" else 4.0)
    return final, float(calls) if calls else math.nan


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', whose time this experiment measures", repr(device))
    with single_blas_thread():  # processor time of one thread is what other processes disturb least
        return _measure(config)


def _measure(config: Config) -> xarray.Dataset:
    for dtype in (torch.float64, torch.float32):  # load and compile what the methods use
        chain, state = problem(WAVES[QUICK], torch.ones(WAVES[QUICK].n_particles, dtype=dtype))
        for method in ("chebyshev", "verlet", "symplectic4"):
            tc.evolve(chain, state, [1.0], method)
    entries: list[dict[str, Any]] = []
    errors = []
    for name in config.waves:
        wave = WAVES[checks.choice("waves", name, WAVES)]
        # Masses that float32 holds exactly: both precisions have the same chain.
        masses = tc.Disorder(strength=config.strength).masses(wave.n_particles, 1, config.seed)[0].float().double()
        chain, state = problem(wave, masses)
        exact = by_modes(wave, masses)
        other = tc.evolve(chain, state, [wave.stop], "chebyshev", accuracy=1e-15).final
        errors.append((distance(chain, other, exact), bessel_error(wave)))
        for dtype in (torch.float64, torch.float32):
            for way in ways(problem(wave, masses.to(dtype))[0], wave.stop):
                decomposed = way.method in ("modes", "tridiagonal")
                entries += _curve(config, wave, masses.to(dtype), way, other if decomposed else exact, chain)
    data = {key: ("run", [entry[key] for entry in entries]) for key in entries[0]}
    data["reference_error"] = ("scene", [disagreement for disagreement, _ in errors])
    data["bessel_error"] = ("scene", [off for _, off in errors])
    return xarray.Dataset(data, {"scene": list(config.waves)})


def _curve(
    config: Config, wave: Wave, masses: torch.Tensor, way: Way, reference: tc.State, exact_chain: tc.Chain
) -> list[dict[str, Any]]:
    """A method from coarse to fine, until a run takes too long."""
    chain, state = problem(wave, masses)
    entries = []
    for options in way.options:

        def run(options: dict[str, Any] = options) -> tc.State:
            return tc.evolve(chain, state, [wave.stop], way.method, **options).final

        samples = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # blurred phases are what is measured
            try:
                began = time.process_time()
                final, updates = counted(chain, way.method, options, wave.stop, run)
                first = time.process_time() - began
            except (EnergyDriftError, ode.IntegrationError, checks.FieldError):
                continue  # a step or a tolerance that the method refuses
            if first > 2 * config.longest:
                samples.append(first)  # far beyond what loading takes, which is done by the coarser runs
            for _ in range(0 if samples else config.repeats if first < config.longest else 1):
                began = time.process_time()
                run()
                samples.append(time.process_time() - began)
        entries.append(
            {
                "wave": wave.name,
                "method": way.method,
                "precision": str(masses.dtype).removeprefix("torch."),
                "option": ", ".join(f"{key}={value:.3g}" for key, value in options.items()),
                "error": distance(exact_chain, final, reference),
                "seconds": statistics.median(samples),
                "evaluations": updates,
                "updates": updates * wave.n_particles,
                "flops": _flops(way.method, wave.n_particles),
            }
        )
        if min(first, *samples) > config.longest:
            break
    return entries


def _flops(method: str, n: int) -> float:
    """Of LAPACK's decomposition with vectors, counted by its leading term; not a number for stencils."""
    return {"modes": 9.0, "tridiagonal": 4 / 3}.get(method, math.nan) * n**3


COLORS = {"modes": "C0", "tridiagonal": "C1", "chebyshev": "C2", "verlet": "C3", "symplectic4": "C4"}


def _look(method: str) -> dict[str, Any]:
    others = [name for name in tc.METHODS if name not in COLORS and name != "damped"]
    if method in COLORS:
        return {"color": COLORS[method], "linewidth": 1.8, "marker": "o"}
    i = others.index(method) if method in others else 0
    return {"color": f"{0.15 + 0.055 * i:.2f}", "linewidth": 0.8, "marker": "^v<>spPXd*h8"[i % 12]}


def draw(data: xarray.Dataset, config: Config) -> Figure:
    columns = min(3, len(config.waves))
    rows = math.ceil(len(config.waves) / columns)
    figure, axes = harness.panels(2 * rows, columns, width=4.9, height=3.5)
    for i, name in enumerate(config.waves):
        row, column = divmod(i, columns)
        part = data.isel(run=data.wave.values == name)
        _panel(axes[row, column], part, "seconds", f"{name}", float(data.reference_error[i]))
        _panel(axes[rows + row, column], part, "updates", f"{name}", float(data.reference_error[i]))
    for ax in axes[:rows, :].flat:
        ax.set_xlabel("processor seconds, median")
    for ax in axes[rows:, :].flat:
        ax.set_xlabel("evaluations $\\times$ particles")
    for ax in axes[:, 0]:
        ax.set_ylabel("relative error (energy norm)")
    shown = [name for name in tc.METHODS if name in set(data.method.values)]
    handles = [axes[0, 0].plot([], [], label=name, linestyle="-", markersize=4, **_look(name))[0] for name in shown]
    hollow = {"linestyle": ":", "marker": "o", "markersize": 4, "markerfacecolor": "none"}
    handles.append(axes[0, 0].plot([], [], "0.3", label="float32", **hollow)[0])
    handles.append(axes[0, 0].plot([], [], "k", linestyle="--", linewidth=0.8, label="reference's own error")[0])
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if columns == 1 else 5)
    return figure


def _panel(ax: Axes, part: xarray.Dataset, cost: str, title: str, floor: float) -> None:
    for method in dict.fromkeys(part.method.values):
        for precision, line in (("float64", "-"), ("float32", ":")):
            curve = part.isel(run=(part.method.values == method) & (part.precision.values == precision))
            good = np.isfinite(curve[cost].values) & (curve.error.values < 3)
            if good.any():
                face = {} if precision == "float64" else {"markerfacecolor": "none"}
                ax.plot(
                    curve[cost].values[good], np.maximum(curve.error.values[good], 1e-16), linestyle=line, markersize=4,
                    **_look(method), **face,
                )  # fmt: skip
    ax.axhline(floor, color="k", linestyle="--", linewidth=0.8)
    ax.set(xscale="log", yscale="log", title=title, ylim=(1e-15, 3))
    ax.title.set_fontsize("medium")
    ax.xaxis.set_minor_formatter("")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, name in enumerate(config.waves):
        part = data.isel(run=data.wave.values == name)
        rows.append(Row(f"{name}: reference's error", float(data.reference_error[i]), note=f"against Bessel functions on the ordered chain {float(data.bessel_error[i]):.1e}"))  # fmt: skip
        for accuracy in (1e-2, 1e-6, 1e-10):
            found = harness.fastest(part, accuracy)
            if found is not None:
                peer = harness.fastest(part.isel(run=~np.isin(part.method.values, list(COLORS))), accuracy)
                ratio = (
                    ""
                    if peer is None
                    else f"; best of torchdiffeq and scipy: {peer.method.values}, {float(peer.seconds / found.seconds):.0f} times as long"
                )
                rows.append(
                    Row(
                        f"{name}: seconds for error {accuracy:.0e}", float(found.seconds),
                        note=f"{found.method.values} {found.option.values} {found.precision.values}, error {float(found.error):.0e}{ratio}",
                    )
                )  # fmt: skip
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"measured: relative error of the last state in the energy norm, median of {config.repeats} runs after a first, "
        f"processor time of one thread; a curve ends after its first run of more than {config.longest:g} s.\n"
        "Reference: eigen-decomposition (of the part that a kick reaches in the longest chain); for the decompositions\n"
        "themselves, Chebyshev at accuracy 1e-15. The reference's error is how far the two are apart.\n"
        "Updates are evaluations of the stencil times particles (Chebyshev: displacement and velocity each); the flops of the\n"
        "decompositions, 9 N^3 and 4/3 N^3, are in the data. float32 'chebyshev' computes in float64 on the CPU."
    )


SCRIPT = harness.Script("chart_evolvers", Config(), SMOKE, measure, draw, compare, explain, pieces="waves")


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
