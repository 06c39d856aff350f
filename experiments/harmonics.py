"""Energy that Hertz contacts mix: second harmonic, triads of bands of frequency, and the time to equipartition."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass
from itertools import cycle

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.ensemble.contact_models import OPENING, linear_error, quadratic_error
from torchchain.mixing import FrequencyBands, TriadFit, fit_triads, measure_mixing


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the ensembles"""
    n_particles: int = 512
    """particles per chain"""
    realizations: int = 16
    """chains in each ensemble"""
    kind: str = "normal"
    """of the mass disorder"""
    strength: float = 0.3
    """disorder xi"""
    n_bands: int = 12
    """bands of frequency"""
    top: float = 0.0
    """upper edge of the last band; 0: above 98 % of the modes"""
    amplitudes: tuple[float, ...] = (0.025, 0.05, 0.1, 0.2)
    """root mean square elongations of the starts from which G is fitted"""
    tests: tuple[float, ...] = (0.025, 0.05, 0.1, 0.2)
    """those of the held-out starts"""
    pairs: tuple[str, ...] = ("4:0.5 6:0.5", "3:0.3 7:0.7", "2:0.5 9:0.5")
    """held-out starts: bands, counted from 1, and their shares"""
    amplitude: float = 0.02
    """of the traveling wave in the ordered chain, in initial overlaps"""
    tone: int = 10
    """its tone of 128 particles"""
    ladder_time: float = 200.0
    """time at which linear contacts and triads are compared with Hertz chains"""
    allowed: float = 0.03
    """total variation at which either stops being enough"""
    slow_stop: float = 32.0
    """end of the runs to equipartition, in units of 1 / amplitude^2"""


SMOKE = Config(n_particles=32, realizations=6, n_bands=5, amplitudes=(0.12, 0.17), tests=(0.2,), pairs=("2:0.5 3:0.5",), slow_stop=16.0)  # fmt: skip


def scene(config: Config, seed: int) -> tc.Scene:
    return tc.Scene(
        n_particles=config.n_particles, boundary="fixed", n_bands=1, realizations=config.realizations, seed=seed,
        disorder=tc.Disorder(config.kind, config.strength),
    )  # fmt: skip


def second_harmonic(config: Config) -> dict[str, tuple[str, np.ndarray]]:
    """Amplitude of tone 2 n after a traveling wave of tone n, measured and in closed form."""
    n, k = 128, 2 * math.pi * config.tone / 128
    chain = tc.Chain(torch.ones(n, dtype=torch.float64), contact="hertz")
    phase = k * torch.arange(n, dtype=torch.float64)
    speed = 2 * math.sin(k / 2)
    state = tc.State(config.amplitude * phase.cos(), config.amplitude * speed * phase.sin())
    beat = 4 * math.sin(k / 2) * (1 - math.cos(k / 2))
    times = torch.linspace(0, 4 * math.pi / beat, 401, dtype=torch.float64)
    path = tc.evolve(chain, state, times, method="symplectic4", step=0.05)
    double = 2 * math.sin(k)  # of the harmonic; its wave to the right has w u = i v
    wave = torch.fft.fft(path.displacement)[:, 2 * config.tone] / n
    motion = torch.fft.fft(path.velocity)[:, 2 * config.tone] / n
    right = (wave - motion / (1j * double)).abs()  # of exp(-i w t): v = -i w u; twice the half
    law = 2 * config.amplitude**2 / 8 / math.tan(k / 2) * np.abs(np.sin(beat * times.numpy() / 2))
    return {"harmonic": ("beat_time", right.numpy()), "harmonic_law": ("beat_time", law), "beat_time": ("beat_time", times.numpy())}  # fmt: skip


def shares(config: Config) -> torch.Tensor:
    found = torch.zeros(len(config.pairs), config.n_bands, dtype=torch.float64)
    for row, words in zip(found, config.pairs, strict=True):
        for word in words.split():
            band, share = word.split(":")
            row[int(band) - 1] = float(share)
    return found


