"""What the figure scripts share: flags and config, the folder of a run, and the paper's numbers beside the measured."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import shlex
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w
import torch
import tyro
import xarray
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain import checks, plots
from torchchain.cli import outputs
from torchchain.ensemble.scene_file import read_toml, regular_times
from torchchain.ensemble.statistics import jackknife_error

TIME = {"units": "travel time of sound over one particle", "long_name": "time t"}
RATE = {"units": "1 / travel time of sound over one particle"}


@dataclass(frozen=True)
class Ensemble:
    """The chains of Sections 4.2 to 4.5; a script's own settings follow."""

    seed: int = 0
    """seed of the ensemble"""
    n_particles: int = 256
    """particles per chain (the paper's N + 1)"""
    n_bands: int = 32
    """wavenumber bands B"""
    realizations: int = 100
    """chains in the ensemble"""
    stop: float = 50.0
    """last time"""
    step: float = 0.25
    """time step of the output"""
    kind: str = "normal"
    """distribution of the masses: normal, uniform, binary, lognormal or gamma"""

    def scene(self, strength: float, tones: tuple[int, ...] | None = None, **changes: Any) -> tc.Scene:
        """Standing waves on chains of this disorder; ``tones=None``: the center tone of every band."""
        settings: dict[str, Any] = {
            "n_particles": self.n_particles,
            "n_bands": self.n_bands,
            "realizations": self.realizations,
            "seed": self.seed,
            "times": regular_times(0.0, self.stop, self.step),
            "disorder": tc.Disorder(self.kind, strength),
            "excitation": tc.StandingWave(tones=tones),
        }
        return tc.Scene(**settings | changes)


@dataclass(frozen=True)
class Row:
    """One line of the table: a measured number with its standard error, beside the paper's digits where it gives any."""

    quantity: str
    measured: float
    stderr: float = math.nan
    paper: str = ""
    note: str = ""

    @property
    def sigmas(self) -> float:
        """How far apart the numbers are: the paper's ensemble has the same size, hence the same error, and is rounded."""
        if not self.paper or not self.stderr >= 0:
            return math.nan
        digit = 10.0 ** -len(self.paper.partition(".")[2])
        return (self.measured - float(self.paper)) / math.sqrt(2 * self.stderr**2 + digit**2 / 12)


@dataclass(frozen=True)
class Script:
    """A figure as a function of its config.

    Attributes:
        name: of the script and of its folder.
        config: the paper's settings.
        smoke: the same shrunk to seconds.
        measure: (config, device) to the data, all that the figure and the table need.
        draw: (data, config) to the figure, no computation.
        compare: (data, config) to the table.
        explain: (data, config) to what the table means, in words.
        pieces: the setting, a list, by which a long run may be cut into several that are joined afterwards.
    """

    name: str
    config: Any
    smoke: Any
    measure: Callable[[Any, str], xarray.Dataset]
    draw: Callable[[xarray.Dataset, Any], Figure]
    compare: Callable[[xarray.Dataset, Any], list[Row]]
    explain: Callable[[xarray.Dataset, Any], str]
    pieces: str = ""


