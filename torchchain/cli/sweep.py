"""``torchchain sweep``."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import textwrap
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from torchchain import checks, plots
from torchchain.cli import choices, outputs
from torchchain.cli.calibrate import run_calibrate
from torchchain.cli.flags import Calibrate, Simulate, Sweep
from torchchain.cli.runs import config_of
from torchchain.cli.simulate import run_simulate
from torchchain.ensemble.ranks import rank_of_environment
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_file import TIMES
from torchchain.progress import log
from torchchain.results import RunFolder

if TYPE_CHECKING:
    import xarray

MOST_RUNS = 10_000
MOST_PANELS = 6


@dataclass(frozen=True)
class Point:
    """One run of a sweep: its folder's name, the values of the swept fields, and the whole config."""

    name: str
    values: tuple[Any, ...]
    config: dict[str, Any]


def run_sweep(flags: Sweep, arguments: list[str]) -> None:
    """Run every combination that has not been run, then leave all results in one file, a table and a figure."""
    began = time.time()
    checks.choice("command", flags.command, ("simulate", "calibrate"))
    checks.choice("format", flags.format, choices.FIGURES)
    config, loaded = config_of(flags.config, flags.plugin)
    if flags.seed is not None:
        config["seed"] = flags.seed
    if loaded:
        config["plugins"] = loaded
    fields = swept(flags.fields)
    checks.device("device", flags.device)
    points = list(combinations(fields, config))
    title = f"{len(points)} runs of {flags.command} over {', '.join(fields)}"
    for point in points:  # all of them before the first is run
        tables = ("plugins", *(["calibration"] if flags.command == "calibrate" else []))
        Scene.from_dict({name: value for name, value in point.config.items() if name not in tables})
    with outputs.run_folder(flags.out) as out, _cleared_if_empty(out / "runs", out), outputs.told_warnings() as warned:
        for number, point in enumerate(points, 1):
            folder, text = out / "runs" / point.name, tomli_w.dumps(point.config)
            if _done(folder, text):
                continue
            log.info("run %d of %d: %s", number, len(points), point.name)
            with TemporaryDirectory(prefix="torchchain-sweep-") as scratch, redirect_stdout(io.StringIO()):
                request = Path(scratch) / "config.toml"
                request.write_text(text, encoding="utf-8")
                how: dict[str, Any] = {"config": str(request), "out": str(folder), "device": flags.device}
                again = [flags.command, "--config", str(folder / "config.toml"), "--out", str(folder)]
                if flags.command == "simulate":
                    run_simulate(Simulate(**how), again)
                else:
                    run_calibrate(Calibrate(**how), again)
            if rank_of_environment() == 0:  # what was asked for, once it is there
                outputs.write(folder.parent, {f"{point.name}.toml": outputs.text(text)})
        if rank_of_environment():
            return
        folders = [RunFolder(out / "runs" / point.name) for point in points]
        rows = [_row(folder.record) for folder in folders]
        data = combined(fields, [folder.data for folder in folders], rows)
        text = tomli_w.dumps({**config, "sweep": {name: list(values) for name, values in fields.items()}})
        with plots.style():
            figure = _figure(fields, panels(data, [folder.record for folder in folders]))
        files = {
            "sweep.nc": outputs.dataset(data), "sweep.csv": outputs.text(_table(fields, points, rows)),
            **outputs.figures(figure, flags.format),
        }  # fmt: skip
        outputs.leave(
            out, files, arguments, text, flags.device, began, {}, seed=config.get("seed", 0),
            runs=[point.name for point in points], title=title, warnings=warned,
            measured=[
                (f"{_varied(fields, point)}: {name}", value, error)
                for point, folder in zip(points, folders, strict=True) for name, value, error in folder.record.get("measured") or ()
            ],
            reasons=["every run has a report of its own in the folder runs", *left_out(data)],
        )  # fmt: skip
    print(f"{title}; {time.time() - began:.1f} s, results in {flags.out}")