def measure(config: Config, device: str) -> xarray.Dataset:
    chain = scene(config, config.seed).chain(range(min(8, config.realizations)))
    bands = FrequencyBands(config.n_bands, config.top) if config.top else FrequencyBands.covering(chain, config.n_bands)
    data = second_harmonic(config)
    found: dict[float, TriadFit] = {
        a: fit_triads(measure_mixing(scene(config, config.seed + 10 * i), a, bands))
        for i, a in enumerate(config.amplitudes)
    }
    data["coupling"] = ("amplitude", "triad"), np.stack([f.model.coupling.detach().numpy() for f in found.values()])
    data["coupling_stderr"] = ("amplitude", "triad"), np.stack([f.stderr.numpy() for f in found.values()])
    model = found[config.amplitudes[(len(config.amplitudes) - 1) // 2]].model
    data["coupling_total_stderr"] = ("amplitude",), np.array([float(f.total_stderr) for f in found.values()])
    data["triads"] = ("triad", "wave"), model.triads.numpy() + 1
    slow = torch.linspace(0, 8, 33, dtype=torch.float64)
    spent = []
    for i, a in enumerate(config.tests):
        own, began = scene(config, config.seed + 1 + 10 * i), time.process_time()
        test = measure_mixing(own, a, bands, starts=shares(config), times=slow / a**2)
        half = time.process_time()
        predicted = model.solve(test.mean[:, 0], test.times).detach()
        spent.append((half - began) / (time.process_time() - half))
        for name, values in (("chains", test.mean), ("chains_stderr", test.stderr), ("triads_energy", predicted)):
            data[f"{name}_{i}"] = ("start", "slow_time", "band"), (values / a**2).numpy()
        data[f"opened_{i}"] = ("start",), test.opened.numpy()
    data["cost_ratio"] = ("test",), np.array(spent)
    one = torch.zeros(1, config.n_bands, dtype=torch.float64)
    one[0, config.n_bands // 3] = 1
    late = torch.linspace(0, config.slow_stop, 97, dtype=torch.float64)
    distance = []
    for a in config.amplitudes:
        run = measure_mixing(scene(config, config.seed + 2), a, bands, starts=one, times=late / a**2)
        each = run.energies[:, 0] / a**2
        even = run.density / run.density.sum()
        distance.append(
            torch.stack([0.5 * (half.mean(0) - even).abs().sum(-1) for half in (each, each[::2], each[1::2])]).numpy()
        )
    solved = 0.5 * (model.solve(one * 0.01, late / 0.01).detach()[0] / 0.01 - even).abs().sum(-1)
    data["distance"] = ("amplitude", "half", "late"), np.stack(distance)
    data["distance_model"] = ("late",), solved.numpy()
    coords = {
        "amplitude": list(config.amplitudes),
        "slow_time": slow.numpy(),
        "late": late.numpy(),
        "band": np.arange(1, config.n_bands + 1),
    }
    return xarray.Dataset(data, coords=coords)


def equipartition_times(data: xarray.Dataset) -> np.ndarray:
    """When the distance from equipartition has fallen to three quarters of its start, (amplitude, half), NaN if it has not."""
    late = data.late.values
    found = np.full(data.distance.shape[:2], np.nan)
    for i, a in enumerate(data.amplitude.values):
        for j, path in enumerate(data.distance.values[i]):
            below = np.flatnonzero(path < 0.75 * path[0])
            if len(below) and below[0]:
                k = below[0]
                part = (path[k - 1] - 0.75 * path[0]) / (path[k - 1] - path[k])
                found[i, j] = (late[k - 1] + part * (late[k] - late[k - 1])) / a**2
    return found


def ladder(data: xarray.Dataset, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Total variation of a linear model and of triads from Hertz chains at one time, mean over starts, (test,)."""
    found = []
    for i, a in enumerate(config.tests):
        chains, triads = data[f"chains_{i}"].values, data[f"triads_energy_{i}"].values
        paths = (0.5 * np.abs(each - chains).sum(-1).mean(0) for each in (chains[:, :1], triads))
        found.append([np.interp(config.ladder_time * a**2, data.slow_time.values, path) for path in paths])
    linear, quadratic = np.array(found).T
    return linear, quadratic


def edge(elongations: np.ndarray, errors: np.ndarray, allowed: float) -> float:
    """Elongation at which the error is the allowed one, between those measured on logarithmic scales; NaN if it is not reached."""
    above = np.flatnonzero(errors > allowed)
    if not len(above) or not above[0]:
        return math.nan
    part = slice(above[0] - 1, above[0] + 1)
    return float(np.exp(np.interp(math.log(allowed), np.log(errors[part]), np.log(elongations[part]))))


def exponents(data: xarray.Dataset) -> tuple[float, float]:
    """Exponent of the time to equipartition in the elongation, where no contact opens, and its error from two halves of the ensemble."""
    closed = data.amplitude.values < OPENING
    times = np.log(equipartition_times(data))[closed]
    log_a = np.log(data.amplitude.values[closed])
    if len(log_a) < 2:
        return math.nan, math.nan
    whole, first, second = (
        np.polyfit(log_a, times[:, j], 1)[0] if np.isfinite(times[:, j]).all() else np.nan for j in range(3)
    )
    return float(whole), float(abs(first - second) / 2)


def early_rates(data: xarray.Dataset, config: Config) -> np.ndarray:
    """Growth of the energy outside of the two bands of the first held-out start, per slow time, at every amplitude (test,).

    From slow time 1/2 on: before it, the harmonics that are carried along without resonance come and go.
    """
    kept = [int(word.split(":")[0]) for word in config.pairs[0].split()]
    found = []
    for i in range(len(config.tests)):
        outside = 1 - data[f"chains_{i}"][0].sel(band=kept).sum("band")
        found.append(float((outside[6] - outside[2]) / (data.slow_time[6] - data.slow_time[2])))
    return np.array(found)


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(4, 2, width=4.6, height=3.0)
    axes = axes.reshape(-1)
    ax = axes[0]
    ax.plot(data.beat_time, 1e4 * data.harmonic, label="chain")
    ax.plot(data.beat_time, 1e4 * data.harmonic_law, "k--", label="closed form")
    ax.set(xlabel="time $t$", ylabel="amplitude of tone $2n$ ($10^{-4}$)", title="(a) second harmonic")
    ax.legend(fontsize="small")
    ax = axes[1]
    low = (len(config.amplitudes) - 1) // 2
    first, second = data.coupling[low], data.coupling[low + 1]
    errors = (1e4 * data.coupling_stderr[low + i] for i in (1, 0))
    ax.errorbar(1e4 * first, 1e4 * second, *errors, "o", ms=3, lw=0.6)
    ax.axline((0, 0), slope=1, color="k", lw=0.8)
    ax.set(
        xlabel=f"$10^4\\,G$ at elongation {config.amplitudes[low]:g}",
        ylabel=f"$10^4\\,G$ at elongation {config.amplitudes[low + 1]:g}",
        title="(b) couplings at energies 4 times apart",
    )  # fmt: skip
    for i, panel in ((0, axes[2]), (len(config.tests) - 1, axes[3])):
        ax, chains, model = panel, data[f"chains_{i}"][0], data[f"triads_energy_{i}"][0]
        for j, marker in zip(range(0, config.n_bands, max(1, config.n_bands // 6)), cycle("osD^vx"), strict=False):
            (line,) = ax.plot(
                data.slow_time, chains[:, j], "-", marker=marker, ms=3, markevery=(j, 8), label=f"band {j + 1}"
            )
            ax.fill_between(
                data.slow_time,
                *(chains[:, j] + s * data[f"chains_stderr_{i}"][0, :, j] for s in (-1, 1)),
                color=line.get_color(),
                alpha=0.3,
            )
            ax.plot(data.slow_time, model[:, j], "--", color=line.get_color())
        letter = "c" if panel is axes[2] else "d"
        ax.set(
            xlabel="time $\\times$ elongation$^2$", ylabel="share of the energy", yscale="log", ylim=(1e-3, 1),
            title=f"({letter}) held out at {config.tests[i]:g}; dashed: triads",
        )  # fmt: skip
        if i == 0:
            ax.legend(fontsize="x-small", ncol=2)
    ax = axes[4]
    for i, a in enumerate(config.amplitudes):
        ax.plot(data.late, data.distance[i, 0], label=f"elongation {a:g}")
    ax.plot(data.late, data.distance_model, "k--", label="triads")
    ax.set(
        xlabel="time $\\times$ elongation$^2$", ylabel="distance from equipartition", title="(e) way to equipartition"
    )
    ax.legend(fontsize="small")
    ax = axes[5]
    times = equipartition_times(data)
    slope, error = exponents(data)
    ax.loglog(data.amplitude, times[:, 0], "o-", label=f"chains, exponent {slope:.2f} ± {error:.2f}")
    middle = len(config.amplitudes) // 2
    ax.loglog(
        data.amplitude, times[middle, 0] * (data.amplitude / data.amplitude[middle]) ** -2, "k--", label="exponent $-2$"
    )
    ax.set(
        xlabel="root mean square elongation", ylabel="time to 3/4 of the distance", title="(f) time to equipartition"
    )
    ax.legend(fontsize="small")
    ax = axes[6]
    elongations, linear, quadratic = np.array(config.tests), *ladder(data, config)
    ax.loglog(elongations, linear, "s-", mfc="none", label="linear")
    ax.loglog(elongations, quadratic, "o--", label="with triads")
    grid = np.geomspace(elongations.min(), elongations.max(), 60)
    for law, style in ((linear_error, "-"), (quadratic_error, "--")):
        ax.plot(grid, [law(a, config.ladder_time) for a in grid], style, color="0.6", lw=1, zorder=0)
    ax.axhline(config.allowed, color="k", lw=0.6)
    ax.set(
        xlabel="root mean square elongation", ylabel="total variation from Hertz chains",
        title=f"(g) $t$ = {config.ladder_time:g}; gray: what the plan expects",
    )  # fmt: skip
    ax.legend(fontsize="small")
    ax = axes[7]
    total = data.coupling.sum("triad")
    ax.errorbar(data.amplitude, total, data.coupling_total_stderr, fmt="o-", capsize=2)
    ax.set(
        xscale="log", xlabel="root mean square elongation", ylabel="sum of the couplings $G$",
        title="(h) couplings over elongation",
    )  # fmt: skip
    for ax in (axes[5], axes[6], axes[7]):
        ax.set_xticks(list(config.amplitudes), [f"{a:g}" for a in config.amplitudes])
        ax.minorticks_off()
    figure.suptitle(
        f"Hertz chains of {config.n_particles}, {config.kind} masses, $\\xi$ = {config.strength:g}", fontsize="medium"
    )
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    law, wave = data.harmonic_law.values, data.harmonic.values
    rows = [
        Row("second harmonic, largest, over its closed form", float(wave.max() / law.max())),
        Row("time of its first maximum", float(data.beat_time[: len(law) // 2][wave[: len(law) // 2].argmax()])),
        Row("the same by the closed form", float(data.beat_time[: len(law) // 2][law[: len(law) // 2].argmax()])),
    ]
    for i in range(len(config.amplitudes) - 1):
        one, other = data.coupling[i], data.coupling[i + 1]
        error = np.hypot(data.coupling_stderr[i], data.coupling_stderr[i + 1])
        z = (abs(other - one) / error.clip(1e-12)).values
        name = f"couplings at elongations {config.amplitudes[i]:g} and {config.amplitudes[i + 1]:g}"
        rows.append(
            Row(
                f"{name}: ratio of sums",
                float(other.sum() / one.sum()),
                float(np.hypot(*(data.coupling_total_stderr[i + j] / data.coupling[i + j].sum() for j in (0, 1)))),
                note=f"{100 * np.mean(z < 1):.0f} % of G within one standard error, {100 * np.mean(z < 2):.0f} % within two",
            )
        )
    rates, base = early_rates(data, config), min(1, len(config.tests) - 1)
    for a, rate in zip(config.tests, rates, strict=True):
        rows.append(
            Row(
                f"rate of harmonics per energy², elongation {a:g}, over that at {config.tests[base]:g}",
                float(rate / rates[base]),
            )
        )
    for i, a in enumerate(config.tests):
        chains = data[f"chains_{i}"]
        linear = 0.5 * abs(chains[:, :1].values - chains.values).sum(-1).mean(-1)
        triads = 0.5 * abs(data[f"triads_energy_{i}"].values - chains.values).sum(-1).mean(-1)
        for j, words in enumerate(config.pairs):
            rows.append(
                Row(
                    f"total variation of triads, start {words}, elongation {a:g}",
                    float(triads[j]),
                    note=f"linear model {linear[j]:.3f}, {linear[j] / triads[j]:.1f} times as far; opened contacts {float(data[f'opened_{i}'][j]):.2g}",
                )
            )
    for a, ratio in zip(config.tests, data.cost_ratio.values, strict=True):
        rows.append(Row(f"processor time of Hertz chains over that of triads, elongation {a:g}", float(ratio)))
    for name, errors in zip(("linear contacts", "triads"), ladder(data, config), strict=True):
        place = edge(np.array(config.tests), errors, config.allowed)
        if math.isfinite(place):
            rows.append(
                Row(f"elongation at which {name} are {config.allowed:g} off by t = {config.ladder_time:g}", place)
            )
    slope, error = exponents(data)
    rows.append(Row("exponent of the time to equipartition in the elongation", slope, error, note="three waves: -2"))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Couplings are fitted at each amplitude from starts in single bands and pairs of bands; held-out starts are predicted with those "
        "of one amplitude below the middle. The linear chain, and with it every linear model, keeps the energy of each band of frequency for good."
    )


SCRIPT = harness.Script("harmonics", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
