"""The numbers of the enhanced return (torchchain.theory.Return), measured over chains of several disorders."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.figure import Figure
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

import torchchain as tc
from torchchain.energy.bands import center_tones
from torchchain.theory import MEASURED, Return, law_of
from torchchain.theory.crossed import LAST, crossed_transfer, fading
from torchchain.theory.ladder import Waves, ladder_transfer, spectrum_edges
from torchchain.theory.localized import Frequencies, first_part, interference, onset, source_frequencies
from torchchain.theory.transfer import crossed_part

NAMES = ("narrowing", "onset", "delay", "power", "first")
EARLY = 8.0  # times up to here weigh as much as all together


@dataclass(frozen=True)
class Config(Ensemble):
    seed: int = 777
    """seed of the ensembles"""
    realizations: int = 1000
    """chains of each disorder"""
    strengths: tuple[float, ...] = (0.1, 0.3, 0.5)
    """disorders xi"""
    times: tuple[float, ...] = (2, 4, 8, 16, 32, 64, 128, *range(20, 401, 20))
    """times that the onset is fitted to"""
    evaluations: int = 120
    """of the search for the onset"""


SMOKE = Config(n_particles=32, n_bands=4, realizations=4, strengths=(0.3,), times=(2.0, 8.0, 32.0), evaluations=4)


@dataclass(frozen=True)
class Disordered:
    """Chains of one disorder, and the theory without interference."""

    waves: Waves
    k: list[float]
    spectra: list[Frequencies]
    times: Tensor
    ladder: Tensor
    crossed: Tensor
    bare: Tensor
    mean: Tensor
    long_time: Tensor

    def patterns(self, numbers: Return) -> list[Tensor]:
        """What interference changes for each source at each of its frequencies, (band, node)."""
        found = []
        for k, spectrum in zip(self.k, self.spectra, strict=True):
            change = spectrum.receivers * interference(self.waves, k, spectrum, numbers) * spectrum.energy
            found.append(change.reshape(self.waves.n_bands, -1, change.shape[-1]).sum(1))
        return found

    def late_error(self, numbers: Return) -> float:
        final = torch.stack([part.sum(-1) for part in self.patterns(numbers)])
        return float((self.bare + final - self.long_time).abs().sum(-1).mean()) / 2

    def error(self, patterns: list[Tensor], numbers: Return) -> Tensor:
        fade, change = fading(self.times), []
        for s, (spectrum, pattern) in enumerate(zip(self.spectra, patterns, strict=True)):
            late = onset(self.times, spectrum, numbers).T @ pattern.T
            first = first_part(self.times, spectrum, numbers) * fade
            part = crossed_part(self.ladder[s], self.crossed[s], first, numbers)[:, None]
            change.append(part * self.crossed[s] + (1 - part) * late)
        return (self.ladder + torch.stack(change) - self.mean).abs().sum(-1).mean(0) / 2


def prepared(config: Config, xi: float, device: str) -> Disordered:
    t = torch.tensor(sorted(set(config.times)), dtype=torch.float64)
    chains = tc.band_transfer(config.scene(xi, times=t), device=device)
    law = law_of(tc.Disorder(strength=xi))
    tones = torch.tensor(center_tones(config.n_particles, config.n_bands))
    k = 2 * math.pi / config.n_particles * tones.to(torch.float64)
    waves = Waves(config.n_particles, config.n_bands, 4 * torch.sin(k / 2).square(), torch.arange(config.n_bands))
    edges = spectrum_edges(law)
    spectra = source_frequencies(law, waves, edges[0])
    bare = torch.stack([(s.receivers @ s.energy).reshape(config.n_bands, -1).sum(-1) for s in spectra])
    ladder = ladder_transfer(law, waves, t, edges)
    crossed = torch.zeros_like(ladder)
    crossed[:, t <= LAST], _ = crossed_transfer(law, waves, t[t <= LAST], edges[0])
    assert chains.long_time is not None
    return Disordered(waves, k.tolist(), spectra, t, ladder, crossed, bare, chains.mean, chains.long_time)


def measure(config: Config, device: str) -> xarray.Dataset:
    cases = [prepared(config, xi, device) for xi in config.strengths]
    trials = np.linspace(0, 3, 13)
    late = np.array([[case.late_error(replace(MEASURED, narrowing=float(a))) for a in trials] for case in cases])
    narrowing = minimize_scalar(
        lambda a: sum(case.late_error(replace(MEASURED, narrowing=float(a))) for case in cases),
        bounds=(0, 4), method="bounded", options={"xatol": 0.02},
    ).x  # fmt: skip
    numbers = replace(MEASURED, narrowing=float(narrowing))
    patterns = [case.patterns(numbers) for case in cases]

    def misfit(values: np.ndarray) -> float:
        if values.min() <= 0:
            return 1.0
        trial = replace(numbers, **dict(zip(NAMES[1:], map(float, values), strict=True)))
        errors = [case.error(part, trial) for case, part in zip(cases, patterns, strict=True)]
        early = cases[0].times <= EARLY
        return sum(float(error.mean() + error[early].mean()) for error in errors)

    start = [getattr(MEASURED, name) for name in NAMES[1:]]
    best = minimize(misfit, start, method="Nelder-Mead", options={"maxfev": config.evaluations, "xatol": 0.01}).x
    fitted = replace(numbers, **dict(zip(NAMES[1:], map(float, best), strict=True)))
    came, x = _growth(cases, patterns)
    return xarray.Dataset(
        {
            "number": (("name",), [getattr(fitted, name) for name in NAMES]),
            "late_error": (("strength", "narrowing"), late, {"long_name": "mean total variation at infinite time"}),
            "bare_error": (("strength",), [float((c.bare - c.long_time).abs().sum(-1).mean()) / 2 for c in cases]),
            "came": (("strength", "source", "time"), came, {"long_name": "share of the interference that has come"}),
            "level_times": (("strength", "source", "time"), x, {"long_name": "2 t / t_level, delay divided out"}),
            "error": (
                ("strength", "time"),
                np.stack([c.error(p, fitted).numpy() for c, p in zip(cases, patterns, strict=True)]),
            ),
        },
        {
            "name": list(NAMES), "strength": list(config.strengths), "narrowing": trials,
            "time": ("time", cases[0].times.numpy(), harness.TIME), "source": np.arange(1, config.n_bands + 1),
        },
    )  # fmt: skip


def _growth(cases: list[Disordered], patterns: list[list[Tensor]]) -> tuple[np.ndarray, np.ndarray]:
    """The chains' difference from the ladder along the final interference, and the time in each source's own unit."""
    came, unit = [], []
    for case, parts in zip(cases, patterns, strict=True):
        final = torch.stack([part.sum(-1) for part in parts])
        left = torch.einsum("str,sr->st", case.mean - case.ladder, final) / final.square().sum(-1, keepdim=True)
        came.append(left.numpy())
        rate = torch.tensor(
            [float((s.energy * 2 / s.level_time / (1 + MEASURED.delay * s.width)).sum()) for s in case.spectra]
        )
        unit.append((rate[:, None] * case.times).numpy())
    return np.stack(came), np.stack(unit)


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    for i, xi in enumerate(config.strengths):
        axes[0, 0].plot(
            data.narrowing,
            data.late_error[i],
            color=f"C{i}",
            label=f"$\\xi$ = {xi:g} (bare {float(data.bare_error[i]):.3f})",
        )
        middle = slice(config.n_bands // 3, None, max(1, config.n_bands // 10))
        axes[0, 1].plot(data.level_times[i, middle].values.T, data.came[i, middle].values.T, ".", ms=3, color=f"C{i}")
    numbers = data.number.sel(name=list(NAMES)).values
    axes[0, 0].axvline(numbers[0], color="gray", lw=0.8)
    axes[0, 0].set(xlabel="narrowing a", ylabel="mean total variation at infinite time", ylim=(0, None))
    axes[0, 0].legend(fontsize=8)
    x = np.logspace(-1, 2.3, 200)
    axes[0, 1].plot(x, np.exp(-((numbers[1] / x) ** numbers[3])), "k")
    axes[0, 1].set(xscale="log", xlim=(0.1, 200), ylim=(-0.3, 1.4), xlabel="time over the source's level time",
                   ylabel="share of the interference that has come")  # fmt: skip
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = [
        Row(name, float(data.number.sel(name=name)), note=f"in the package: {getattr(MEASURED, name):g}")
        for name in NAMES
    ]
    for i, xi in enumerate(config.strengths):
        rows.append(Row(f"xi = {xi:g}: mean total variation over the times", float(data.error[i].mean())))
        rows.append(
            Row(
                f"xi = {xi:g}: at infinite time",
                float(data.late_error[i].min()),
                note=f"bare {float(data.bare_error[i]):.4f}",
            )
        )
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "narrowing 0 is the closed form without a fitted number, right for weak disorder; one number for all disorders shortens\n"
        "the localization length where it nears a particle. The onset is a mean: sources and distances differ by a factor of two."
    )


SCRIPT = harness.Script("measure_return", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
