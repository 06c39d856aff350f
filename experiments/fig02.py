"""Fig. 2: mean energy of every particle at several instants after a kick beside the wall, ordered and weak disorder."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain import checks, plots
from torchchain.ensemble import run as ensemble


@dataclass(frozen=True)
class Kick:
    """The chains of Section 4.1: fixed ends, one particle kicked at time 0."""

    seed: int = 0
    """seed of the ensemble"""
    n_particles: int = 1024
    """particles per chain"""
    realizations: int = 500
    """chains in the ensemble"""
    site: int = 1
    """the kicked particle"""
    velocity: float = 0.01
    """its velocity"""
    method: str = "chebyshev"
    """how the chains are evolved"""
    kind: str = "normal"
    """distribution of the masses: normal, uniform, binary, lognormal or gamma"""

    @property
    def initial_energy(self) -> float:
        """Of a kicked particle of mean mass."""
        return self.velocity**2 / 2

    def scene(self, strength: float, times: Any, observables: tuple[str, ...], **changes: Any) -> tc.Scene:
        """The ensemble at one disorder."""
        settings: dict[str, Any] = {
            "n_particles": self.n_particles,
            "boundary": "fixed",
            "disorder": tc.Disorder(self.kind, strength),
            "excitation": tc.Impulse(self.site, self.velocity),
            "times": torch.as_tensor(times, dtype=torch.float64),
            "realizations": self.realizations,
            "seed": self.seed,
            "observables": observables,
        }
        return tc.Scene(**settings | changes)


@dataclass(frozen=True)
class Config(Kick):
    strengths: tuple[float, ...] = (0.0, 0.05)
    """disorders xi, a panel each"""
    times: tuple[float, ...] = (125.0, 375.0, 625.0, 875.0)
    """the instants"""


SMOKE = Config(n_particles=128, realizations=8, times=(30.0, 60.0, 90.0))


def each_realization(scene: tc.Scene, method: str, device: str) -> dict[str, Tensor]:
    """The scene's observables of every single chain, (realization, ...): for statistics that a mean does not allow."""
    parts: dict[str, list[Tensor]] = {name: [] for name in scene.observables}
    for _, measured in ensemble.stream(scene, lambda chunk: chunk.observe(scene.observables), method, device=device):
        for name, values in parts.items():
            values.append(measured[name].cpu())
    return {name: torch.cat(values) for name, values in parts.items()}


