"""Numbers that do not come from the paper: exact solutions, theorems and other people's results, beside the library's."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import harness
import numpy as np
import torch
import xarray
from fig04 import PowerLaw, power_law, restored, stored
from fig06 import BALLISTIC
from fig07 import local_slopes
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import special
from torch import Tensor

import torchchain as tc
from torchchain import plots
from torchchain.ensemble.fused import energy_moments

METHODS = ("modes", "tridiagonal", "chebyshev")
KICKS = {
    "momentum, center": 1.5,
    "displacement, center": 0.5,
    "momentum, wall": 0.5,
}  # exponents of r^2 for t to infinity
WALL_WIDTH = 0.5 - BALLISTIC**2
LISTED = (0.4, 0.8, 1.2, 2**0.5, 1.6)  # frequencies in the table
CENTER = (
    8 * (math.gamma(0.75) / math.gamma(0.25)) ** 2
)  # of the weak-disorder formula is right at k = pi / 2, w = sqrt(2)


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the ensembles"""
    ordered_particles: int = 1025
    """the ordered chain, odd"""
    ordered_stop: float = 400.0
    """last time of the ordered chain kicked in its middle; no wave reaches the ends"""
    lyapunov_strengths: tuple[float, ...] = (0.1, 0.3, 0.5)
    """disorders xi of the Lyapunov exponents"""
    lyapunov_frequencies: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.3, 1.35, 2**0.5, 1.48, 1.6, 1.7, 1.8)
    """and their frequencies"""
    lyapunov_particles: int = 100_000
    """length of each chain; its 20 realizations and the bias of the start set the error"""
    count_particles: int = 256
    """chains whose modes are counted one by one"""
    spread_strength: float = 0.5
    """disorder xi of the spreading"""
    spread_particles: int = 8193
    """chains of the spreading, odd"""
    spread_stop: float = 4000.0
    """last time of the spreading"""
    spread_realizations: int = 64
    """chains of the spreading"""


SMOKE = Config(
    ordered_particles=257, ordered_stop=80.0, lyapunov_strengths=(0.3,), lyapunov_particles=2000, count_particles=32,
    spread_particles=513, spread_stop=200.0, spread_realizations=4,
)  # fmt: skip


def ordered_chain(n_particles: int, device: str) -> tc.Chain:
    return tc.Chain(torch.ones(n_particles, dtype=torch.float64, device=device), boundary="fixed")


def bessel(config: Config, device: str) -> dict[str, Any]:
    """Kick in the middle of the ordered chain: v_n = v_0 J_2n(2t), n counted from the kicked particle."""
    chain = ordered_chain(config.ordered_particles, device)
    middle = (config.ordered_particles + 1) // 2
    times = torch.linspace(0, config.ordered_stop, 41, dtype=torch.float64, device=device)
    distance = np.abs(np.arange(1, config.ordered_particles + 1) - middle)
    exact = special.jv(2 * distance, 2 * times.cpu().numpy()[:, None])
    errors = []
    for method in METHODS:
        velocity = tc.evolve(chain, tc.impulse(chain, middle, 1.0), times, method=method).velocity
        errors.append(np.abs(velocity.cpu().numpy() - exact).max(-1))
    front = velocity[-1].max().item() * config.ordered_stop ** (1 / 3)
    widths = []
    for definition, shift in (("bond", 0.0), ("site", 0.5)):
        width = energy_moments(chain, tc.impulse(chain, middle), times, definition).width.cpu().numpy()
        t = times.cpu().numpy()
        widths.append(width - (t**2 / 2 - shift * t + 1 / 8))
    return {
        "bessel_error": (("evolver", "ordered_time"), np.array(errors), {"long_name": "largest error of v / v_0"}),
        "middle_width": (
            ("definition", "ordered_time"),
            np.array(widths),
            {"long_name": "r^2 less its long-time form"},
        ),
        "front_height": ((), front, {"long_name": "t^(1/3) v / v_0 at the front"}),
    }


