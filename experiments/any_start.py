"""Any start: one calibrated model against fresh chains, for starts that it was and was not calibrated on, in units of their noise."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain.ensemble.fused import band_energy
from torchchain.ensemble.scene_file import regular_times

EARLY = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
DENSE = regular_times(0.0, 5.0, 0.25)
"""First times of the calibration."""
CHAINS = 20
"""Chains whose motion is held at once."""


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """An ensemble to calibrate on, and fresh chains to compare with."""

    seed: int = 5
    """of the calibration; ensembles 0 and 1 are those that the constants of the model were chosen on"""
    realizations: int = 400
    """chains to calibrate on"""
    fresh: int = 400
    """chains to compare with, of another seed"""
    strength: float = 0.3
    """disorder xi"""
    stop: float = 400.0
    """last time"""
    step: float = 2.0
    """time step of the calibration"""
    output_step: float = 8.0
    """time step of the comparison, after some earlier times"""


SMOKE = Config(n_particles=64, n_bands=8, realizations=8, fresh=8, stop=20.0, step=1.0, output_step=4.0)


def calibrating(config: Config) -> tc.Scene:
    """The scene of the calibration."""
    later = regular_times(config.step, config.stop, config.step)
    return config.scene(config.strength, times=torch.cat([DENSE, later[later > DENSE[-1]]]))


def starts(config: Config) -> dict[str, tc.State]:
    """Named groups of starts, displacement and velocity (start, particle); the same for every chain."""
    n, width = config.n_particles, config.n_particles // 2 // config.n_bands
    place = torch.arange(1, n + 1, dtype=torch.float64)
    tones = torch.tensor(config.scene(config.strength).tones)
    draw = torch.Generator().manual_seed(config.seed)

    def wave(numbers: Tensor, phase: Tensor | float = 0.0) -> Tensor:
        """Sines of unit potential energy, (tone, particle)."""
        k = (2 * math.pi / n * numbers)[:, None]
        return torch.sin(k * place + torch.as_tensor(phase, dtype=torch.float64).reshape(-1, 1)) / torch.sin(k / 2)

    def turned(shape: tuple[int, ...]) -> Tensor:
        return 2 * math.pi * torch.rand(shape, generator=draw, dtype=torch.float64)

    every, quarter = torch.arange(1, n // 2), math.pi / 2
    others = every[~torch.isin(every, tones)]
    pairs = torch.stack([torch.randperm(len(tones), generator=draw)[:2] for _ in range(config.n_bands // 2)])
    mixed = torch.stack([wave(tones[pair], turned((2,))).sum(0) for pair in pairs])
    whole = torch.stack([wave(tones, turned((len(tones),))).sum(0) for _ in range(config.n_bands // 4)])
    sine, frequency = wave(tones), 2 * torch.sin(math.pi / n * tones)[:, None]
    onward = -frequency * wave(tones, quarter)  # of sin(k p - w t)
    chosen = tones[[len(tones) * i // 6 for i in range(1, 6)]]
    k = (2 * math.pi / n * chosen)[:, None]
    envelope = torch.exp(-(((place - n / 2) / (n / 16)) ** 2) / 2)
    slope = -(place - n / 2) / (n / 16) ** 2  # the envelope moves at the group velocity cos(k / 2)
    packet = envelope * torch.sin(k * place)
    moving = -2 * torch.sin(k / 2) * envelope * torch.cos(k * place) - torch.cos(k / 2) * slope * packet
    bead = torch.eye(n, dtype=torch.float64)[:: n // 16]
    noise = torch.randn(2, 4, n, generator=draw, dtype=torch.float64)
    pairs_of = {
        "calibrated tone, sine": (sine, None), "calibrated tone, cosine": (wave(tones, quarter), None),
        "two bands at once": (mixed, None), "all bands, random phases": (whole, None),
        "another tone of the band": (wave(others), None), "initial velocity": (None, frequency * sine),
        "velocity, another tone": (None, wave(others) * 2 * torch.sin(math.pi / n * others)[:, None]),
        "traveling wave": (sine, onward), "traveling packet": (packet, moving), "one bead kicked": (None, bead),
        "one bead displaced": (bead, None), "standing, half way": (sine, frequency * sine),
        "every bead at random": (noise[0], noise[1]),
    }  # fmt: skip
    assert width >= 1, "checked by the scene"
    return {
        name: tc.State(*(torch.zeros_like(u if u is not None else v) if x is None else x for x in (u, v)))
        for name, (u, v) in pairs_of.items()
    }


def ensemble(config: Config, start: tc.State, times: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Mean energies over their mean total, and their standard errors, (start, time, band)."""
    disorder, count = tc.Disorder(strength=config.strength), config.fresh
    sums: list[Tensor] = []
    for first in range(0, count, CHAINS):
        numbers = range(first, min(first + CHAINS, count))
        chain = tc.Chain(disorder.masses(config.n_particles, numbers, seed))
        here = tc.State(*(x.expand(len(numbers), *x.shape) for x in (start.displacement, start.velocity)))
        energy = band_energy(chain, here, times, config.n_bands, normalize=False)
        total = tc.start_energy(chain, here).total[..., None, None]
        parts = [x.sum(0) for x in (energy, energy.square(), energy * total, total, total.square())]
        sums = [a + b for a, b in zip(sums, parts, strict=True)] if sums else parts
    mean, square, cross, whole, whole_square = (x / count for x in sums)
    share = mean / whole  # and the error of a ratio of means
    spread = (square - 2 * share * cross + share.square() * whole_square).clamp(min=0).sqrt()
    return share, spread / whole / math.sqrt(count - 1)


