"""Figures: axes in, axes out, no computation. Widths and letters are those of a journal's page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from torchchain import checks

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes

TIME_LABEL = "time $t$"
BAND_LABEL = "wavenumber band $r$"
COLUMN, PAGE = 3.5, 7.1
"""Widths of a journal's column and of its page, in inches."""
COLORS = ("#0072b2", "#d55e00", "#000000", "#56b4e9", "#009e73", "#e69f00", "#cc79a7")
"""Told apart by the color-blind; in gray by the dashes that go with them."""
DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)), (0, (3, 1)), (0, (1, 1)))


@dataclass(frozen=True)
class Room:
    """Inches around panels for their labels, at the edges of a figure and between panels; colorbars take theirs from a panel."""

    left: float
    right: float
    below: float
    above: float
    across: float
    down: float


@contextmanager
def style() -> Iterator[None]:
    """Sizes for print while a figure is drawn: eight points, thin frames, colors and dashes that gray does not confuse."""
    import matplotlib
    from cycler import cycler

    looks: Any = {
        "font.size": 8, "axes.titlesize": 8, "axes.labelsize": 8, "figure.titlesize": 8, "legend.fontsize": 7,
        "xtick.labelsize": 7, "ytick.labelsize": 7, "lines.linewidth": 1.2, "lines.markersize": 3.5, "axes.linewidth": 0.6,
        "legend.frameon": False, "legend.handlelength": 2.2, "legend.columnspacing": 1.0, "legend.labelspacing": 0.2, "errorbar.capsize": 1.5, "axes.titlelocation": "left",
        "axes.prop_cycle": cycler(color=COLORS) + cycler(linestyle=DASHES),
    }  # fmt: skip
    with matplotlib.rc_context(looks):
        yield


def lettered(axes: Iterable[Axes]) -> None:
    """(a), (b), ... before the titles of the panels, each once; titles are right above the panels and give way to nothing."""
    for letter, ax in zip("abcdefghijklmnopqrstuvwxyz", (ax for ax in axes if ax.axison), strict=False):
        ax.set_title(f"({letter}) {ax.get_title('left')}".rstrip(), loc="left", y=1.0)


def legend(ax: Axes, columns: int = 2, **where: Any) -> None:
    """A legend below the axes, off the data."""
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.3, ncols=columns, **where)


def _colorbar(ax: Axes, image: Any, label: str, extend: str) -> None:
    """The colors of an image beside its axes; without minor ticks, which take a tenth of a second each time they are drawn."""
    ax.figure.colorbar(image, ax=ax, label=label, extend=extend).minorticks_off()


def band_map(ax: Axes, times: np.ndarray, energy: np.ndarray, title: str = "", floor: float = 1e-3) -> Axes:
    """Share of the energy over time and band (as Figs. 12 and 18), energy [time, band], logarithmic colors."""
    bands = np.arange(1, energy.shape[-1] + 1)
    return log_map(ax, times, bands, energy, TIME_LABEL, BAND_LABEL, "share of energy", title, floor)


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
    _colorbar(ax, image, label, extend="both" if limit is not None and signed else "neither")
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
    _colorbar(ax, image, label, extend="both" if values.max() > top * (1 + 1e-9) else "min")
    ax.set(xlabel=xlabel, ylabel=ylabel, title=title)
    return ax


def share_matrix(ax: Axes, shares: np.ndarray, title: str = "", floor: float = 1e-3) -> Axes:
    """Shares of the energy [source, receiver] at one time, logarithmic colors; less is drawn as the floor."""
    return _matrix(ax, shares, "share of energy", title, floor, 1.0)


def rate_map(ax: Axes, rates: np.ndarray, title: str = "", top: float | None = None) -> Axes:
    """Rates between bands (as Fig. 17), rates [source, receiver]; the diagonal shows the loss rate -Q_ss."""
    shown = np.where(np.eye(len(rates), dtype=bool), -rates, rates)
    top = float(shown.max()) if top is None else top
    top = top if top > 0 else 1.0
    return _matrix(ax, shown, "rate", title, top * 1e-4, top)


def _matrix(ax: Axes, values: np.ndarray, label: str, title: str, floor: float, top: float) -> Axes:
    """Values [source, receiver], logarithmic colors from the floor to the top."""
    bands = np.arange(1, len(values) + 1)
    log_map(ax, bands, bands, values.T, "receiver $r$", "source $s$", label, title, floor, top)
    ax.set_aspect("equal")
    ax.invert_yaxis()
    return ax


def curve(ax: Axes, x: np.ndarray, mean: np.ndarray, stderr: np.ndarray | None = None, **style: Any) -> Axes:
    """A mean with a band of one standard error."""
    (line,) = ax.plot(x, mean, **style)
    if stderr is not None and np.isfinite(stderr).all():
        ax.fill_between(x, mean - stderr, mean + stderr, color=line.get_color(), alpha=0.3, linewidth=0)
    return ax