def wall(config: Config, device: str) -> dict[str, Any]:
    """Kick beside the fixed wall of the ordered chain: R / t and r^2 / t^2."""
    chain = ordered_chain(config.ordered_particles, device)
    times = torch.from_numpy(np.geomspace(2.0, 0.9 * config.ordered_particles, 60)).to(device)
    moments = energy_moments(chain, tc.impulse(chain, 1), times)
    t = times.cpu().numpy()
    return {
        "wall_time": ("wall_time", t, harness.TIME),
        "wall_center": ("wall_time", moments.center.cpu().numpy() / t, {"long_name": "R / t"}),
        "wall_width": ("wall_time", moments.width.cpu().numpy() / t**2, {"long_name": "r^2 / t^2"}),
    }


def lyapunov(config: Config) -> dict[str, Any]:
    """Lyapunov exponents against the weak-disorder formula."""
    w = torch.tensor(config.lyapunov_frequencies, dtype=torch.float64)
    measured = [
        tc.lyapunov_exponent(tc.Disorder(strength=xi), w, config.lyapunov_particles, 20, config.seed)
        for xi in config.lyapunov_strengths
    ]
    theory = [tc.weak_disorder_lyapunov(xi, w).numpy() for xi in config.lyapunov_strengths]
    axes = ("strength", "frequency")
    return {
        "lyapunov": (axes, np.array([m.value.numpy() for m in measured]), {"units": "1 / particle"}),
        "lyapunov_stderr": (axes, np.array([m.stderr.numpy() for m in measured]), {"units": "1 / particle"}),
        "lyapunov_weak": (axes, np.array(theory), {"units": "1 / particle", "long_name": "Matsuda and Ishii"}),
    }


def counts(config: Config) -> dict[str, Any]:
    """Modes below a frequency: Sturm counts against eigenvalues, the ordered frequencies, and the low end."""
    n, strong = config.count_particles, tc.Disorder(strength=0.3)
    masses = strong.masses(n, 10, config.seed)
    stiffness = strong.stiffnesses(n + 1, 10, config.seed)
    chains = {
        "fixed": tc.Chain(masses, "fixed"),
        "ring": tc.Chain(masses, "periodic"),
        "stiffness": tc.Chain(masses, "fixed", stiffness),
    }
    compared, differing = 0, 0
    for chain in chains.values():
        exact = tc.normal_modes(chain).frequencies
        w = ((exact[0, 1:] + exact[0, :-1]) / 2).clamp(min=1e-3)  # between the modes of the first chain
        counted = tc.count_modes_below(chain, w)
        expected = (exact[..., None] < w).sum(-2)
        compared += counted.numel()
        differing += int((counted != expected).sum())
    j = torch.arange(1, n + 1, dtype=torch.float64)
    unit = torch.ones(n, dtype=torch.float64)
    fixed = tc.normal_modes(tc.Chain(unit, "fixed")).frequencies - 2 * torch.sin(j * math.pi / (2 * (n + 1)))
    ring = tc.normal_modes(tc.Chain(unit, "periodic")).frequencies
    ring_error = (
        ring.square() - (2 * torch.sin(math.pi * j / n)).square().sort().values
    )  # the zero mode's w is rounding
    low = torch.linspace(0.05, 2.4, 48, dtype=torch.float64)
    disorders = [tc.Disorder(strength=xi) for xi in (0.3, 0.5)]
    states = [tc.integrated_density_of_states(disorder, low, 4096, 20, config.seed) for disorder in disorders]
    mass = [disorder.masses(4096, 20, config.seed).mean().item() for disorder in disorders]
    return {
        "counts_compared": ((), compared),
        "counts_differing": ((), differing),
        "ordered_frequency_error": ((), max(fixed.abs().max().item(), ring_error.abs().max().item())),
        "low_frequency": ("low_frequency", low.numpy()),
        "states": (("states_strength", "low_frequency"), np.array([s.value.numpy() for s in states]),
                   {"long_name": "share of the modes below w"}),
        "states_stderr": (("states_strength", "low_frequency"), np.array([s.stderr.numpy() for s in states])),
        "states_mass": ("states_strength", mass, {"units": "mean mass", "long_name": "realized mean mass"}),
        "states_strength": ("states_strength", [0.3, 0.5]),
    }  # fmt: skip