def measure(config: Config, device: str) -> xarray.Dataset:
    master = tc.calibrate(tc.band_transfer(calibrating(config), "chebyshev"))
    later = regular_times(config.output_step, config.stop, config.output_step)
    times = torch.cat([torch.tensor(EARLY, dtype=torch.float64), later[later > EARLY[-1]]])
    ordered = tc.Chain(torch.ones(config.n_particles, dtype=torch.float64))
    groups, found = starts(config), {}
    every = tc.State(*(torch.cat([getattr(s, name) for s in groups.values()]) for name in ("displacement", "velocity")))
    labels = [name for name, state in groups.items() for _ in state.displacement]
    fresh, noise = ensemble(config, every, times, config.seed + 1000)
    again, again_noise = ensemble(config, every, times, config.seed + 2000)
    start = tc.start_energy(ordered, every)
    told, error = (f(start, times) / start.total[:, None, None] for f in (master.solve, master.standard_error))
    bands = start.bands(config.n_bands)
    plain = master.solve(bands, times) / start.total[:, None, None]
    axes = ("start", "time", "band")
    for name, values in {"fresh": fresh, "fresh_stderr": noise, "another": again, "another_stderr": again_noise, "model": told, "model_stderr": error, "bands_alone": plain}.items():  # fmt: skip
        found[name] = (axes, values.numpy(), {"units": "1", "long_name": f"share of the energy, {name}"})
    coords = {"start": labels, "time": ("time", times.numpy(), harness.TIME), "band": np.arange(1, config.n_bands + 1)}
    parameters = {"bands": master.n_parameters, "starts": master.starts.n_parameters if master.starts else 0}
    return xarray.Dataset(found, coords=coords, attrs=parameters)


def distances(data: xarray.Dataset, model: str) -> xarray.DataArray:
    """Total variation of each start, averaged over time."""
    return mean_over_time(abs(data[model] - data.fresh).sum("band") / 2)


def noises(data: xarray.Dataset) -> xarray.DataArray:
    """The same between two ensembles like the fresh one."""
    return mean_over_time(data.fresh_stderr.sum("band") / math.sqrt(math.pi))