@contextmanager
def _cleared_if_empty(*folders: Path) -> Iterator[None]:
    """What fails before its first result leaves no empty folder."""
    try:
        yield
    except BaseException:
        for folder in folders:
            with suppress(OSError):
                folder.rmdir()
        raise


def swept(words: Sequence[str]) -> dict[str, tuple[Any, ...]]:
    """Fields and their values, from words like ``disorder.strength=0.1,0.3``."""
    if not words:
        raise checks.fail("fields", "be at least one field=value,value", "none")
    fields: dict[str, tuple[Any, ...]] = {}
    for word in words:
        name, sign, values = word.partition("=")
        if not sign or not name or not values:
            raise checks.fail("fields", "read field=value,value", repr(word))
        if name in fields:
            raise checks.fail("fields", "be named once", name)
        fields[name] = tuple(_value(text) for text in values.split(","))
        if len({json.dumps(value) for value in fields[name]}) < len(fields[name]):
            raise checks.fail(name, "have different values", values)
    runs = math.prod(map(len, fields.values()))
    if runs > MOST_RUNS:
        raise checks.fail("fields", f"make at most {MOST_RUNS} runs", runs)
    return fields


def _value(text: str) -> Any:
    """A TOML value, or a bare word."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return value if isinstance(value, (bool, int, float, str)) else text


def combinations(fields: Mapping[str, Sequence[Any]], config: Mapping[str, Any]) -> Iterator[Point]:
    """Every combination, the last field fastest."""
    for values in itertools.product(*fields.values()):
        whole: dict[str, Any] = json.loads(json.dumps(config))
        for name, value in zip(fields, values, strict=True):
            *tables, last = name.split(".")
            table = whole
            for key in tables:
                if not isinstance(table.setdefault(key, dict(TIMES) if key == "times" else {}), dict):
                    raise checks.fail(name, "name a field of the scene file", checks.shown(table[key]))
                table = table[key]
            table[last] = value
        yield Point(",".join(f"{n}={v}" for n, v in zip(fields, values, strict=True)).replace("/", "_"), values, whole)


def _done(folder: Path, text: str) -> bool:
    """Whether a finished run of this very config lies in the folder."""
    request = folder.parent / f"{folder.name}.toml"
    return (folder / outputs.RECORD).is_file() and request.is_file() and request.read_text(encoding="utf-8") == text


def _varied(fields: Mapping[str, Sequence[Any]], point: Point) -> str:
    """A run by the values of the fields that differ between the runs."""
    told = zip(fields.items(), point.values, strict=True)
    return ", ".join(f"{name} = {value}" for (name, values), value in told if len(values) > 1) or point.name


def _row(record: Mapping[str, Any]) -> dict[str, float]:
    """The numbers that sum a run up."""
    found: dict[str, float] = {}
    for part in ({"seconds": record.get("seconds")}, record.get("realized") or {}, record.get("numbers") or {}):
        plain = {name: math.inf if value == "inf" else value for name, value in part.items()}  # JSON has no infinity
        found |= {k: float(v) for k, v in plain.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    return found


def combined(
    fields: Mapping[str, Sequence[Any]], results: Sequence[xarray.Dataset], rows: Sequence[Mapping[str, float]]
) -> xarray.Dataset:
    """All results in one dataset whose leading axes are the swept fields.

    Variables whose axes differ between the runs (other bands, other particles) are left out, and named in the attribute
    ``left_out``.
    """
    import xarray

    shape = tuple(map(len, fields.values()))
    variables: dict[str, Any] = {}
    coords: dict[str, Any] = {name: list(values) for name, values in fields.items()}
    left_out = []
    first = results[0]
    for name, values in first.data_vars.items():
        if str(name).startswith("block"):
            continue
        alike = all(
            name in other and other[name].dims == values.dims and other[name].shape == values.shape
            and all(np.array_equal(other[axis].values, values[axis].values) for axis in values.coords)
            for other in results
        )  # fmt: skip
        if not alike:
            left_out.append(str(name))
            continue
        stacked = np.stack([other[name].values for other in results]).reshape(*shape, *values.shape)
        variables[str(name)] = ((*fields, *values.dims), stacked, values.attrs)
        coords |= {str(axis): values[axis] for axis in values.coords}
    for name in sorted(set.intersection(*(set(row) for row in rows))):
        variables[f"run_{name}"] = (tuple(fields), np.array([row[name] for row in rows]).reshape(shape))
    return xarray.Dataset(variables, coords, {"left_out": ", ".join(left_out)})


def left_out(data: xarray.Dataset) -> list[str]:
    """What is not in the one file, in words."""
    return [f"with axes that differ between the runs, and only in theirs: {data.left_out}"] if data.left_out else []


def _table(fields: Mapping[str, Any], points: Sequence[Point], rows: Sequence[Mapping[str, float]]) -> str:
    """The runs as comma-separated values: swept fields, then the numbers that sum them up."""
    text = io.StringIO()
    writer = csv.DictWriter(text, dict.fromkeys([*fields, *itertools.chain(*rows)]), lineterminator="\n")
    writer.writeheader()
    for point, row in zip(points, rows, strict=True):
        writer.writerow({**dict(zip(fields, point.values, strict=True)), **row})
    return text.getvalue()


def panels(
    data: xarray.Dataset, records: Sequence[Mapping[str, Any]]
) -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """What the figure shows, by name: values over the swept fields, and standard errors of what was measured.

    First what every run measured, then the numbers that sum the runs up and differ between them.
    """
    sums = {str(name): values for name, values in data.data_vars.items() if str(name).startswith("run_")}
    shape = next(iter(sums.values())).shape
    measured = [{name: (value, error) for name, value, error in record.get("measured") or ()} for record in records]
    found: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
    for name in [name for name in measured[0] if all(name in other for other in measured)]:
        values, errors = np.array([[math.nan if x is None else x for x in other[name]] for other in measured]).T
        found[name] = values.reshape(shape), errors.reshape(shape)
    several = [name for name, values in sums.items() if np.ptp(np.nan_to_num(values.values, posinf=-1.0)) > 0]
    for name in sorted(several or sums, key=lambda name: [*LABELS, name].index(name)):
        found[LABELS.get(name, name.removeprefix("run_").replace("_", " "))] = sums[name].values, None
    return dict(itertools.islice(found.items(), MOST_PANELS))


LABELS = {
    "run_tv": "total variation, model and ensemble", "run_tv_noise": "total variation, two ensembles",
    "run_n_parameters": "fitted numbers", "run_mass_mean": "mean mass", "run_mass_sd": "standard deviation of masses",
    "run_horizon": "last time compared with chains",
}  # fmt: skip


def _figure(fields: Mapping[str, Sequence[Any]], shown: Mapping[str, tuple[np.ndarray, np.ndarray | None]]) -> Any:
    """Every quantity over the first field, one line for each combination of the others that vary."""
    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure, axes = plots.figure(plots.PAGE * columns / 3, 2.4 * rows, rows, columns)
    first, *others = fields
    numeric = all(isinstance(value, (int, float)) for value in fields[first])
    x = fields[first] if numeric else range(len(fields[first]))
    varied = [other for other in others if len(fields[other]) > 1]
    for ax, (name, (values, errors)) in zip(axes.flat, shown.items(), strict=False):
        for i, chosen in enumerate(itertools.product(*(range(len(fields[other])) for other in others))):
            of = dict(zip(others, chosen, strict=True))
            label = ", ".join(f"{other} = {fields[other][of[other]]}" for other in varied)
            at: Any = (slice(None), *chosen)
            error = None if errors is None else errors[at]
            ax.errorbar(x, values[at], error, marker="os^vDP*"[i % 7], label=label or None)
        ax.set(xlabel=first, ylabel=textwrap.fill(name, 32))
        ax.set_xticks(list(x), [f"{value:g}" if numeric else str(value) for value in fields[first]])
    if varied and shown:
        figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    for ax in list(axes.flat)[len(shown) :]:
        ax.set_axis_off()
    plots.lettered(axes.flat)
    return figure