def plot_observable(data: xarray.Dataset, name: str, log: bool = False, ax: Axes | None = None) -> Axes:
    """An observable of :func:`torchchain.simulate` over time, such as "center" (R, Eq. 37) or "width" (r^2, Eq. 38).

    Args:
        data: holds ``name`` and its standard error ``{name}_stderr`` on the axis time, drawn as a band of one error.
        name: of the observable.
        log: both axes logarithmic, without time 0, as in Figs. 6 and 7.
        ax: where to draw; None for a figure of its own, a column wide.

    Returns:
        The axes; ``ax.figure.savefig(...)`` writes them.

    Raises:
        FieldError: for a name that the data do not hold, or an observable with other axes than time.

    Example:
        >>> scene = tc.Scene(n_particles=32, boundary="fixed", excitation=tc.Impulse(), observables=("width",), realizations=4)
        >>> ax = tc.plot_observable(tc.simulate(scene, method="modes"), "width", log=True)
        >>> ax.get_xscale(), ax.get_yscale(), ax.get_ylabel()
        ('log', 'log', 'mean squared width $r^2$ (particle$^2$)')
    """
    if name not in data.data_vars or f"{name}_stderr" not in data.data_vars:
        held = [str(each).removesuffix("_stderr") for each in data.data_vars if str(each).endswith("_stderr")]
        raise checks.fail("name", f"be one of {', '.join(held)}", repr(name))
    values = data[name]
    if values.dims != ("time",):
        raise checks.fail(
            "name", "be of an observable with the axis time alone", f"{name} with {', '.join(map(str, values.dims))}"
        )
    ax = own_axes() if ax is None else ax
    kept = data["time"].values > 0 if log else slice(None)
    curve(ax, data["time"].values[kept], values.values[kept], data[f"{name}_stderr"].values[kept])
    ax.set(xlabel=TIME_LABEL, ylabel=label_of(values), **({"xscale": "log", "yscale": "log"} if log else {}))
    return ax


def label_of(values: xarray.DataArray) -> str:
    """Name, symbol and unit of a variable or axis, symbols as such: "mean squared width r^2", "particle^2"."""
    name, units = str(values.attrs.get("long_name", values.name)), str(values.attrs.get("units", ""))
    name = re.sub(r"(?<= )(\|?[a-zA-Z]\|?(?:\^\d)?)$", r"$\1$", name)
    units = re.sub(r"\^(\d)", r"$^\1$", units)
    return f"{name} ({units})" if units else name


def own_axes() -> Axes:
    """The axes of a figure of their own, a column wide."""
    with style():
        return figure(COLUMN, 2.7, 1, 1)[1][0, 0]


def decays(
    ax: Axes, times: np.ndarray, mean: np.ndarray, stderr: np.ndarray | None, source: int, receivers: Sequence[int],
    predicted: np.ndarray | None = None, log: bool = True,
) -> Axes:  # fmt: skip
    """Share of the energy of one source in some receivers over time (as Fig. 14), with a band of one standard error.

    Args:
        mean, stderr, predicted: [time, receiver]; a prediction is drawn as dots in the color of what it predicts.
        source, receivers: counted from 1, for the labels.
        log: logarithmic shares.
    """
    for receiver in receivers:
        column = (slice(None), receiver - 1)
        curve(ax, times, mean[column], None if stderr is None else stderr[column], label=f"{source} to {receiver}")
        if predicted is not None:
            every = max(1, len(times) // 20)
            ax.plot(times[::every], predicted[column][::every], "o", mfc="none", color=ax.lines[-1].get_color())
    if predicted is not None:
        ax.plot([], [], "o", mfc="none", color="0.3", label="model")
    limits = {"yscale": "log", "ylim": (1e-4, 1.5)} if log else {"ylim": (0, 1.05)}
    ax.set(xlabel=TIME_LABEL, ylabel="share of energy", **limits)
    legend(ax)
    return ax


def distance_curve(ax: Axes, times: np.ndarray, distance: np.ndarray, statistical: np.ndarray, title: str = "") -> Axes:
    """Total variation of model and ensemble over time, mean over sources and the worst, arrays [source, time]."""
    curve(ax, times, distance.mean(0), label="model, mean of sources")
    curve(ax, times, distance.max(0), label="model, worst source")
    curve(ax, times, statistical.mean(0), label="two such ensembles", color="k", linestyle=":")
    ax.set(xlabel=TIME_LABEL, ylabel="total variation", title=title, ylim=(0, None))
    legend(ax, columns=1)
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


def figure(width: float, height: float, rows: int, columns: int, room: Room | None = None) -> Any:
    """A figure and its axes (row, column), with the room for labels that they need, or with that which is given: faster by far."""
    import matplotlib.figure

    if room is None:
        figure = matplotlib.figure.Figure(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(rows, columns, squeeze=False)
    figure = matplotlib.figure.Figure(figsize=(width, height))
    figure.subplots_adjust(
        room.left / width, room.below / height, 1 - room.right / width, 1 - room.above / height,
        room.across / ((width - room.left - room.right - (columns - 1) * room.across) / columns),
        room.down / ((height - room.below - room.above - (rows - 1) * room.down) / rows),
    )  # fmt: skip
    return figure, figure.subplots(rows, columns, squeeze=False)