def mean_over_time(values: xarray.DataArray) -> xarray.DataArray:
    return values.integrate("time") / float(values.time[-1] - values.time[0])


def covered(data: xarray.Dataset) -> xarray.DataArray:
    """Share of the energies of both fresh ensembles within one standard error of the model's and theirs, (start, time)."""
    shares = [
        (abs(data.model - data[name]) <= np.sqrt(data.model_stderr**2 + data[f"{name}_stderr"] ** 2)).mean("band")
        for name in ("fresh", "another")
    ]
    return (shares[0] + shares[1]) / 2


def covered_by_ensembles(data: xarray.Dataset) -> xarray.DataArray:
    """Share of the energies of one fresh ensemble within one standard error of both of the other's, (start, time)."""
    error = np.sqrt(data.fresh_stderr**2 + data.another_stderr**2)
    return (abs(data.fresh - data.another) <= error).mean("band")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for name in dict.fromkeys(data.start.values.tolist()):
        part = data.isel(start=np.flatnonzero(data.start.values == name))
        off, noise = distances(part, "model"), noises(part)
        early, ratio = part.sel(time=slice(None, 5.0)), off / noise
        other = distances(part, "another") / noise
        first = float(distances(early, "model").mean() / noises(early).mean())
        rows.append(
            Row(
                f"{name} ({part.sizes['start']})", float(off.mean()),
                note=f"{float(off.mean() / noise.mean()):.2f} times its noise, t <= 5: {first:.2f}; above 1.25: {100 * float((ratio > 1.25).mean()):.0f} %, "
                f"the worst {float(ratio.max()):.2f} (another ensemble: {100 * float((other > 1.25).mean()):.0f} %, {float(other.max()):.2f}); "
                f"{100 * float(covered(part).mean()):.0f} % within one error, t <= 5: {100 * float(covered(early).mean()):.0f} % "
                f"(two ensembles: {100 * float(covered_by_ensembles(part).mean()):.0f}, {100 * float(covered_by_ensembles(early).mean()):.0f} %); "
                f"by its bands alone {float(distances(part, 'bands_alone').mean() / noise.mean()):.1f} times",
            )
        )  # fmt: skip
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2, width=5.2)
    names = list(dict.fromkeys(data.start.values.tolist()))
    for row, name in enumerate(names):
        part = data.isel(start=np.flatnonzero(data.start.values == name))
        noise = float(noises(part).mean())
        axes[0, 0].plot(float(distances(part, "bands_alone").mean()) / noise, -row, "C1o", mfc="none")
        axes[0, 0].plot(float(distances(part, "model").mean()) / noise, -row, "C0o")
        axes[0, 1].plot(100 * float(covered(part).mean()), -row, "C0o")
        axes[0, 1].plot(100 * float(covered_by_ensembles(part).mean()), -row, "k|")
    axes[0, 0].set_yticks([-row for row in range(len(names))], names)
    axes[0, 1].set_yticks([-row for row in range(len(names))], [])
    axes[0, 0].axvline(1.25, color="k", lw=0.8)
    axes[0, 0].set(xscale="log", xlabel="distance from fresh chains / that of two ensembles", title="model of starts; open: of its bands alone")
    axes[0, 1].axvspan(60, 76, color="0.9")
    axes[0, 1].set(xlabel="energies within one standard error (%)", title=f"$\\xi$ = {config.strength:g}, {config.realizations} chains; bars: two ensembles")
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"measured: total variation from {config.fresh} fresh chains, mean over {float(data.time[0]):g} <= t <= {config.stop:g} and over the starts of a line (their number in\n"
        "brackets). Its noise: what is expected between two ensembles of as many chains; another ensemble: what it was with one. Within one error of model\n"
        "and chains, of both fresh ensembles; in brackets those of one within one error of the other. Energies of chains are means over the mean of their total.\n"
        f"Fitted numbers: {data.attrs['bands']} for the bands, {data.attrs['starts']} for the starts."
    )


SCRIPT = harness.Script("any_start", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
