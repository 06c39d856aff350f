"""The report of a run: one self-contained page for people, from its record and the files beside it."""

from __future__ import annotations

import base64
import csv
import html
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchchain.ensemble.transfer import BandTransfer

REPORT = "report.html"
MOST_ROWS = 500
"""Of a table; the whole is in its file."""
HOLDS = {
    "config.toml": "the resolved settings; the same command with --config takes them again",
    "results.nc": "what was measured: labeled axes, units, standard errors (netCDF)",
    "transfer.nc": "transfer of energy between all bands in time, with standard errors (netCDF)",
    "model.safetensors": "the calibrated model, for torchchain predict",
    "sweep.nc": "the results of all runs over the swept fields (netCDF)",
    "sweep.csv": "the numbers that sum the runs up",
    "figure.png": "the figure above",
    "figure.pdf": "the same as vectors, for print",
    "figure.svg": "the same as vectors",
}
PAPER = (
    "K. Taghizadeh, R. K. Shrivastava and S. Luding, Stochastic Model for Energy Propagation in Disordered Granular Chains, "
    "Materials 14, 1815 (2021), doi:10.3390/ma14071815"
)
BIBTEX = """@software{{torchchain,
  title = {{torchchain: wave energy in disordered granular chains}},
  author = {{{{The torchchain developers}}}},
  version = {{{version}}}
}}
@article{{taghizadeh2021,
  title = {{Stochastic Model for Energy Propagation in Disordered Granular Chains}},
  author = {{Taghizadeh, Kianoosh and Shrivastava, Rohit Kumar and Luding, Stefan}},
  journal = {{Materials}}, year = {{2021}}, volume = {{14}}, number = {{7}}, pages = {{1815}},
  doi = {{10.3390/ma14071815}}
}}"""
LABELS = {
    "mass_mean": "masses: mean",
    "mass_sd": "masses: standard deviation",
    "start_condition": "condition of the least squares over starts (1: every start in one band)",
}
"""Of names of the files, in words."""
STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 56rem; margin: 0 auto; padding: 1rem; overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: .5rem 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; border-bottom: 1px solid #ccc; }
.by { color: #555; margin: 0; } img { width: 100%; min-width: 36rem; height: auto; }
table { border-collapse: collapse; width: 100%; overflow-wrap: normal; margin-bottom: .75rem; } .wide { overflow-x: auto; }
th, td { text-align: left; vertical-align: top; padding: .25rem .75rem .25rem 0; border-bottom: 1px solid #e5e5e5; }
td.number { font-variant-numeric: tabular-nums; white-space: nowrap; overflow-wrap: normal; }
pre { background: #f5f5f5; padding: .75rem; overflow-x: auto; font-size: .85rem; overflow-wrap: normal; }
.warning { border-left: .3rem solid #c60; background: #fff5e8; padding: .5rem .75rem; margin: .5rem 0; }
details > summary { cursor: pointer; }
"""


def page(record: Mapping[str, Any], folder: Path) -> str:
    """The report as HTML without anything from outside, whatever the texts hold.

    Args:
        record: of the run, as in its run.json; for people ``title``, ``reasons`` (why it was done this way), ``warnings``,
            ``measured`` (rows of quantity, value, standard error or None) and ``summary`` (name to value).
        folder: holds the run's files, among them config.toml and figure.png if there are any.
    """
    command = record["arguments"][0] if record["arguments"] else "run"
    title = str(record.get("title") or "a run").replace("xi =", "ξ =")
    version = record["versions"]["torchchain"]
    parts = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="by">torchchain {_text(command)}, version {_text(version)}, {_text(record["started"])}, '
        f"{record['seconds']:.3g} s</p>",
        *[f'<p class="warning">Warning: {_text(line)}</p>' for line in dict.fromkeys(record.get("warnings") or ())],
        *_figure(folder),
        *_section("Numbers", [*_measured(record.get("measured") or ()), *_summary(record), *_tables(folder)]),
        *_section("What was asked", _asked(record, folder)),
        *_section("What was done, and why", _done(record)),
        *_section("Files", _files(folder)),
        *_section("To run it again", _again(record, command)),
        *_section("To cite", [f"<p>{_text(PAPER)}</p>", _block(BIBTEX.format(version=version))]),
    ]
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title><style>{STYLE}</style></head><body>\n"
    )
    return head + "\n".join(parts) + "\n</body></html>\n"


def shares_left(transfer: BandTransfer, sources: Iterable[int]) -> list[tuple[str, float, float | None]]:
    """Rows for ``measured``: what is left in source bands at the last time, with standard errors of several realizations."""
    rows: list[tuple[str, float, float | None]] = []
    for source in sources:
        at = (source - 1, -1, source - 1)
        error = float(transfer.stderr[at])
        name = f"share of the energy of band {source} still there at t = {float(transfer.times[-1]):g}"
        rows.append((name, float(transfer.mean[at]), error if math.isfinite(error) else None))
    return rows


def _text(value: Any) -> str:
    return html.escape(str(value))


def _block(text: str) -> str:
    return f"<pre>{_text(text.strip())}</pre>"


def _section(title: str, parts: Sequence[str]) -> list[str]:
    return [f"<h2>{_text(title)}</h2>", *parts] if parts else []


def _table(rows: Iterable[Sequence[Any]], head: Sequence[str] = ()) -> str:
    """Cells as text, numbers kept in one line."""
    lines = [f"<tr>{''.join(f'<th>{_text(name)}</th>' for name in head)}</tr>"] if head else []
    for row in rows:
        told = (f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row)
        cells = (f"<td{' class=number' if _is_number(cell) else ''}>{_text(cell)}</td>" for cell in told)
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="wide"><table>{"".join(lines)}</table></div>'


def _is_number(cell: Any) -> bool:
    try:
        float(str(cell).partition(" ")[0])
    except ValueError:
        return False
    return True


def _figure(folder: Path) -> list[str]:
    path = folder / "figure.png"
    if not path.is_file():
        return []
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return [f'<div class="wide"><img alt="The figure of this run" src="data:image/png;base64,{data}"></div>']


def _measured(rows: Sequence[Sequence[Any]]) -> list[str]:
    """Values with their standard errors."""
    if not rows:
        return []
    told = [(name, f"{value:.4g}" + ("" if error is None else f" ± {error:.2g}")) for name, value, error in rows]
    more = [f"<p>{len(told) - MOST_ROWS} more in the records of the runs.</p>"] if len(told) > MOST_ROWS else []
    return [_table(told[:MOST_ROWS], ("measured", "value ± standard error")), *more]


def _summary(record: Mapping[str, Any]) -> list[str]:
    """Names and values; of names that hold the same names, a table with a column for each."""
    told = record.get("summary") or {}
    parts = []
    if plain := [(LABELS.get(name, name), value) for name, value in told.items() if not isinstance(value, Mapping)]:
        parts.append(_table(plain))
    if nested := {name: value for name, value in told.items() if isinstance(value, Mapping)}:
        columns = list(dict.fromkeys(column for value in nested.values() for column in value))
        rows = ([name, *(_known(value.get(column)) for column in columns)] for name, value in nested.items())
        parts.append(_table(rows, ["", *(column.replace("_", " ") for column in columns)]))
    return parts


def _known(value: Any) -> Any:
    """A dash for what is not there, or no number."""
    return "-" if value is None or (isinstance(value, float) and math.isnan(value)) else value


def _tables(folder: Path) -> list[str]:
    """Every table that the run left as comma-separated values."""
    parts = []
    for path in sorted(folder.glob("*.csv")):
        with path.open(encoding="utf-8", newline="") as file:
            head, *rows = csv.reader(file)
        parts.append(_table([[_rounded(cell) for cell in row] for row in rows[:MOST_ROWS]], head))
        if len(rows) > MOST_ROWS:
            parts.append(f"<p>{len(rows) - MOST_ROWS} more rows in {_text(path.name)}.</p>")
    return parts


def _rounded(cell: str) -> Any:
    try:
        return cell if cell.lstrip("-").isdigit() else float(cell)
    except ValueError:
        return cell


def _asked(record: Mapping[str, Any], folder: Path) -> list[str]:
    parts = [_block(record["command"])]
    if record.get("settings"):
        parts.append(_table([(name, *pair) for name, pair in record["settings"].items()], ("setting", "one", "other")))
    config = folder / "config.toml"
    if config.is_file():
        told = _block(config.read_text(encoding="utf-8"))
        parts.append(f"<details><summary>All settings, those left to their defaults too</summary>{told}</details>")
    return parts


def _done(record: Mapping[str, Any]) -> list[str]:
    """Method, reasons, forecast and the time of every stage."""
    rows: list[tuple[str, Any]] = []
    if "resolved" in record:
        options = [f"{name} = {value}" for name, value in record["resolved"]["options"].items()]
        rows.append(("method", ", ".join([record["resolved"]["method"], *options])))
    told = ((name, record.get(name)) for name in ("seed", "device", "threads", "processes"))
    rows += [(name, value) for name, value in told if value is not None]
    forecast = record.get("forecast") or {}
    rows += [(words, forecast[name]) for name, words in FORECAST.items() if name in forecast]
    for what in ("transfer", "model"):
        if isinstance(record.get(what), Mapping):
            rows.append((f"{what} from", record[what].get("path", "")))
    reasons = "".join(f"<li>{_text(line)}</li>" for line in record.get("reasons") or ())
    parts = [f"<ul>{reasons}</ul>", _table(rows)] if reasons else [_table(rows)]
    if record["stages"]:
        parts.append(_table(record["stages"].items(), ("stage", "seconds")))
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    return [*parts, f"<p>{_text(versions)}; {_text(record['machine'])}</p>"]


FORECAST = {
    "predicted_error": "error of the method, predicted, relative to the scale",
    "statistical_error": "largest standard error of the ensemble, relative to the scale",
    "predicted_seconds": "seconds of the ensemble, predicted",
    "seconds": "seconds of the ensemble, measured",
}


def _files(folder: Path) -> list[str]:
    rows = [
        (path.name, f"{path.stat().st_size / 1e3:,.0f} kB", HOLDS.get(path.name, ""))
        for path in sorted(folder.iterdir())
        if path.is_file() and path.name != REPORT
    ]
    return [_table([*rows, ("run.json", "", "the record of this run: versions, hashes, seconds")])]


def _again(record: Mapping[str, Any], command: str) -> list[str]:
    """How to make the run again from its folder, and how to have its data in Python."""
    out = record["out"]
    lines = [f"torchchain rerun {shlex.quote(out)}  # compares all data bit by bit"]
    if command in ("compare", "sweep", "family"):
        lines = [f"cd {shlex.quote(record['working_directory'])}", record["command"]]
    parts = [_block("\n".join(lines))]
    if command != "compare":
        parts.append(_block(f"import torchchain as tc\nrun = tc.open({out!r})\nprint(run)"))
    return parts
