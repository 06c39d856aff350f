"""Fig. 7: mean squared width r^2(t) of the energy after a kick beside the wall, from the same chains as Fig. 6."""

from __future__ import annotations

import sys
from dataclasses import replace

import fig06
import harness
import numpy as np
import xarray
from fig04 import restored
from fig06 import Config
from harness import Row
from matplotlib.figure import Figure

from torchchain import plots

KINDS = ((1.95, "superballistic"), (1.05, "superdiffusive"), (0.95, "diffusive"), (0.0, "subdiffusive"))


def local_slopes(times: np.ndarray, width: np.ndarray, points: int = 100) -> tuple[np.ndarray, np.ndarray]:
    """d log r^2 / d log t between points half an octave apart."""
    ends = np.geomspace(max(1.0, times[0]), times[-1], points)
    half = 2**0.25
    inside = ends[(ends >= ends[0] * half) & (ends <= times[-1] / half)]
    log = np.log(np.interp([inside / half, inside * half], times, width))
    return inside, (log[1] - log[0]) / (2 * np.log(half))


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2, width=5.8, height=4.6)
    left, right = axes[0]
    times = data.time.values
    shown = times >= 1
    for i, (xi, fit) in enumerate(zip(config.strengths, restored(data), strict=True)):
        part = data.isel(strength=i)
        plots.curve(left, times[shown], part.width.values[shown], part.width_stderr.values[shown], color=f"C{i}",
                    label=f"$\\xi$ = {xi:g}, exponent {fit.exponent:.2f}")  # fmt: skip
        ends = np.array(config.window)
        left.plot(ends, fit(ends), "k--", lw=0.8)
        right.plot(*local_slopes(times, part.width.values), color=f"C{i}", label=f"$\\xi$ = {xi:g}")
    left.plot([], [], "k--", lw=0.8, label="power laws")
    left.set(xlabel=plots.TIME_LABEL, ylabel="mean squared width r$^2$", xscale="log", yscale="log", title="(a)")
    left.legend(fontsize="small")
    for value, text in ((2, "ballistic"), (1, "diffusive"), (0.5, "$\\xi$ > 0,\ninfinite time")):
        right.axhline(value, color="k", lw=0.6, ls=":")
        right.text(1.02, value, text, fontsize="small", va="center", transform=right.get_yaxis_transform())
    right.axvspan(*config.window, color="0.93", zorder=0)
    right.set(
        xlabel=plots.TIME_LABEL,
        ylabel="local exponent d log r$^2$ / d log t",
        xscale="log",
        ylim=(0, None),
        title="(b)",
    )
    figure.suptitle(
        f"kick at particle {config.site}, {config.realizations} chains; gray: window of the power laws",
        fontsize="medium",
    )
    return figure


def kind(exponent: float) -> str:
    return next(name for limit, name in KINDS if exponent > limit)


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i, (xi, fit) in enumerate(zip(config.strengths, restored(data), strict=True)):
        rows += fit.rows(f"xi = {xi:g}: r^2 ~ t^a")
        times, slopes = local_slopes(data.time.values, data.width.values[i])
        best = int(slopes[times > 5].argmax())
        rows.append(Row(f"xi = {xi:g}: largest local exponent beyond t = 5", float(slopes[times > 5][best]),
                        note=f"at t = {times[times > 5][best]:.0f}"))  # fmt: skip
        if xi == 0:
            last = data.isel(strength=i, time=-1)
            limit = 0.5 - fig06.BALLISTIC**2
            rows.append(
                Row(
                    f"xi = 0: r^2 / t^2 at t = {config.stop:g}",
                    float(last.width) / config.stop**2,
                    note=f"limit {limit:.6f}",
                )
            )
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    fits = restored(data)
    named = ", ".join(f"{xi:g} {kind(fit.exponent)}" for xi, fit in zip(config.strengths, fits, strict=True) if xi > 0)
    bent = sum(fit.bends for xi, fit in zip(config.strengths, fits, strict=True) if xi > 0)
    return (
        f"By the exponent in the window: {named}.\n"
        "The paper's order, from slightly superballistic at first (weak disorder leaves energy at the wall and so widens the wave) to subdiffusive, is there.\n"
        f"But {bent} of the {len(fits) - (config.strengths[0] == 0)} exponents fall within their own window by more than three standard errors: each names a time, not a class.\n"
        "The kick beside a fixed wall belongs to the class of a displacement kick, for which r^2 ~ t^(1/2) for t to infinity at any xi > 0."
    )


SCRIPT = replace(fig06.SCRIPT, name="fig07", draw=draw, compare=compare, explain=explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
