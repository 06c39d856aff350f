"""Fig. 14: decay of the energy in band 23 and its rise in band 20, with the linear (L) and nonlinear (NL) fits.

The paper fits from 2 dt to 8 dt (L) and from 2 dt to 18 dt (NL) "with dt = 1". Both readings of dt are measured.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import harness
import numpy as np
import torch
import xarray
from harness import Ensemble, Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import minimize_scalar
from torch import Tensor

import torchchain as tc
from torchchain import plots
from torchchain.master.fits import linear_rates, nonlinear_rates


@dataclass(frozen=True)
class Config(Ensemble):
    strength: float = 0.3
    """disorder xi"""
    source: int = 23
    receiver: int = 20
    fit_steps: tuple[float, ...] = (0.25, 1.0)
    """readings of the paper's dt, multiples of the time step"""
    linear: tuple[int, int] = (2, 8)
    """window of L in dt"""
    nonlinear: tuple[int, int] = (2, 18)
    """window of NL in dt"""
    late: tuple[float, ...] = (500.0, 5000.0)
    """ends of later looks at the steady state"""


SMOKE = Config(realizations=8, stop=20.0)
PROCEDURES = ("L", "NL at t0", "NL at 2 t0", "NL at 3 t0")
PRINTED = {  # (source, band): by procedure
    (23, 23): {"L": "-0.18", "NL": "-0.20", "steady": "0.10"},
    (23, 20): {"L": "0.0079", "NL": "0.0081", "steady": "0.055"},
    (20, 20): {"L": "-0.161", "NL": "-0.165", "steady": "0.13"},
    (20, 23): {"L": "0.0071", "NL": "0.0070", "steady": "0.04"},
}
WAVENUMBER = {23: "2.159", 20: "1.86"}


def measure(config: Config, device: str) -> xarray.Dataset:
    transfer = tc.band_transfer(config.scene(config.strength), device=device)
    pair = [config.source - 1, config.receiver - 1]
    free = (1 - tc.basis_fraction(config.strength, config.n_bands))[pair]
    blocks, times = transfer.block_mean[:, pair][..., pair], transfer.times
    shape = (len(config.fit_steps), len(PROCEDURES), 2)
    rate, error, curves = np.empty(shape), np.empty(shape), np.empty((*shape[:1], 2, 2, len(times)))
    for i, dt in enumerate(config.fit_steps):
        every = round(dt / config.step)
        windows = [(first * dt, last * dt) for first, last in (config.linear, config.nonlinear)]

        def fits(mean: Tensor, every: int = every, windows: list[tuple[float, float]] = windows) -> Tensor:
            return _fits(times, mean, every, free, windows)

        rate[i], error[i] = (
            part[: len(PROCEDURES)].numpy() for part in harness.jackknife(blocks, transfer.block_counts, fits)
        )
        whole = fits(transfer.mean[pair][..., pair])
        t = times[:, None]
        level, x, onset, middle = whole[-4:]
        line = middle + whole[0] * free[0] * (t - sum(windows[0]) / 2)
        exponential = level + whole[1] * free[0] / x * torch.expm1(x * (t - onset))
        curves[i] = torch.stack([line.mT, exponential.mT], dim=1).numpy()
    return _dataset(config, transfer, rate, error, curves, _steady(config, device))


def _fits(
    times: Tensor, mean: Tensor, every: int, free: Tensor, windows: list[tuple[float, float]]
) -> Tensor:  # fmt: skip
    """Rates of the source's decay and the receiver's rise by every procedure, then the curves' level, x, t0 and height."""
    t, mean = times[::every], mean[:, ::every]
    straight = linear_rates(t, mean, free, windows[0])[0]
    inside = (t >= windows[0][0]) & (t <= windows[0][1])
    rates, converged, onset = nonlinear_rates(t, mean, free, windows[1])
    level = torch.tensor([1.0, 0.0], dtype=torch.float64)
    speed = torch.zeros(2, dtype=torch.float64)
    for r in range(2):
        speed[r] = _speed(
            t, mean[0, :, r], float(level[r]), float(rates[0, r] * free[0]), float(onset[0, r]), windows[1]
        )
    slopes = [torch.where(converged[0], rates[0] * torch.exp(speed * m * onset[0]), torch.nan) for m in range(3)]
    return torch.stack([straight, *slopes, level, speed, onset[0], mean[0, inside].mean(0)])


