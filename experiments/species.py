"""Soft and stiff species: branches and gap of the alternating chain, decay of modes, and transfer between species."""

from __future__ import annotations

import math
import sys
import warnings
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.species import Mixture, Species, damped_modes, diatomic_frequencies, species_band_energy


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the ensembles"""
    n_particles: int = 96
    """particles per chain of the ensembles"""
    n_bands: int = 6
    """wavenumber bands of each species"""
    realizations: int = 100
    """chains in each ensemble"""
    kind: str = "normal"
    """of the mass disorder"""
    strength: float = 0.2
    """disorder xi within each species"""
    soft: float = 0.4
    """contact stiffness of the soft species"""
    stiff: float = 1.6
    """and of the stiff one"""
    damping: float = 0.05
    """contact damping of the soft species; the stiff one has none"""
    light: float = 0.5
    """lighter mass of the alternating chain"""
    heavy: float = 1.5
    """and the heavier one"""
    length: int = 512
    """particles of the alternating chain"""
    stop: float = 60.0
    """last time of the ensembles"""


SMOKE = Config(n_particles=24, n_bands=2, realizations=12, length=96, stop=12.0)


def mixture(config: Config) -> Mixture:
    return Mixture((Species("soft", 1.0, config.soft, config.damping), Species("stiff", 1.0, config.stiff)))


def alternating(config: Config) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Branches over the extended zone, and the spectrum that a kick at one end sends through."""
    pair = Mixture((Species("light", config.light), Species("heavy", config.heavy)), "alternating")
    ring = pair.chain(config.length, 1, 0)
    modes = tc.normal_modes(ring)
    known = diatomic_frequencies(config.light, config.heavy, config.length)
    shape = torch.fft.rfft(ring.masses[0].sqrt()[:, None] * modes.shapes[0], dim=0, norm="ortho").abs().square()
    strongest = shape.argmax(0)
    chain = pair.chain(config.length, 1, 0, "fixed")
    times = torch.arange(0, 1.9 * config.length, 0.5, dtype=torch.float64)
    window = torch.blackman_window(len(times), dtype=torch.float64)
    path = tc.evolve(chain, tc.impulse(chain, 1, 0.01), times, method="modes").velocity[0]
    through = torch.fft.rfft(window * path[:, config.length // 8]).abs().square()
    sent = torch.fft.rfft(window * path[:, 0]).abs().square()
    return {
        "branch_frequency": (("mode",), modes.frequencies[0].numpy()), "branch_known": (("mode",), known.numpy()),
        "branch_wavenumber": (("mode",), 2 * math.pi / config.length * strongest.numpy()),
        "spectrum": (("frequency",), through.numpy()), "spectrum_sent": (("frequency",), sent.numpy()),
        "frequency": (("frequency",), 2 * math.pi * np.fft.rfftfreq(len(times), 0.5)),
    }  # fmt: skip


def ensemble(config: Config, mixed: Mixture, seed: int) -> tuple[torch.Tensor, float]:
    """Share of the start's energy in every species and band, (realization, start, time, species x band), and the largest
    defect of kept and dissipated energy. Each start is a velocity wave of the middle tone of a band on one species."""
    n, bands, found, defect = config.n_particles, config.n_bands, [], 0.0
    times = torch.linspace(0, config.stop, 61, dtype=torch.float64)
    disorder = tc.Disorder(config.kind, config.strength)
    tones = [max(1, (2 * s + 1) * n // (4 * bands)) for s in range(bands)]
    for first in range(0, config.realizations, 20):
        numbers = range(first, min(first + 20, config.realizations))
        chain, labels = mixed.chain(n, numbers, seed, disorder=disorder), mixed.labels(n, numbers, seed)
        wave = tc.standing_wave(chain, tone=tones).displacement
        velocity = torch.cat([wave * (labels == i)[:, None] for i in range(len(mixed.species))], dim=1)
        path = tc.evolve(
            chain,
            tc.State(torch.zeros_like(velocity), velocity),
            times,
            method="damped" if chain.is_damped else "modes",
        )
        total = tc.total_energy(chain, path)
        lost = torch.zeros_like(total) if path.dissipated is None else path.dissipated
        defect = max(defect, float(((total + lost) / total[..., :1] - 1).abs().max()))
        energy = species_band_energy(chain, path, labels, len(mixed.species), bands).flatten(-2)
        inside = energy.sum(-1, keepdim=True)  # the rest is at k = 0, a hundredth or less
        found.append(energy * (total / total[..., :1])[..., None] / inside)
    return torch.cat(found), defect


def calibrated(times: torch.Tensor, energy: torch.Tensor, words: str) -> tc.MasterEquation:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", (tc.FramesWarning, tc.FitWarning))  # damped data; free fits that are not used
        transfer = tc.BandTransfer.from_energies(times, energy, starts=energy[:, :, 0], provenance=words)
        return tc.calibrate(transfer, bootstrap=0)


def measure(config: Config, device: str) -> xarray.Dataset:
    data = alternating(config)
    mixed, one = mixture(config), config.n_bands
    times = torch.linspace(0, config.stop, 61, dtype=torch.float64)
    energy, defect = ensemble(config, mixed, config.seed)
    fresh, other = ensemble(config, mixed, config.seed + 1)
    start, truth = fresh[:, :, 0].mean(0), fresh.mean(0)
    joint = calibrated(times, energy, "a mixture of species")
    whole = joint.solve(start, times).detach()
    parts = []
    for i, kind in enumerate(mixed.species):
        alone = Mixture((Species(kind.name, kind.mass, kind.stiffness, kind.damping, 1.0),))
        model = calibrated(times, ensemble(config, alone, config.seed)[0], f"{kind.name} beads alone")
        parts.append(model.solve(start[:, i * one : (i + 1) * one], times).detach())
    pure = torch.cat(parts, dim=-1)

    def distance(other: torch.Tensor) -> np.ndarray:
        return (0.5 * (other - truth).abs().sum(-1)).mean(0).numpy()

    species = truth.unflatten(-1, (2, one)).sum(-1)
    data |= {
        "kept": (("start", "time", "species"), species.numpy()),
        "kept_joint": (("start", "time", "species"), whole.unflatten(-1, (2, one)).sum(-1).numpy()),
        "noise": (("time",), distance(energy.mean(0))), "joint": (("time",), distance(whole)),
        "pure": (("time",), distance(pure)), "defect": ((), np.array(max(defect, other))),
        "joint_parameters": ((), np.array(joint.n_parameters)),
    }  # fmt: skip
    for name, system in (
        ("mixture", mixed),
        ("soft", Mixture((Species("soft", 1.0, config.soft, config.damping, 1.0),))),
    ):
        modes = damped_modes(
            system.chain(config.n_particles, 1, config.seed, disorder=tc.Disorder(config.kind, config.strength))
        )
        data[f"{name}_frequency"] = (f"{name}_mode",), modes.frequencies[0].numpy()
        data[f"{name}_decay"] = (f"{name}_mode",), modes.decays[0].numpy()
    return xarray.Dataset(data, coords={"time": times.numpy(), "species": ["soft", "stiff"]})


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 2, width=4.6, height=3.6)
    gap = math.sqrt(2 / config.heavy), math.sqrt(2 / config.light)
    ax = axes[0, 0]
    ax.plot(data.branch_wavenumber, data.branch_frequency, ".", ms=3, label="chain, strongest wavenumber")
    k = np.linspace(0, math.pi, 400)
    total, product = 1 / config.light + 1 / config.heavy, config.light * config.heavy
    root = np.sqrt(np.maximum(total**2 - 4 * np.sin(k) ** 2 / product, 0))
    branch = np.sqrt(np.where(k < math.pi / 2, total - root, total + root))
    branch[np.searchsorted(k, math.pi / 2)] = np.nan
    ax.plot(k, branch, "k-", lw=0.8, label="closed form")
    ax.axhspan(*gap, color="0.85", label="gap")
    ax.set(xlabel="wavenumber $k$ (extended zone)", ylabel=r"frequency $\omega$", title="(a) alternating masses")
    ax.legend(fontsize="small", loc="lower right")
    ax = axes[0, 1]
    ax.semilogy(data.frequency, data.spectrum_sent, "0.6", ls="--", label="first particle")
    ax.semilogy(data.frequency, data.spectrum, "C0", label=f"particle {config.length // 8 + 1}")
    ax.axvspan(*gap, color="0.85")
    ax.set(
        xlabel=r"frequency $\omega$",
        ylabel="spectrum of the velocity",
        xlim=(0, 1.2 * math.sqrt(2 * total)),
        title="(b) kick at one end (gray: gap)",
    )
    ax.legend(fontsize="small")
    ax = axes[1, 0]
    ax.loglog(data.soft_frequency, data.soft_decay, "s", ms=3, mfc="none", label="soft alone")
    ax.loglog(data.mixture_frequency, data.mixture_decay, ".", ms=4, label="mixture")
    w = np.array([0.05, 1.3])
    ax.loglog(w, config.damping / config.soft * w**2 / 2, "k--", lw=0.8, label=r"$(c/k)\,\omega^2/2$")
    ax.set(
        xlabel=r"frequency $\omega$",
        ylabel="decay rate of the amplitude",
        title="(c) complex modes, soft species damped",
    )
    ax.legend(fontsize="small")
    ax = axes[1, 1]
    for name, style, label in (
        ("pure", "C1--", "pure samples, no transfer between species"), ("joint", "C0-", "calibrated on the mixture"),
        ("noise", "k:", "two ensembles"),
    ):  # fmt: skip
        ax.semilogy(data.time[1:], data[name][1:], style, label=label)
    ax.set(
        xlabel="time $t$", ylabel="total variation, bands of both species", title="(d) master equations of the mixture"
    )
    ax.legend(fontsize="small")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    moving = data.branch_known.values > 0.01
    off = np.abs(data.branch_frequency.values / np.where(moving, data.branch_known.values, 1) - 1)[moving].max()
    inside = (data.frequency > math.sqrt(2 / config.heavy) + 0.05) & (
        data.frequency < math.sqrt(2 / config.light) - 0.05
    )
    acoustic = (data.frequency > 0.1) & (data.frequency < math.sqrt(2 / config.heavy) - 0.05)
    passed = float(np.median(data.spectrum[inside]) / np.median(data.spectrum[acoustic]))
    late = data.time > 0
    noise, joint, pure = (float(data[name][late].mean()) for name in ("noise", "joint", "pure"))
    return [
        Row("alternating ring, frequencies off the closed form", float(off)),
        Row("spectrum passed in the gap over that in the acoustic branch", passed),
        Row("kept and dissipated energy off 1", float(data.defect)),
        Row("total variation of the joint model", joint, note=f"{joint / noise:.2f} of the distance of two ensembles, {noise:.4f}; {int(data.joint_parameters)} numbers"),
        Row("total variation of the pure samples' models", pure, note=f"{pure / noise:.1f} times that distance: what transfer between species adds"),
    ]  # fmt: skip


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Energies are those of each species in each band of wavenumber (contacts shared by halves, never negative). Starts are velocity waves "
        "on the beads of one species; models are scored on chains that did not enter them."
    )


SCRIPT = harness.Script("species", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