def run(script: Script, arguments: Sequence[str] | None = None) -> int:
    """Run or redraw a script; the exit status is 2 for bad input, with one line on standard error."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        flags = _read(script, arguments)
        out = outputs.check_writable(flags.out)
        if flags.redraw:
            _redraw(script, flags, out)
        else:
            _run(script, flags, out, arguments)
    except SystemExit as stop:  # the parser's: --help, or a flag that it has already complained of
        return stop.code if isinstance(stop.code, int) else 2
    except (checks.FieldError, checks.FieldTypeError) as error:
        print(f"{script.name}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


def _run(script: Script, flags: Any, out: Path, arguments: list[str]) -> None:
    began, stages = time.time(), {}
    checks.device("device", flags.device)
    settings = flags.settings
    if flags.join:
        settings, data = _joined(script, flags.join)
    else:
        data = script.measure(settings, flags.device)
    stages["measure"] = time.time() - began
    rows = script.compare(data, settings)
    figure, report = drawn(script, data, settings), _report(script, data, settings, rows)
    stages["figure and table"] = time.time() - began - stages["measure"]
    config = _toml(settings)
    outputs.write(
        out,
        {
            "config.toml": outputs.text(config),
            "results.nc": outputs.dataset(data.assign(_table(rows))),
            **outputs.figures(figure, flags.format),
            "report.txt": outputs.text(report),
            outputs.RECORD: outputs.reported(
                out, arguments, config, flags.device, began, stages,
                command=shlex.join(["python", f"experiments/{script.name}.py", *arguments]), seed=settings.seed,
            )[outputs.RECORD],
        },
    )  # fmt: skip
    print(report, end="")
    print(f"{time.time() - began:.1f} s, results in {out}")


def _joined(script: Script, folders: Sequence[str]) -> tuple[Any, xarray.Dataset]:
    """Settings and data of one run from those of its pieces, in their order."""
    if not script.pieces:
        raise checks.fail("join", f"be left out, as {script.name} is not run in pieces", ", ".join(folders))
    found, parts = [], []
    for folder in map(Path, folders):
        found.append(read_toml(folder / "config.toml"))
        with xarray.open_dataset(folder / "results.nc", engine="h5netcdf") as file:
            parts.append(file.load())
        if found[-1] | {script.pieces: []} != found[0] | {script.pieces: []}:
            raise checks.fail("join", f"name runs that differ in {script.pieces} alone", str(folder))
    settings = found[0] | {script.pieces: [piece for each in found for piece in each[script.pieces]]}
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
    names = [name for name in parts[0].variables if not str(name).startswith("row_")]
    data = {
        name: (parts[0][name].dims, np.concatenate([part[name].values for part in parts]), parts[0][name].attrs) for name in names
    }
    return replace(script.config, **settings), xarray.Dataset(data, attrs=parts[0].attrs)


def _redraw(script: Script, flags: Any, out: Path) -> None:
    """Figure and table again from the saved data."""
    with xarray.open_dataset(out / "results.nc", engine="h5netcdf") as file:
        data = file.load()
    rows = script.compare(data, flags.settings)
    report = _report(script, data, flags.settings, rows)
    figure = drawn(script, data, flags.settings)
    outputs.write(out, {**outputs.figures(figure, flags.format), "report.txt": outputs.text(report)})  # the rest stays
    print(report, end="")
    print(f"redrawn in {out}")


def _read(script: Script, arguments: list[str]) -> Any:
    """Flags over config file over the script's settings (or their smoke version), the same types checked in all."""
    fields = {entry.name for entry in dataclasses.fields(script.config)}
    first = _parse(script, script.config, arguments)
    file = Path(first.out) / "config.toml" if first.redraw else first.config
    given = {} if file is None else read_toml(file)
    checks.known_keys(f"config {file}", given, sorted(fields))
    base = script.smoke if first.smoke and not first.redraw else script.config
    flags = _parse(script, base, [*_words(given), *arguments])
    for name, value in dataclasses.asdict(flags.settings).items():
        if value == ():
            raise checks.fail(name, "hold at least one value", "none")
        if first.redraw and _plain(value) != given.get(name):
            raise checks.fail(name, f"stay {given.get(name)!r} as in the saved run to redraw it", repr(value))
    return flags


def _parse(script: Script, settings: Any, arguments: list[str]) -> Any:
    def flag(default: Any, words: str) -> Any:
        return dataclasses.field(default=default, metadata={"help": words})

    switch = tyro.conf.FlagCreatePairsOff[bool]
    kind = dataclasses.make_dataclass(
        "Flags",
        [
            ("settings", tyro.conf.OmitArgPrefixes[type(settings)], settings),
            ("config", str | None, flag(None, "settings in a TOML file")),
            ("out", str, flag(f"results/experiments/{script.name}", "folder of the run")),
            ("device", str, flag("cpu", "cpu, cuda, cuda:1, ...")),
            ("format", Literal["png", "pdf", "svg"], flag("png", "of the figure, besides PNG")),
            ("smoke", switch, flag(False, "few chains and short times: seconds")),
            ("join", tuple[str, ...], flag((), "folders of runs of some pieces each, to be taken together instead of a run")),
            ("redraw", switch, flag(False, "figure and table from the data saved in --out, no run")),
        ],
        frozen=True,
    )
    kind.__doc__ = f"{sys.modules[script.measure.__module__].__doc__}"
    caught = io.StringIO()
    try:
        with contextlib.redirect_stderr(caught):
            return tyro.cli(kind, args=arguments, prog=script.name)
    except SystemExit as stop:
        if stop.code:
            lines = [line.strip("│╭╮╰╯─ ") for line in caught.getvalue().splitlines()]
            text = " ".join(" ".join(lines).split())
            print(f"{script.name}: error: {text.partition(' For full helptext')[0]}", file=sys.stderr)
        raise


def _words(given: dict[str, Any]) -> list[str]:
    """The keys of a config file as flags."""
    words: list[str] = []
    for key, value in given.items():
        flag = key.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
            continue
        words += [f"--{flag}", *(str(v) for v in (value if isinstance(value, list) else [value]))]
    return words


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _toml(settings: Any) -> str:
    return tomli_w.dumps({name: _plain(value) for name, value in dataclasses.asdict(settings).items()})


def _table(rows: list[Row]) -> dict[str, Any]:
    """The rows as variables of the data."""
    return {
        f"row_{entry.name}": ("row", [getattr(row, entry.name) for row in rows]) for entry in dataclasses.fields(Row)
    }


CHARACTER = 0.062
"""Width of a character of eight points, in inches, on average."""