def spreading(config: Config, device: str) -> dict[str, Any]:
    """Width r^2 (bond energy) of every realization after the three kicks, and power laws through its two halves."""
    times = np.geomspace(config.spread_stop / 400, config.spread_stop, 48)
    middle = (config.spread_particles + 1) // 2
    widths: dict[str, list[Tensor]] = {name: [] for name in KICKS}
    for first in range(0, config.spread_realizations, 20):
        numbers = range(first, min(first + 20, config.spread_realizations))
        masses = tc.Disorder(strength=config.spread_strength).masses(config.spread_particles, numbers, config.seed)
        chain = tc.Chain(masses.to(device), "fixed")
        at_center, at_wall = tc.impulse(chain, middle), tc.impulse(chain, 1)
        plucked = tc.State(at_center.velocity, at_center.displacement)
        for name, state in zip(KICKS, (at_center, plucked, at_wall), strict=True):
            moments = energy_moments(chain, state, torch.from_numpy(times).to(device), "bond")
            widths[name].append(moments.width.cpu())
    every = {name: torch.cat(parts) for name, parts in widths.items()}
    edge = config.spread_stop / 10
    fits = [power_law(times, values, window) for values in every.values()
            for window in ((edge / 10, edge), (edge, config.spread_stop))]  # fmt: skip
    return {
        "spread_time": ("spread_time", times, harness.TIME),
        "spread_width": (("kick", "spread_time"), np.array([v.mean(0).numpy() for v in every.values()])),
        "kick": ("kick", list(KICKS)),
        **stored(fits, "fit_of"),
    }


def measure(config: Config, device: str) -> xarray.Dataset:
    parts = {
        **bessel(config, device), **wall(config, device), **lyapunov(config), **counts(config), **spreading(config, device),
        "ordered_time": ("ordered_time", np.linspace(0, config.ordered_stop, 41), harness.TIME),
        "evolver": ("evolver", list(METHODS)),
        "definition": ("definition", ["bond", "site"]),
        "strength": ("strength", list(config.lyapunov_strengths)),
        "frequency": ("frequency", list(config.lyapunov_frequencies)),
    }  # fmt: skip
    coords = {name: value for name, value in parts.items() if value[0] == name}
    return xarray.Dataset({name: value for name, value in parts.items() if name not in coords}, coords=coords)


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 3, width=5.0, height=3.9)
    ax = axes[0, 0]
    for i, method in enumerate(METHODS):
        ax.plot(
            data.ordered_time, np.maximum(data.bessel_error.sel(evolver=method), 1e-17), f"C{i}.-", lw=0.8, label=method
        )
    ax.axhline(1e-12, color="k", lw=0.6, ls=":")
    ax.set(
        xlabel=plots.TIME_LABEL,
        ylabel="largest error of v / v$_0$",
        yscale="log",
        ylim=(1e-17, 1e-10),
        title="(a) ordered chain: v$_n$ = v$_0$ J$_{2n}$(2t)",
    )
    ax.legend(fontsize="small")
    ax = axes[0, 1]
    for name, limit, text in (("wall_center", BALLISTIC, "R / t"), ("wall_width", WALL_WIDTH, "r$^2$ / t$^2$")):
        ax.plot(data.wall_time, np.abs(data[name] / limit - 1), label=text)
    ax.set(
        xlabel=plots.TIME_LABEL,
        ylabel="distance from the limit, relative",
        xscale="log",
        yscale="log",
        title="(b) ordered chain, kick beside the wall",
    )
    ax.legend(fontsize="small")
    middle_width(axes[0, 2], data)
    ax = axes[1, 0]
    for i, xi in enumerate(config.lyapunov_strengths):
        part = data.isel(strength=i)
        ratio, error = part.lyapunov / part.lyapunov_weak, part.lyapunov_stderr / part.lyapunov_weak
        ax.errorbar(
            data.frequency,
            ratio,
            error,
            fmt="o-",
            ms=4,
            lw=0.8,
            capsize=2,
            color=f"C{i}",
            mfc="none",
            label=f"$\\xi$ = {xi:g}",
        )
    ax.axhline(1, color="k", lw=0.6, ls=":")
    ax.plot(math.sqrt(2), CENTER, "k*", ms=9, label="weak disorder at k = $\\pi$/2: 0.914")
    ax.set(
        xlabel=r"frequency $\omega$",
        ylabel="Lyapunov exponent / weak-disorder formula",
        ylim=(0.5, 1.2),
        title="(d) Matsuda and Ishii 1970",
    )
    ax.legend(fontsize="small", loc="lower left")
    ax = axes[1, 1]
    for i, xi in enumerate(data.states_strength.values):
        plots.curve(
            ax, data.low_frequency.values, data.states.values[i], data.states_stderr.values[i], label=f"$\\xi$ = {xi:g}"
        )
    w = data.low_frequency.values
    ax.plot(w, 2 / np.pi * np.arcsin(np.minimum(w / 2, 1)), "k--", lw=0.8, label="ordered")
    ax.plot(w[w < 2], w[w < 2] / np.pi, "k:", lw=0.8, label=r"$\omega / \pi$")
    ax.set(xlabel=r"frequency $\omega$", ylabel=r"share of modes below $\omega$", title="(e) density of states")
    ax.legend(fontsize="small")
    spreading_slopes(axes[1, 2], data, config)
    return figure


