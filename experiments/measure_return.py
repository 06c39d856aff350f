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
from torchchain import plots
from torchchain.energy.bands import center_tones
from torchchain.theory import MEASURED, Return, law_of
from torchchain.theory.crossed import LAST, crossed_transfer
from torchchain.theory.ladder import Waves, fading, ladder_transfer, spectrum_edges
from torchchain.theory.localized import Frequencies, first_part, interference, onset, source_frequencies
from torchchain.theory.transfer import crossed_part

NAMES = ("narrowing", "onset", "delay", "power", "first")
START = Return(narrowing=1.0, onset=1.0, delay=1.0, power=1.0, first=2.0)
EARLY, WEAK = 8.0, 0.2  # up to this time and disorder the theory is held to chains' own error
CHAINS, WEIGHT = 400, 0.004  # that of so many chains; the largest distance in units of it counts this much


@dataclass(frozen=True)
class Config(Ensemble):
    seed: int = 777
    """seed of the ensembles"""
    realizations: int = 1000
    """chains of each disorder"""
    strengths: tuple[float, ...] = (0.1, 0.2, 0.3, 0.5)
    """disorders xi"""
    times: tuple[float, ...] = (2, 4, 8, 16, 32, 64, 128, *range(20, 401, 20))
    """times that the onset is fitted to"""
    evaluations: int = 150
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
    noise: Tensor
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

    def change(self, patterns: list[Tensor], numbers: Return) -> Tensor:
        """What the theory adds to the ladder, [source, time, band]."""
        fade, change = fading(self.times, LAST), []
        for s, (spectrum, pattern) in enumerate(zip(self.spectra, patterns, strict=True)):
            late = onset(self.times, spectrum, numbers).T @ pattern.T
            first = first_part(self.times, spectrum, numbers) * fade
            part = crossed_part(self.ladder[s], self.crossed[s], first, numbers)[:, None]
            change.append(part * self.crossed[s] + (1 - part) * late)
        return torch.stack(change)

    def error(self, patterns: list[Tensor], numbers: Return) -> Tensor:
        """Mean total variation from the chains, (time,)."""
        return (self.ladder + self.change(patterns, numbers) - self.mean).abs().sum(-1).mean(0) / 2


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
    noise = math.sqrt(2 / math.pi) / 2 * chains.stderr.sum(-1).mean(0) * math.sqrt(config.realizations / CHAINS)
    return Disordered(waves, k.tolist(), spectra, t, ladder, crossed, bare, chains.mean, noise, chains.long_time)


def measure(config: Config, device: str) -> xarray.Dataset:
    cases = [prepared(config, xi, device) for xi in config.strengths]
    trials = np.linspace(0, 3, 13)
    late = np.array([[case.late_error(replace(START, narrowing=float(a))) for a in trials] for case in cases])
    narrowing = minimize_scalar(
        lambda a: sum(case.late_error(replace(START, narrowing=float(a))) for case in cases),
        bounds=(0, 4), method="bounded", options={"xatol": 0.02},
    ).x  # fmt: skip
    numbers = replace(START, narrowing=float(narrowing))
    patterns = [case.patterns(numbers) for case in cases]

    def misfit(values: np.ndarray) -> float:
        if values.min() <= 0:
            return 1.0
        trial = replace(numbers, **dict(zip(NAMES[1:], map(float, values), strict=True)))
        found = 0.0
        for xi, case, part in zip(config.strengths, cases, patterns, strict=True):
            error = case.error(part, trial)
            found += float(error.mean())
            if xi <= WEAK:
                found += WEIGHT * float((error / case.noise)[case.times <= EARLY].max())
        return found

    start = [getattr(START, name) for name in NAMES[1:]]
    best = minimize(misfit, start, method="Nelder-Mead", options={"maxfev": config.evaluations, "xatol": 0.01}).x
    fitted = replace(numbers, **dict(zip(NAMES[1:], map(float, best), strict=True)))
    return xarray.Dataset(
        {
            "number": (("name",), [getattr(fitted, name) for name in NAMES]),
            "late_error": (("strength", "narrowing"), late, {"long_name": "mean total variation at infinite time"}),
            "bare_error": (("strength",), [float((c.bare - c.long_time).abs().sum(-1).mean()) / 2 for c in cases]),
            "came": (
                ("of", "strength", "source", "time"),
                np.stack([_growth(c, p, fitted) for c, p in zip(cases, patterns, strict=True)], axis=1),
                {"long_name": "share of the interference that has come"},
            ),
            "error": (
                ("strength", "time"),
                np.stack([c.error(p, fitted).numpy() for c, p in zip(cases, patterns, strict=True)]),
            ),
        },
        {
            "name": list(NAMES), "of": ["chains", "theory"], "strength": list(config.strengths), "narrowing": trials,
            "time": ("time", cases[0].times.numpy(), harness.TIME), "source": np.arange(1, config.n_bands + 1),
        },
    )  # fmt: skip


def _growth(case: Disordered, patterns: list[Tensor], numbers: Return) -> np.ndarray:
    """Difference from the ladder along the final interference, of the chains and of the theory, [of, source, time]."""
    final = torch.stack([part.sum(-1) for part in patterns])
    parts = torch.stack([case.mean - case.ladder, case.change(patterns, numbers)])
    return (torch.einsum("istr,sr->ist", parts, final) / final.square().sum(-1, keepdim=True)).numpy()


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    for i, xi in enumerate(config.strengths):
        axes[0, 0].plot(
            data.narrowing,
            data.late_error[i],
            color=f"C{i}",
            label=f"$\\xi$ = {xi:g} (bare {float(data.bare_error[i]):.3f})",
        )
        chains, theory = data.came[:, i, config.n_bands // 3 :].median("source")
        axes[0, 1].plot(data.time, chains, "os^vD"[i % 5], ms=4, mfc="none", color=f"C{i}")
        axes[0, 1].plot(data.time, theory, ("-", "--", ":", "-.")[i % 4], color=f"C{i}", label=f"$\\xi$ = {xi:g}")
    numbers = data.number.sel(name=list(NAMES)).values
    axes[0, 0].axvline(numbers[0], color="gray", lw=0.8)
    axes[0, 0].set(xlabel="narrowing", ylabel="mean total variation at infinite time", ylim=(0, None))
    axes[0, 0].legend(fontsize=8)
    axes[0, 1].set(xscale="log", xlabel=plots.TIME_LABEL, ylabel="share of the interference that has come",
                   title="symbols: chains, lines: theory")  # fmt: skip
    axes[0, 1].legend(fontsize=8)
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
        "the localization length where it nears a particle. What is minimized: the mean total variation over times and disorders, and\n"
        f"{WEIGHT:g} times the largest distance to t = {EARLY:g} at disorders to {WEAK:g} in units of the error of {CHAINS} chains."
    )


SCRIPT = harness.Script("measure_return", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
