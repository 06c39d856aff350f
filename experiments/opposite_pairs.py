"""Where opposite masses in pairs save chains: standard errors with and without them, after kicks and for standing waves."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import harness
import numpy as np
import xarray
from harness import Row
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import torchchain as tc
from torchchain import plots
from torchchain.ensemble.scene_file import regular_times

NAMES = {
    "center": "center R",
    "width": "squared width r$^2$",
    "source_energy": "energy of the source",
    "band_energy": "energy in the bands",
}


@dataclass(frozen=True)
class Config:
    """Kicks at the wall and in the center of long chains, a standing wave on rings."""

    seed: int = 0
    """seed of the ensembles"""
    n_particles: int = 1024
    """particles per chain for the kicks"""
    ring: int = 256
    """particles per ring for the standing wave"""
    n_bands: int = 32
    """wavenumber bands of the ring"""
    tone: int = 90
    """tone of the standing wave"""
    realizations: int = 400
    """chains in each ensemble"""
    strengths: tuple[float, ...] = (0.1, 0.3, 0.5)
    """disorders xi"""
    stop: float = 500.0
    """last time"""
    step: float = 10.0
    """time step of the output"""


SMOKE = Config(n_particles=64, ring=32, n_bands=4, tone=11, realizations=8, strengths=(0.3,), stop=20.0)


def scenes(config: Config) -> dict[str, tc.Scene]:
    """The three starts, without their disorder."""
    common = {
        "realizations": config.realizations,
        "seed": config.seed,
        "times": regular_times(config.step, config.stop, config.step),
    }
    kick = {**common, "n_particles": config.n_particles, "boundary": "fixed"}
    seen = ("center", "width", "source_energy")
    return {
        "kick beside a wall": tc.Scene(**kick, excitation=tc.Impulse(1), observables=seen),
        "kick in the center": tc.Scene(**kick, excitation=tc.Impulse(config.n_particles // 2), observables=seen),
        f"standing wave, tone {config.tone}": tc.Scene(
            config.ring, excitation=tc.StandingWave((config.tone,)), n_bands=config.n_bands, **common
        ),
    }


def mean_square(values: xarray.DataArray) -> xarray.DataArray:
    """Over all axes but time, such as the bands."""
    return np.square(values).mean([axis for axis in values.dims if axis != "time"])


def measure(config: Config, device: str) -> xarray.Dataset:
    starts = scenes(config)
    times = next(iter(starts.values())).times.numpy()
    shape = (len(starts), len(NAMES), len(config.strengths), len(times))
    ratio, off = np.full(shape, np.nan), np.full(shape, np.nan)
    for i, scene in enumerate(starts.values()):
        for k, xi in enumerate(config.strengths):
            disordered = replace(scene, disorder=tc.Disorder(strength=xi))
            plain, pairs = (
                tc.simulate(replace(disordered, opposite_pairs=opposite), "chebyshev", device=device)
                for opposite in (False, True)
            )
            for j, name in enumerate(NAMES):
                if name in plain:
                    a, b = (mean_square(data[f"{name}_stderr"]) for data in (plain, pairs))
                    ratio[i, j, k], off[i, j, k] = b / a, np.sqrt(mean_square(plain[name] - pairs[name]) / (a + b))
    axes = ("start", "quantity", "strength", "time")
    return xarray.Dataset(
        {
            "chains": (axes, ratio, {"long_name": "chains for the same error, plain realizations = 1"}),
            "off": (axes, off, {"long_name": "difference of the means in units of its standard error"}),
        },
        coords={
            "start": list(starts),
            "quantity": list(NAMES),
            "strength": list(config.strengths),
            "time": ("time", times, harness.TIME),
        },
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, data.sizes["start"], width=4.4)
    dashes = ("-", "--", ":", "-.")
    for ax, start in zip(axes[0], data.start.values, strict=True):
        for j, name in enumerate(NAMES):
            for k in range(len(config.strengths)):
                ax.plot(data.time, data.chains.sel(start=start, quantity=name).isel(strength=k), f"C{j}{dashes[k % 4]}")
        ax.axhline(1.0, color="k", lw=0.8)
        ax.set(yscale="log", xlabel=plots.TIME_LABEL, title=str(start), ylim=(0.02, 4))
    axes[0, 0].set_ylabel("chains for the same error,\nplain realizations = 1")
    names = [Line2D([], [], color=f"C{j}", label=words) for j, words in enumerate(NAMES.values())]
    styles = [
        Line2D([], [], color="k", ls=dashes[k % 4], label=f"$\\xi$ = {xi:g}") for k, xi in enumerate(config.strengths)
    ]
    figure.legend(handles=names + styles, loc="outside right upper", fontsize="small")
    return figure


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    late = data.sel(time=slice(config.stop / 5, None))
    for start in data.start.values:
        for name in NAMES:
            for xi in config.strengths:
                part = late.sel(start=start, quantity=name, strength=xi)
                if not part.chains.isnull().all():
                    rows.append(
                        Row(
                            f"{start}, {name.replace('_', ' ')}, xi = {xi:g}: chains for the same error",
                            float(np.exp(np.log(part.chains).mean())),
                            note=f"means differ by {float(np.sqrt(np.square(part.off).mean())):.1f} of their standard error",
                        )
                    )
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"measured: squared ratio of the standard errors of {config.realizations} chains in opposite pairs and of as many plain ones, geometric\n"
        f"mean over t > {config.stop / 5:g}. Below 1 the pairs save chains: where most of the scatter is odd in the masses, as when a light or a\n"
        "heavy neighborhood lets a wave go farther or less far. Above 1 they cost chains: where it is even."
    )


SCRIPT = harness.Script("opposite_pairs", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