def _speed(t: Tensor, y: Tensor, level: float, slope: float, onset: float, window: tuple[float, float]) -> float:
    """The exponent x < 0 of a fit whose slope at the onset is known."""
    inside = ((t >= window[0]) & (t <= window[1])).numpy()
    span, y = t.numpy()[inside] - onset, y.numpy()[inside]

    def misfit(log_speed: float) -> float:
        x = -np.exp(log_speed)
        return float(np.square(level + slope / x * np.expm1(x * span) - y).sum())

    return -float(np.exp(minimize_scalar(misfit, bounds=(np.log(1e-3), np.log(1e2)), method="bounded").x))


def _steady(config: Config, device: str) -> xarray.Dataset:
    """Band energies in the last tenth before each of the later times."""
    width = config.n_particles // (2 * config.n_bands)
    tone = (2 * config.source - 1) * width // 2 + (width % 2)
    times = torch.cat([torch.arange(round(0.9 * end), end, max(1, end // 1000)) for end in config.late])
    data = tc.simulate(config.scene(config.strength, (tone,), times=times.double().unique()), device=device)
    return data.isel(tone=0).assign_attrs(tone=tone)


def _dataset(
    config: Config, transfer: tc.BandTransfer, rate: np.ndarray, error: np.ndarray, curves: np.ndarray,
    late: xarray.Dataset,
) -> xarray.Dataset:  # fmt: skip
    bands = [config.source, config.receiver]
    index = [band - 1 for band in bands]
    last = transfer.times >= 0.8 * config.stop
    steady = harness.jackknife(
        transfer.block_mean[:, index[0]][..., index], transfer.block_counts, lambda mean: mean[last].mean(0)
    )
    looks = [(steady[0].numpy(), steady[1].numpy())]
    for end in config.late:
        part = late.sel(band=bands, time=slice(0.9 * end, end)).mean("time")
        looks.append((part.band_energy.values, part.band_energy_stderr.values))
    ends = transfer.to_dataset().sel(source=config.source, receiver=bands)
    looks.append((ends.long_time.values, ends.long_time_stderr.values))
    steps = ("fit_step", "procedure", "band")
    return xarray.Dataset(
        {
            "energy": (("time", "band"), transfer.mean[index[0]][:, index].numpy(), {"units": "1"}),
            "energy_stderr": (("time", "band"), transfer.stderr[index[0]][:, index].numpy(), {"units": "1"}),
            "rate": (steps, rate, harness.RATE),
            "rate_stderr": (steps, error, harness.RATE),
            "fit": (("fit_step", "band", "curve", "time"), curves, {"units": "1"}),
            "steady": (("until", "band"), np.array([look[0] for look in looks]), {"units": "1"}),
            "steady_stderr": (("until", "band"), np.array([look[1] for look in looks]), {"units": "1"}),
        },
        coords={
            "time": ("time", transfer.times.numpy(), harness.TIME),
            "band": bands,
            "fit_step": list(config.fit_steps),
            "procedure": list(PROCEDURES),
            "curve": ["L", "NL"],
            "until": [config.stop, *config.late, np.inf],
        },
        attrs={"tone": int(late.attrs["tone"])},
    )


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(len(config.fit_steps), 2)
    for row, dt in zip(axes, config.fit_steps, strict=True):
        for ax, band in zip(row, data.band.values, strict=True):
            _panel(ax, data.sel(band=band, fit_step=dt), config)
            kind = "decay of the source" if band == config.source else "rise of a receiver:"
            ax.set_title(f"{kind} band {band}, $\\Delta t$ = {dt:g}")
    plots.lettered(axes.flat)
    figure.suptitle(f"source band {config.source} (tone {data.tone}), $\\xi$ = {config.strength:g}")
    return figure


def _panel(ax: Axes, data: xarray.Dataset, config: Config) -> None:
    dt, energy = float(data.fit_step), data.energy.values
    end = min(config.stop, 1.4 * config.nonlinear[1] * dt)
    plots.curve(ax, data.time.values, energy, data.energy_stderr.values, color="k", label="ensemble", linewidth=2)
    for curve, window, color in (("L", config.linear, "C0"), ("NL", config.nonlinear, "C1")):
        first, last = window[0] * dt, window[1] * dt
        inside = (data.time.values >= first - 1e-9) & (data.time.values <= last + 1e-9)
        fit = data.fit.sel(curve=curve).values
        if np.isnan(fit).any():
            continue  # it did not converge
        ax.plot(data.time.values, fit, "--", color=color, linewidth=1)
        ax.plot(data.time.values[inside], fit[inside], color=color, label=f"{curve}, fitted {first:g} to {last:g}")
    ax.set(xlabel=plots.TIME_LABEL, ylabel="share of the energy", xlim=(0, end))
    shown = energy[data.time.values <= end]
    if data.steady[-1] < shown.max():
        ax.axhline(float(data.steady[-1]), color="0.5", linestyle=":", label="infinite time")
    margin = 0.12 * (shown.max() - shown.min())
    ax.set_ylim(min(shown.min(), 0) - margin * (shown[0] < 0.5), shown.max() + margin)
    ax.legend(fontsize="small")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    k = 2 * np.pi * data.tone / config.n_particles
    rows = [Row("k_ins", float(k), paper=WAVENUMBER.get(config.source, ""))]
    for band in (config.source, config.receiver):
        printed = PRINTED.get((config.source, band), {})
        for dt in config.fit_steps:
            for procedure in PROCEDURES:
                part = data.sel(band=band, fit_step=dt, procedure=procedure)
                rate, error = float(part.rate), float(part.rate_stderr)
                if np.isnan(rate):
                    continue
                paper = printed.get(procedure.partition(" ")[0], "")
                rows.append(Row(f"Q {config.source},{band}  {procedure}, dt = {dt:g}", rate, error, paper))
        for until in data.until.values:
            part = data.sel(band=band, until=until)
            when = "at infinite time" if np.isinf(until) else f"before t = {until:g}"
            rows.append(Row(f"steady state of band {band} {when}", float(part.steady), float(part.steady_stderr),
                            printed.get("steady", "")))  # fmt: skip
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    lost = int(np.isnan(data.rate.sel(procedure="NL at t0")).sum())
    return (
        "L: the paper's rates come out with dt = 0.25 (a window from 0.5 to 2). With dt = 1 as printed (2 to 8) the line lies in\n"
        "the saturating part and the decay comes out half as fast. NL: Section 3.5 defines the rate at t0 and takes it at 2 t0\n"
        "or 3 t0, which is a matter of tens of percent. The decay passes the paper's rates between t0 and 3 t0 with dt = 0.25,\n"
        "and between 2 t0 and 3 t0 with dt = 1, where the rise at 3 t0 is still some 10 % fast: NL does not tell the two\n"
        "readings apart, L does.\n"
        "Steady states: the paper's are those before t = 50, except the 0.04 of band 23 from band 20, which no time gives here.\n"
        "The source's own share rises on from there: its exact average over infinite time is higher by several standard errors,\n"
        "where the paper finds no further transfer up to t = 5000. k_ins: tone n has k = 2 pi n / (N + 1); the paper's numbers\n"
        "are the lower edges of the bands."
        + (f"\n{lost} nonlinear fits did not converge (straight within the window) and have no row." if lost else "")
    )


SCRIPT = harness.Script("fig14", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
