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

REASONS = [
    "every value that both results hold at the same coordinates is compared: z is the difference over the root of the sum of both squared standard errors",
    "two samples of one ensemble have rms z = 1, and 68 % of the values within 1",
    "total variation: mean over sources and times of half the sum of |difference| over bands, beside what two samples of one ensemble with these errors are expected to have",
]


def run_compare(flags: Compare, arguments: list[str]) -> None:
    """Compare two results and leave the numbers and the figure."""
    began = time.time()
    checks.choice("format", flags.format, choices.FIGURES)
    outputs.check_apart(flags.out, flags.a, flags.b)
    with outputs.run_folder(flags.out) as out, outputs.told_warnings() as warned:
        (a, first), (b, second) = (_read(name, path) for name, path in (("a", flags.a), ("b", flags.b)))
        found = compare(a, b)
        settings = differing(first, second)
        outputs.leave(
            out, outputs.figures(_figure(a, b, found), flags.format), arguments, "", "cpu", began, {},
            title=f"{flags.a} and {flags.b}", warnings=warned, reasons=REASONS,
            compared=[{"path": str(Path(path).resolve())} for path in (flags.a, flags.b)],
            summary={numbers.pop("variable"): numbers for numbers in map(dataclasses.asdict, found)},
            settings={name: [checks.shown(value) for value in pair] for name, pair in settings.items()},
        )  # fmt: skip
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
    """For every observable with standard errors the z-scores beside the normal density and, over time, their mean square."""
    known = [agreement for agreement in found if np.isfinite(agreement.rms_z)]
    scores = {agreement.variable: z_scores(a, b, agreement.variable) for agreement in known}
    panels = [(name, over) for name, z in scores.items() for over in ("all", *(["time"] if "time" in z.dims else []))]
    with plots.style():
        rows = max(1, -(-len(panels) // 2))
        figure, axes = plots.figure(plots.PAGE, 2.6 * rows, rows, 2)
        for ax, (name, over) in zip(axes.flat, panels, strict=False):
            z = scores[name]
            if over == "all":
                _histogram(ax, z.values[np.isfinite(z.values)], name)
                continue
            mean = np.sqrt((z**2).mean([axis for axis in z.dims if axis != "time"]))
            ax.plot(z["time"], mean, label="these results")
            ax.axhline(1, color="k", ls="--", label="one ensemble")
            ax.set(
                xlabel=plots.TIME_LABEL,
                ylabel="root mean square $z$-score",
                ylim=(0, None),
                title=name.replace("_", " "),
            )
            plots.legend(ax)
        for ax in list(axes.flat)[len(panels) :]:
            ax.set_axis_off()
        if not panels:
            axes[0, 0].text(0, 0.5, "no standard errors, hence no z-scores")
        plots.lettered(axes.flat)
    return figure


def _histogram(ax: Any, values: np.ndarray, name: str) -> None:
    grid = np.linspace(-5, 5, 201)
    ax.hist(np.clip(values, -5, 5), bins=50, range=(-5, 5), density=True, color="0.75", label="these results")
    ax.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), "k-", label="one ensemble")
    ax.set(xlabel="$z$-score, beyond 5 at the edge", ylabel="density", title=name.replace("_", " "))
    plots.legend(ax)