def middle_width(ax: Axes, data: xarray.Dataset) -> None:
    labels = {"bond": "bond: r$^2$ - t$^2$/2 - 1/8", "site": "site: r$^2$ - t$^2$/2 + t/2 - 1/8"}
    for definition, label in labels.items():
        ax.plot(
            data.ordered_time[1:], np.abs(data.middle_width.sel(definition=definition))[1:], ".-", lw=0.8, label=label
        )
    ax.set(
        xlabel=plots.TIME_LABEL,
        ylabel="absolute value",
        xscale="log",
        yscale="log",
        title="(c) ordered chain, kick in the middle",
    )
    ax.legend(fontsize="small")


def spreading_slopes(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    times = data.spread_time.values
    for i, (name, limit) in enumerate(KICKS.items()):
        ax.plot(*local_slopes(times, data.spread_width.values[i], 40), color=f"C{i}", label=name)
        ax.axhline(limit, color=f"C{i}", lw=0.8, ls=(i, (2, 3)))
    ax.set(
        xlabel=plots.TIME_LABEL,
        ylabel=r"d log $r^2$ / d log $t$",
        xscale="log",
        xlim=(times[0], times[-1]),
        ylim=(0, 2.2),
    )
    ax.set_title(f"(f) spreading, $\\xi$ = {config.spread_strength:g}")
    ax.legend(fontsize="small")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = [Row(f"kick in the middle, {method}: largest error of v / v0 up to t = {config.ordered_stop:g}",
                float(data.bessel_error.sel(evolver=method).max()), note="against J_2n(2t)") for method in METHODS]  # fmt: skip
    last = data.isel(ordered_time=-1, wall_time=-1)
    end = float(last.wall_time)
    rows += [
        Row(f"kick in the middle: t^(1/3) v / v0 at the front, t = {config.ordered_stop:g}", float(data.front_height), note="0.536"),
        *(Row(f"kick in the middle: r^2 less its long-time form ({name} energy), t = {config.ordered_stop:g}",
              float(last.middle_width.sel(definition=name)), note=form)
          for name, form in (("bond", "form t^2/2 + 1/8"), ("site", "form t^2/2 - t/2 + 1/8"))),
        Row(f"kick beside the wall: R / t at t = {end:g}", float(last.wall_center), note=f"32 / (15 pi) = {BALLISTIC:.6f}"),
        Row(f"kick beside the wall: r^2 / t^2 at t = {end:g}", float(last.wall_width), note=f"1/2 - (32 / (15 pi))^2 = {WALL_WIDTH:.7f}"),
    ]  # fmt: skip
    for i, xi in enumerate(config.lyapunov_strengths):
        part = data.isel(strength=i)
        for j, w in enumerate(config.lyapunov_frequencies):
            if not any(abs(w - listed) < 1e-9 for listed in LISTED):
                continue
            gamma, error, weak = (float(part[name][j]) for name in ("lyapunov", "lyapunov_stderr", "lyapunov_weak"))
            rows.append(Row(f"xi = {xi:g}, w = {w:.4g}: Lyapunov exponent / weak-disorder formula", gamma / weak, error / weak,
                            note=f"localization length {1 / gamma:.4g}" + (f"; {CENTER:.4f} expected" if w == 2**0.5 and xi < 0.2 else "")))  # fmt: skip
    rows += [
        Row(f"Sturm counts that differ from eigenvalue counts, of {int(data.counts_compared)}", float(data.counts_differing)),
        Row("ordered chains: largest error of a frequency", float(data.ordered_frequency_error), note="2 sin(j pi / (2 (N+1))), 2 |sin(pi j / N)|"),
    ]  # fmt: skip
    for i, xi in enumerate(data.states_strength.values):
        for j in (0, 3, 9):
            w = float(data.low_frequency[j])
            rows.append(Row(f"xi = {xi:g}, w = {w:.3g}: share of the modes below w / (w / pi)", float(data.states[i, j]) * np.pi / w,
                            float(data.states_stderr[i, j]) * np.pi / w, note=f"{float(data.states_mass[i]) ** 0.5:.4f} for w to 0, the root of the mean mass; whole counts blur {np.pi / w / 8192:.4f}"))  # fmt: skip
    for (name, limit), pair in zip(KICKS.items(), pairs(data), strict=True):
        rows += [Row(row.quantity, row.measured, row.stderr, note=f"{row.note}; {limit:g} for t to infinity")
                 for fit in pair for row in fit.rows(f"{name}: r^2 ~ t^a")]  # fmt: skip
    return rows


def pairs(data: xarray.Dataset) -> list[tuple[PowerLaw, PowerLaw]]:
    """The early and the late fit of each kick."""
    fits = restored(data)
    return list(zip(fits[::2], fits[1::2], strict=True))


def explain(data: xarray.Dataset, config: Config) -> str:
    lines = []
    for (name, limit), (early, late) in zip(KICKS.items(), pairs(data), strict=True):
        there = abs(late.exponent - limit) <= 3 * late.stderr and not late.bends
        state = (
            "is there within its error"
            if there
            else "is on its way: a crossover, which no fit at these times turns into a limit"
        )
        lines.append(
            f"{name}: {early.exponent:.2f}, then {late.exponent:.2f} a decade later, limit {limit:g}; {state}."
        )
    return (
        "Sources: Matsuda and Ishii, Prog. Theor. Phys. Suppl. 45, 56 (1970); at k = pi / 2 Kappus and Wegner, Z. Phys. B 45, 15 (1981) and Derrida and\n"
        "Gardner, J. Physique 45, 1283 (1984); w / pi: Dyson, Phys. Rev. 92, 1331 (1953); spreading: Lepri, Schilling and Aubry, Phys. Rev. E 82, 056602 (2010).\n"
        "The weak-disorder formula is the first term in xi^2. At w = sqrt(2) it is wrong however weak the disorder is: there the chain is the\n"
        f"Anderson model at its band center, and {CENTER:.4f} of it is right.\n" + "\n".join(lines)
    )


SCRIPT = harness.Script("outside_numbers", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
