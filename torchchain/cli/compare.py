"""``torchchain compare``."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchchain import checks, plots
from torchchain.cli import choices, outputs
from torchchain.cli.flags import Compare
from torchchain.ensemble.comparison import Agreement, compare, z_scores
from torchchain.results import open_folder, read_dataset

if TYPE_CHECKING:
    import xarray


def run_compare(flags: Compare, arguments: list[str]) -> None:
    """Compare two results and leave the numbers and the figure."""
    began = time.time()
    checks.choice("format", flags.format, choices.FIGURES)
    with outputs.run_folder(flags.out) as out, outputs.told_warnings() as warned:
        (a, first), (b, second) = (_read(name, path) for name, path in (("a", flags.a), ("b", flags.b)))
        found = compare(a, b)
        settings = differing(first, second)
        figure = _figure(a, b, found)
        written = outputs.reported(
            out, arguments, "", "cpu", began, {}, title=f"{flags.a} and {flags.b}", warnings=warned, reasons=list(map(str, found)),
            compared=[{"path": str(Path(path).resolve())} for path in (flags.a, flags.b)],
            summary={agreement.variable: dataclasses.asdict(agreement) for agreement in found},
            settings={name: [checks.shown(value) for value in pair] for name, pair in settings.items()},
        )  # fmt: skip
        outputs.write(out, {**outputs.figures(figure, flags.format), **written})
    for name, (one, other) in settings.items():
        print(f"setting {name}: {checks.shown(one)} and {checks.shown(other)}")
    for agreement in found:
        print(agreement)
    print(f"results in {flags.out}")


def differing(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """The settings that differ between two nested tables, by dotted name; None for one that is missing."""
    found: dict[str, tuple[Any, Any]] = {}
    for name in sorted({*a, *b}):
        one, other = a.get(name), b.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found |= differing(one, other, f"{prefix}{name}.")
        elif one != other:
            found[prefix + name] = (one, other)
    return found


def _read(name: str, path: str) -> tuple[xarray.Dataset, dict[str, Any]]:
    """The data and the settings of a run's folder, or of a netCDF file."""
    if not path:
        raise checks.fail(name, "be a file, or the folder of a run", repr(path))
    if not Path(path).is_dir():
        return _by_source(read_dataset(Path(path))), {}
    folder = open_folder(path)
    return _by_source(folder.data), folder.config if (folder.path / "config.toml").is_file() else {}


def _by_source(data: xarray.Dataset) -> xarray.Dataset:
    """A prediction that starts in one band each, on the axes of the band transfer that it can be compared with."""
    labels = data["start"].values.tolist() if "start" in data.dims else [""]
    if not all(str(label).isdigit() for label in labels):
        return data
    return data.assign_coords(start=[int(label) for label in labels]).rename(start="source", band="receiver")


def _figure(a: xarray.Dataset, b: xarray.Dataset, found: list[Agreement]) -> Any:
    """For every observable the histogram of z-scores beside the normal density, and their mean square over time."""
    with plots.style():
        figure, axes = plots.figure(plots.PAGE, 2.6 * len(found), len(found), 2)
        for (left, right), agreement in zip(axes, found, strict=True):
            z = z_scores(a, b, agreement.variable)
            values = z.values[np.isfinite(z.values)]
            if not values.size:
                left.set_axis_off()
                right.set_axis_off()
                left.text(0.5, 0.5, f"{agreement.variable}: no standard errors", ha="center")
                continue
            _histogram(left, values, agreement.variable)
            if "time" in z.dims:
                mean = np.sqrt((z**2).mean([axis for axis in z.dims if axis != "time"]))
                right.plot(z["time"], mean, label="these results")
                right.axhline(1, color="k", ls="--", label="one ensemble")
                right.set(xlabel=plots.TIME_LABEL, ylabel="root mean square $z$-score", ylim=(0, None))
                plots.legend(right)
            else:
                right.set_axis_off()
        plots.lettered(axes.flat)
    return figure


def _histogram(ax: Any, values: np.ndarray, name: str) -> None:
    grid = np.linspace(-5, 5, 201)
    ax.hist(np.clip(values, -5, 5), bins=50, range=(-5, 5), density=True, color="0.75", label="these results")
    ax.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), "k-", label="one ensemble")
    ax.set(xlabel="$z$-score, beyond 5 at the edge", ylabel="density", title=name.replace("_", " "))
    plots.legend(ax)