def mean_and_error(values: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Mean over realizations and its standard error; a single chain, the ordered one, has none."""
    if len(values) == 1:
        return values[0].numpy(), np.zeros(values.shape[1:])
    return values.mean(0).numpy(), (values.std(0) / len(values) ** 0.5).numpy()


def measure(config: Config, device: str) -> xarray.Dataset:
    if len(config.times) < 2:
        raise checks.fail("times", "hold at least two instants to compare", config.times)
    energies = [
        each_realization(config.scene(xi, config.times, ("energy",)), config.method, device)["energy"]
        / config.initial_energy
        for xi in config.strengths
    ]  # (realization, time, particle)
    means, errors = zip(*map(mean_and_error, energies), strict=True)
    kept, kept_error = np.array([still_there(values, config) for values in energies]).T
    axes, units = ("strength", "time", "particle"), {"units": "energy of the kick"}
    return xarray.Dataset(
        {
            "energy": (axes, np.array(means), units | {"long_name": "mean energy per particle"}),
            "energy_stderr": (axes, np.array(errors), units),
            "kept": ("strength", kept, {"long_name": "energy behind the front, last instant over the last but one"}),
            "kept_stderr": ("strength", kept_error),
        },
        coords={
            "strength": list(config.strengths),
            "time": ("time", list(config.times), harness.TIME),
            "particle": np.arange(1, config.n_particles + 1),
        },
    )


def behind(config: Config) -> int:
    """The particles of the localized part: well behind the front of the last but one instant."""
    return int(0.4 * config.times[-2])


def still_there(energy: Tensor, config: Config) -> tuple[float, float]:
    """How much of the energy behind the front at the last but one instant is still there at the last, and its error."""
    inside = energy[:, -2:, : behind(config)].sum(-1)
    value, error = harness.jackknife(inside, [1] * len(inside), lambda mean: mean[1] / mean[0], groups=20)
    return float(value), float(error)


def group_velocities(time: float, particle: np.ndarray) -> np.ndarray:
    """Mean energy per particle of the ordered chain for long times, (16 / pi) x^2 sqrt(1 - x^2) / t with x = p / t.

    The kick beside a fixed wall puts a share (2 / pi) sin^2(k) dk of its energy into wavenumber k, which travels at cos(k/2).
    """
    x = np.minimum(particle / time, 1.0)
    return 16 / np.pi * x**2 * np.sqrt(1 - x**2) / time


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, len(config.strengths), width=5.6, height=4.2)
    particle = data.particle.values
    for i, (ax, xi) in enumerate(zip(axes[0], config.strengths, strict=True)):
        for j, t in enumerate(config.times):
            part = data.isel(strength=i, time=j)
            plots.curve(
                ax, particle, part.energy.values, part.energy_stderr.values, label=f"t = {t:g}", color=f"C{j}", lw=0.9
            )
            if xi == 0:
                near = particle < 0.995 * t
                ax.plot(particle[near], group_velocities(t, particle[near]), "k--", lw=0.8)
            front = front_of(data, i, j)
            ax.plot(front[0], front[1], "kv", ms=4, mfc="none")
        if xi == 0:
            ax.plot([], [], "k--", lw=0.8, label="group velocities")
        ax.set(xlabel="particle $p$", ylabel="mean energy / energy of kick", yscale="log", title=f"$\\xi$ = {xi:g}")
        ax.set(xlim=(-0.02 * config.n_particles, config.n_particles), ylim=(1e-6, 10 * float(data.energy.max())))
        ax.legend(fontsize="small", loc="upper center", ncols=len(config.times) // 2 + 1)
    figure.suptitle(
        f"kick at particle {config.site}, {config.realizations} chains, shaded: standard error; triangles: the coherent front",
        fontsize="medium",
    )
    return figure


def front_of(data: xarray.Dataset, strength: int, time: int) -> tuple[int, float, float]:
    """Place, height and its error of the largest mean energy in the outer half of the wave's reach."""
    part = data.isel(strength=strength, time=time)
    outer = np.where(part.particle.values > part.time.values / 2, part.energy.values, -np.inf)
    best = int(outer.argmax())
    return best + 1, float(outer[best]), float(part.energy_stderr.values[best])


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, xi in enumerate(config.strengths):
        for j, t in enumerate(config.times):
            first = data.isel(strength=i, time=j, particle=config.site - 1)
            place, height, error = front_of(data, i, j)
            rows += [
                Row(f"xi = {xi:g}, t = {t:g}: energy of particle {config.site}", float(first.energy), float(first.energy_stderr)),
                Row(f"xi = {xi:g}, t = {t:g}: front, height", height, error,
                    note=f"{32 / np.pi / 27**0.5 / t:.4g} by group velocities" if xi == 0 else ""),
                Row(f"xi = {xi:g}, t = {t:g}: front, place / t", place / t,
                    note=f"{(2 / 3) ** 0.5:.4f} by group velocities" if xi == 0 else ""),
            ]  # fmt: skip
        if xi > 0:
            rows.append(Row(f"xi = {xi:g}: energy in p <= {behind(config)}, t = {config.times[-1]:g} over {config.times[-2]:g}",
                            float(data.kept[i]), float(data.kept_stderr[i])))  # fmt: skip
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    lines = []
    for i, xi in enumerate(config.strengths):
        last = data.isel(strength=i, time=-1)
        place, height, _ = front_of(data, i, -1)
        source, valley = float(last.energy[config.site - 1]), float(last.energy[config.site - 1 : place].min())
        if xi == 0:
            lines.append(
                "xi = 0: one broad peak that travels and spreads, as group velocities say; nothing stays at the source."
            )
            continue
        lines.append(
            f"xi = {xi:g}: two peaks at every instant shown, at the source and at the front; at t = {config.times[-1]:g} they stand "
            f"{source / valley:.3g} and {height / valley:.3g} times above the valley between them.\n"
            f"  Behind the front the curves fall on one another: {100 * float(data.kept[i]):.1f} % of the energy in p <= {behind(config)} "
            f"at t = {config.times[-2]:g} is still there at t = {config.times[-1]:g}."
        )  # fmt: skip
    return "\n".join(lines)


def script(name: str, config: Config, smoke: Config) -> harness.Script:
    return harness.Script(name, config, smoke, measure, draw, compare, explain)


SCRIPT = script("fig02", Config(), SMOKE)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
