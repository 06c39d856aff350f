"""Figures: axes in, axes out, no computation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIME_LABEL = "time t"
BAND_LABEL = "wavenumber band r"


def band_map(ax: Axes, times: np.ndarray, energy: np.ndarray, title: str = "", floor: float = 1e-3) -> Axes:
    """Share of the energy over time and band (as Figs. 12 and 18), energy [time, band], logarithmic colors."""
    bands = np.arange(1, energy.shape[-1] + 1)
    from matplotlib.colors import LogNorm

    image = ax.pcolormesh(
        times, bands, np.maximum(energy.T, floor), norm=LogNorm(floor, 1.0), shading="nearest", rasterized=True
    )
    ax.figure.colorbar(image, ax=ax, label="share of energy")
    ax.set(xlabel=TIME_LABEL, ylabel=BAND_LABEL, title=title)
    return ax


def field_map(
    ax: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, xlabel: str, ylabel: str, label: str,
    title: str = "", limit: float | None = None, signed: bool = False,
) -> Axes:  # fmt: skip
    """Any quantity over two axes (as Figs. 9 to 11), values [x, y]; colors end at ``limit``."""
    from matplotlib.colors import Normalize

    top = float(np.abs(values).max()) if limit is None else limit
    norm = Normalize(-top if signed else 0.0, top or 1.0)
    image = ax.pcolormesh(
        x, y, values.T, norm=norm, cmap="RdBu_r" if signed else "viridis", shading="nearest", rasterized=True
    )
    ax.figure.colorbar(image, ax=ax, label=label, extend="both" if limit is not None and signed else "neither")
    ax.set(xlabel=xlabel, ylabel=ylabel, title=title)
    return ax


def log_map(
    ax: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, xlabel: str, ylabel: str, label: str,
    title: str = "", floor: float = 1e-4, top: float = 1.0,
) -> Axes:  # fmt: skip
    """A share of the energy over two axes (as Figs. 10 and 11), values [x, y], logarithmic colors; less is drawn as the floor."""
    from matplotlib.colors import LogNorm

    image = ax.pcolormesh(
        x, y, np.maximum(values.T, floor), norm=LogNorm(floor, top), shading="nearest", rasterized=True
    )
    ax.figure.colorbar(image, ax=ax, label=label, extend="both" if values.max() > top else "min")
    ax.set(xlabel=xlabel, ylabel=ylabel, title=title)
    return ax


def rate_map(ax: Axes, rates: np.ndarray, title: str = "", top: float | None = None) -> Axes:
    """Rates between bands (as Fig. 17), rates [source, receiver]; the diagonal shows the loss rate -Q_ss."""
    shown = np.where(np.eye(len(rates), dtype=bool), -rates, rates)
    bands = np.arange(1, len(rates) + 1)
    top = float(shown.max()) if top is None else top
    top = top if top > 0 else 1.0
    from matplotlib.colors import LogNorm

    image = ax.pcolormesh(
        bands, bands, np.clip(shown, top * 1e-4, None), norm=LogNorm(top * 1e-4, top), shading="nearest"
    )
    ax.figure.colorbar(image, ax=ax, label="rate")
    ax.set(xlabel="receiver r", ylabel="source s", title=title, aspect="equal")
    ax.invert_yaxis()
    return ax


def curve(ax: Axes, x: np.ndarray, mean: np.ndarray, stderr: np.ndarray | None = None, **style: Any) -> Axes:
    """A mean with a band of one standard error."""
    (line,) = ax.plot(x, mean, **style)
    if stderr is not None and np.isfinite(stderr).all():
        ax.fill_between(x, mean - stderr, mean + stderr, color=line.get_color(), alpha=0.25, linewidth=0)
    return ax


def decay_comparison(
    ax: Axes, times: np.ndarray, measured: np.ndarray, stderr: np.ndarray, predicted: np.ndarray,
    pairs: list[tuple[int, int]], title: str = "",
) -> Axes:  # fmt: skip
    """Energy of some receivers over time (as Fig. 14): ensemble with error band, model dashed.

    Arrays are [source, time, receiver]; pairs of source and receiver are counted from 1.
    """
    for source, receiver in pairs:
        index = (source - 1, slice(None), receiver - 1)
        curve(ax, times, measured[index], stderr[index], label=f"{source} to {receiver}")
        ax.plot(times, predicted[index], "--", color=ax.lines[-1].get_color())
    ax.plot([], [], "k-", label="ensemble")
    ax.plot([], [], "k--", label="model")
    ax.set(xlabel=TIME_LABEL, ylabel="share of energy", title=title, yscale="log", ylim=(1e-4, 1.5))
    ax.legend(fontsize="small")
    return ax


def distance_curve(ax: Axes, times: np.ndarray, distance: np.ndarray, statistical: np.ndarray, title: str = "") -> Axes:
    """Total variation of model and ensemble over time, mean over sources and the worst, arrays [source, time]."""
    curve(ax, times, distance.mean(0), label="model, mean over sources")
    curve(ax, times, distance.max(0), label="model, worst source")
    curve(ax, times, statistical.mean(0), label="two ensembles of this size", color="k", linestyle=":")
    ax.set(xlabel=TIME_LABEL, ylabel="total variation", title=title, ylim=(0, None))
    ax.legend(fontsize="small")
    return ax


def chapman_kolmogorov(ax: Axes, times: np.ndarray, distance: np.ndarray, statistical: np.ndarray, label: str) -> Axes:
    """Total variation of T(n lag) and T(lag)^n over time, mean over sources, arrays [source, time]; dotted: by noise alone."""
    (line,) = ax.plot(times, distance.mean(0), "o-", label=label)
    ax.plot(times, statistical.mean(0), ":", color=line.get_color())
    ax.set(xlabel=TIME_LABEL, ylabel=r"total variation of $T(n\,\tau)$ and $T(\tau)^n$")
    return ax


def implied_timescales(ax: Axes, lags: np.ndarray, timescales: np.ndarray, stderr: np.ndarray, shown: int = 5) -> Axes:
    """The slowest implied timescales over the lag, [lag, timescale]; below the diagonal a timescale is shorter than the lag."""
    for i in range(min(shown, timescales.shape[1])):
        ax.errorbar(
            lags, timescales[:, i], stderr[:, i], fmt="o-", capsize=2, markersize=4, label=f"{i + 2}. eigenvalue"
        )
    ax.fill_between(lags, lags, 0, color="0.9", linewidth=0)
    ax.set(xlabel=r"lag $\tau$", ylabel=r"implied timescale $-\tau / \log|\lambda|$", yscale="log")
    return ax


def exponents(ax: Axes, x: np.ndarray, fits: Sequence[Any], xlabel: str) -> Axes:
    """Exponents of power laws with error bars, and the slopes in both halves of each one's window.

    Each fit has ``exponent``, ``stderr``, ``lower`` and ``upper``.
    """
    ax.errorbar(
        x, [fit.exponent for fit in fits], [fit.stderr for fit in fits], fmt="ko-", capsize=3, label="whole window"
    )
    ax.plot(x, [fit.lower for fit in fits], "v", color="C0", mfc="none", label="lower half")
    ax.plot(x, [fit.upper for fit in fits], "^", color="C3", mfc="none", label="upper half")
    ax.set(xlabel=xlabel, ylabel="exponent")
    return ax


def figure(width: float, height: float, rows: int, columns: int) -> Any:
    """A figure and its axes (row, column)."""
    import matplotlib.figure

    figure = matplotlib.figure.Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
