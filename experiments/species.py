"""Soft and stiff species: branches and gap of the alternating chain, decay of modes, and transfer between species."""

from __future__ import annotations

import json
import math
import sys
import warnings
from dataclasses import dataclass, replace

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain.species import Mixture, Species, damped_modes, diatomic_frequencies


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


def kinds(config: Config) -> tuple[Species, Species]:
    return Species("soft", 1.0, config.soft, config.damping), Species("stiff", 1.0, config.stiff)


def scene(config: Config, seed: int, species: tuple[Species, ...]) -> tc.Scene:
    """Chains whose energies are those of every species in its bands; each start is a wave of velocity on one species."""
    if len(species) == 1:
        species = (Species(species[0].name, 1.0, species[0].stiffness, species[0].damping, 1.0),)
    return tc.Scene(
        n_particles=config.n_particles, n_bands=config.n_bands * len(species), species=species, by_species=True, seed=seed,
        realizations=config.realizations, disorder=tc.Disorder(config.kind, config.strength),
        times=torch.cat([torch.arange(0, 3, 0.25), torch.arange(3, config.stop + 0.5)]).double(),
    )  # fmt: skip


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


def defect(own: tc.Scene) -> float:
    """How far the energy that is kept and the one that is dissipated are off that of the start, over ten chains."""
    names = ("species_energy", "dissipated")
    found = tc.simulate(replace(own, observables=names, realizations=min(10, own.realizations)), "damped")
    total = found.species_energy.sum("species") + found.dissipated
    return float(abs(total / total.isel(time=0) - 1).max())


def calibrated(transfer: tc.BandTransfer, **settings: str) -> tc.MasterEquation:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # doubts of starts in one band of one species, which no chain has
        return tc.calibrate(transfer, bootstrap=0, **settings)


def flow(transfer: tc.BandTransfer) -> torch.Tensor:
    """The paper's rates, with what damping takes."""
    master = calibrated(transfer, model="paper", method="linear")
    return (master.rates - torch.diag(master.model.damping)).detach()


def measure(config: Config, device: str) -> xarray.Dataset:
    data = alternating(config)
    both, one = kinds(config), config.n_bands
    own, fresh = (tc.band_transfer(scene(config, config.seed + i, both)) for i in (0, 1))
    options = json.loads(fresh.attributes["method_options"])
    energy = torch.from_numpy(tc.simulate(fresh.scene, fresh.attributes["method"], options=options).band_energy.values)
    start, truth, times = energy[:, 0], energy, own.times  # of each wave, as the bands of its species see it

    def distance(transfer: torch.Tensor) -> tuple[tuple[str, ...], np.ndarray]:
        found = torch.einsum("as,stb->atb", start, transfer.detach())
        return ("time",), (0.5 * (found - truth).abs().sum(-1)).mean(0).numpy()

    pure, rates = torch.zeros_like(own.mean), flow(own)
    alone = torch.zeros_like(rates)
    for i, kind in enumerate(both):
        part, sample = slice(i * one, (i + 1) * one), tc.band_transfer(scene(config, config.seed, (kind,)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            pure[part, :, part] = calibrated(sample).transfer(times).detach()
        alone[part, part] = flow(sample)
    between = torch.block_diag(*(torch.ones(one, one, dtype=torch.bool) for _ in both)).logical_not()
    added = alone + torch.where(between, rates, 0.0)
    added -= torch.diag(torch.where(between, rates, 0.0).sum(-1))
    joint = calibrated(own)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        whole = joint.transfer(times).detach()
    data |= {
        "kept": (("start", "time", "species"), truth.unflatten(-1, (2, one)).sum(-1).numpy()),
        "noise": distance(own.mean), "joint": distance(whole), "pure": distance(pure),
        **{f"rates_{name}": distance(torch.matrix_exp(times[:, None, None] * q).swapaxes(0, 1)) for name, q in (("pure", alone), ("added", added), ("joint", rates))},
        "defect": ((), np.array(defect(own.scene))), "joint_parameters": ((), np.array(joint.n_parameters)),
    }  # fmt: skip
    for name, species in (("mixture", both), ("soft", both[:1])):
        modes = damped_modes(scene(config, config.seed, species).chain([0]))
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
        ylim=(1e-18, 1),
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
        ("pure", "C1--", "pure samples, no transfer between species"),
        ("rates_added", "C2-.", "rates of pure samples, and those between species"),
        ("joint", "C0-", "memory, calibrated on the mixture"),
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
    rates = {name: float(data[f"rates_{name}"][late].mean()) for name in ("pure", "added", "joint")}
    return [
        Row("alternating ring, frequencies off the closed form", float(off)),
        Row("spectrum passed in the gap over that in the acoustic branch", passed),
        Row("kept and dissipated energy off 1", float(data.defect)),
        Row("total variation of the joint model", joint, note=f"{joint / noise:.2f} of the distance of two ensembles, {noise:.4f}; {int(data.joint_parameters)} numbers"),
        Row("total variation of the pure samples' models", pure, note=f"{pure / noise:.1f} times that distance: what transfer between species adds"),
        Row("the same by the paper's rates of the pure samples", rates["pure"]),
        Row("with the rates between species, from the mixture", rates["added"], note="what the cross terms add"),
        Row("by all of the mixture's rates", rates["joint"], note="of seen starts, which no chain makes alone; they can grow"),
    ]  # fmt: skip


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Energies are those of each species in each band of wavenumber (contacts shared by halves, never negative). Starts are velocity waves "
        "on the beads of one species, seen in all of its bands; models are scored on chains that did not enter them."
    )


SCRIPT = harness.Script("species", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