def legends_below(figure: Any, columns: int = 2) -> None:
    """Every legend that lies on data comes below its axes, and the figure grows by what that takes."""
    rows: dict[int, int] = {}
    for ax in figure.axes:
        found = ax.get_legend()
        if found is None or found.get_bbox_to_anchor() is not ax.bbox:
            continue
        labels = [text.get_text() for text in found.get_texts()]
        widest = max(map(len, labels))
        across = 1 if widest > 24 else columns if widest > 10 else columns + 1
        title = found.get_title().get_text()
        plots.legend(
            ax,
            across,
            handles=found.legend_handles,
            labels=labels,
            **({"title": title, "title_fontsize": 7} if title else {}),
        )
        where = ax.get_subplotspec()
        row = 0 if where is None else where.rowspan.start
        rows[row] = max(rows.get(row, 0), -(-len(labels) // across) + bool(title))
    figure.set_figheight(figure.get_figheight() + 0.14 * sum(rows.values()))


def wrapped_labels(figure: Any) -> None:
    """Titles and labels of vertical axes that are longer than their panel, on several lines; formulas are not broken."""
    for ax in figure.axes:
        where = ax.get_subplotspec()
        if where is None:
            continue
        shape = where.get_gridspec()
        for label, room in (
            (ax.yaxis.label, 0.75 * figure.get_figheight() * len(where.rowspan) / shape.nrows),
            (ax.title if ax.get_title() else ax._left_title, 0.95 * figure.get_figwidth() * len(where.colspan) / shape.ncols),
        ):
            text, most = label.get_text(), int(room / CHARACTER)
            if len(text) > most and not set("$\n") & set(text):
                label.set_text(textwrap.fill(text, most))


def drawn(script: Script, data: xarray.Dataset, config: Any) -> Figure:
    """The figure in the sizes of print, legends off the data."""
    with plots.style():
        figure = script.draw(data, config)
        wrapped_labels(figure)
        legends_below(figure)
        shown = [ax for ax in figure.axes if ax.get_subplotspec() is not None and ax.axison]  # no bars, no insets
        if len(shown) > 1 and not any("(a)" in ax.get_title(where) for ax in shown for where in ("left", "center")):
            plots.lettered(shown)
    return figure


def changed(script: Script, config: Any) -> list[str]:
    """The settings of a figure of the paper that are not its own, so that neither its digits nor conclusions apply."""
    if not script.name.startswith("fig"):
        return []
    free = ("seed", "realizations")
    fields = (entry.name for entry in dataclasses.fields(config) if entry.name not in free)
    return [name for name in fields if getattr(config, name) != getattr(script.config, name)]


def _report(script: Script, data: xarray.Dataset, config: Any, rows: list[Row]) -> str:
    """The table as text, and the words below it."""
    lines = [("quantity", "paper", "measured", "sigmas", "")]
    other = changed(script, config)
    words = script.explain(data, config).strip() if not other else f"no conclusions: not the paper's {', '.join(other)}"
    for row in [replace(row, paper="") for row in rows] if other else rows:
        error = "" if math.isnan(row.stderr) else f" +- {row.stderr:.2g}"
        lines.append(
            (
                row.quantity,
                row.paper,
                f"{row.measured:.4g}{error}",
                "" if math.isnan(row.sigmas) else f"{row.sigmas:+.1f}",
                row.note,
            )
        )
    filled = [column for column in zip(*lines, strict=True) if any(column[1:])]
    widths = [max(map(len, column)) for column in filled]
    table = ["  ".join(f"{c:<{w}}" for c, w in zip(line, widths, strict=True)) for line in zip(*filled, strict=True)]
    return "\n".join([script.name, *(line.rstrip() for line in table), words]) + "\n"


def panels(rows: int, columns: int, width: float = 4.8, height: float = 3.7) -> tuple[Figure, np.ndarray]:
    """A figure as wide as a journal's page (one panel: two thirds) and its axes [row, column], each of the shape width to height."""
    across = plots.PAGE if columns > 1 else plots.PAGE * 2 / 3
    figure = Figure(figsize=(across, across / columns * height / width * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def fastest(runs: xarray.Dataset, accuracy: float) -> xarray.Dataset | None:
    """The fastest of the runs with at most this error."""
    good = runs.isel(run=runs.error.values <= accuracy)
    return good.isel(run=int(good.seconds.values.argmin())) if good.sizes["run"] else None


def jackknife(
    blocks: Tensor, counts: Sequence[int], statistic: Callable[[Tensor], Tensor], groups: int | None = None
) -> tuple[Tensor, Tensor]:
    """A statistic of an ensemble mean and its standard error, by leaving out one block of realizations at a time.

    Args:
        blocks: means over the blocks, (block, ...).
        counts: realizations in each block.
        statistic: of the mean (...), any shape.
        groups: leave out this many times, a group of blocks each; None for every block.

    Returns:
        The statistic of the whole mean, and its standard error (nan for a single block).
    """
    weight = torch.tensor(counts, dtype=blocks.dtype)

    def mean(part: Tensor) -> Tensor:
        return torch.einsum("b,b...->...", weight[part] / weight[part].sum(), blocks[part])

    every = torch.arange(len(blocks))
    value = statistic(mean(every))
    n = min(groups or len(blocks), len(blocks))
    if n < 2:
        return value, torch.full_like(value, torch.nan)
    left_out = torch.stack([statistic(mean(every[every % n != group])) for group in range(n)])
    return value, jackknife_error(left_out)
