"""What to use for each kind of scene, in one figure and one table, from the measurements of the other charts."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import chart_ensemble
import chart_evolvers
import chart_models
import chart_solvers
import harness
import numpy as np
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchchain import checks, plots

CHARTS: tuple[ModuleType, ...] = (chart_evolvers, chart_solvers, chart_models, chart_ensemble)


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """of the charts' own runs in a smoke run"""
    results: str = "results/experiments"
    """folder with the runs of chart_evolvers, chart_solvers, chart_models and chart_ensemble; empty: short runs here"""
    accuracies: tuple[float, ...] = (1e-2, 1e-6, 1e-10)
    """errors asked for"""


SMOKE = Config(results="")


def load(config: Config) -> dict[str, xarray.Dataset]:
    """The data of every chart, by its name."""
    found = {}
    for chart in CHARTS:
        name = chart.SCRIPT.name
        if not config.results:
            found[name] = chart.measure(chart.SMOKE, "cpu")
            continue
        path = Path(config.results) / name / "results.nc"
        if not path.is_file():
            raise checks.fail("results", f"hold {name}/results.nc (python experiments/{name}.py)", config.results)
        with xarray.open_dataset(path, engine="h5netcdf") as file:
            found[name] = file.load()
    return found


def measure(config: Config, device: str) -> xarray.Dataset:
    charts = load(config)
    columns = {
        "evolver": list(_evolvers(charts["chart_evolvers"], config)),
        "solver": list(_solvers(charts["chart_solvers"], config)),
        "model": list(_models(charts["chart_models"])),
        "way": list(_ways(charts["chart_ensemble"])),
    }
    data: dict[str, Any] = {}
    for axis, entries in columns.items():
        for key in entries[0]:
            data[f"{axis}_{key}"] = (axis, [entry[key] for entry in entries])
    return xarray.Dataset(data)


def _fastest(data: xarray.Dataset, scene: str, method: str, config: Config) -> Iterator[tuple[dict[str, Any], Any]]:
    """For every scene and accuracy, the fastest run of each method that reaches it: what both charts tell, and the run."""
    for wave in dict.fromkeys(data[scene].values):
        for accuracy in config.accuracies:
            for name in dict.fromkeys(data[method].values):
                found = harness.fastest(
                    data.isel(run=(data[scene].values == wave) & (data[method].values == name)), accuracy
                )
                if found is not None:
                    told = {"scene": wave, "accuracy": accuracy, "method": name}
                    yield told | {"error": float(found.error), "seconds": float(found.seconds)}, found


def _evolvers(data: xarray.Dataset, config: Config) -> Iterator[dict[str, Any]]:
    for told, found in _fastest(data, "wave", "method", config):
        yield told | {"option": f"{found.option.values} {found.precision.values}".strip()}


def _solvers(data: xarray.Dataset, config: Config) -> Iterator[dict[str, Any]]:
    for told, _ in _fastest(data, "rates", "solver", config):
        yield told


def _models(data: xarray.Dataset) -> Iterator[dict[str, Any]]:
    """Every model by its nearest fit, at every number of bands."""
    for i, n_bands in enumerate(data.n_bands.values):
        for model in dict.fromkeys(data.model.values):
            part = data.isel(fit=(data.bands.values == n_bands) & (data.model.values == model))
            predictions = data.isel(
                prediction=(data.prediction_bands.values == n_bands) & (data.prediction_model.values == model)
            )
            if part.sizes["fit"]:
                best = part.isel(fit=int(part.fresh.values.argmin()))
                yield {
                    "bands": int(n_bands),
                    "name": model,
                    "method": str(best.method.values),
                    "distance": float(best.fresh),
                    "noise": float(data.noise[i]),
                    "calibration": float(best.seconds),
                    "prediction": float(predictions.prediction_seconds[0]),
                    "ensemble": float(data.ensemble_seconds[i]),
                }


def _ways(data: xarray.Dataset) -> Iterator[dict[str, Any]]:
    """What the same error costs by every way to average, over plain realizations."""
    for observable in dict.fromkeys(data.observable.values):
        part = data.isel(way=data.observable.values == observable)
        work, seconds = (chart_ensemble.price(part, cost) ** 2 for cost in ("evolutions", "seconds"))
        for i, name in enumerate(part.name.values):
            yield {
                "observable": observable,
                "name": name,
                "work": work[i] / work[0],
                "seconds": seconds[i] / seconds[0],
            }


def advice(data: xarray.Dataset, config: Config) -> list[dict[str, Any]]:
    """The table: a kind of scene, what to use, its error and cost, and the next best."""
    lines = []
    for axis in ("evolver", "solver"):
        for scene in dict.fromkeys(data[f"{axis}_scene"].values):
            for accuracy in config.accuracies:
                here = (data[f"{axis}_scene"].values == scene) & (data[f"{axis}_accuracy"].values == accuracy)
                part = data.isel({axis: here}).sortby(f"{axis}_seconds")
                if not part.sizes[axis]:
                    continue
                seconds = part[f"{axis}_seconds"].values
                names = part[f"{axis}_method"].values
                lines.append(
                    {
                        "scene": scene,
                        "wanted": f"error {accuracy:.0e}",
                        "use": names[0],
                        "seconds": float(seconds[0]),
                        "note": f"error {float(part[f'{axis}_error'][0]):.0e}"
                        + (f"; then {names[1]}, {seconds[1] / seconds[0]:.2g} times as long" if len(names) > 1 else ""),
                    }
                )
    for n_bands in dict.fromkeys(data.model_bands.values):
        part = data.isel(model=data.model_bands.values == n_bands).sortby("model_distance")
        first = part.isel(model=0)
        lines.append(
            {
                "scene": f"{n_bands} bands at any later time",
                "wanted": "nearest model",
                "use": f"{first.model_name.values} by {first.model_method.values}",
                "seconds": float(first.model_prediction),
                "note": f"{float(first.model_distance):.3f} from fresh chains, {float(first.model_noise):.3f} between ensembles; "
                f"calibration {float(first.model_calibration):.2g} s, ensemble {float(first.model_ensemble):.2g} s",
            }
        )
    return lines


def markdown(data: xarray.Dataset, config: Config) -> str:
    """The table for the README."""
    lines = ["| scene | wanted | use | seconds | |", "|---|---|---|---|---|"]
    lines += [
        f"| {a['scene']} | {a['wanted']} | `{a['use']}` | {a['seconds']:.2g} | {a['note']} |"
        for a in advice(data, config)
    ]
    return "\n".join(lines)


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(2, 2, width=5.8, height=5.0)
    accuracy = config.accuracies[len(config.accuracies) // 2]
    _dots(axes[0, 0], data, "evolver", accuracy, f"(a) one chain, error {accuracy:.0e}")
    _dots(axes[0, 1], data, "solver", accuracy, f"(b) rates, error {accuracy:.0e}")
    _model_panel(axes[1, 0], data)
    _way_panel(axes[1, 1], data)
    return figure


def _dots(ax: Axes, data: xarray.Dataset, axis: str, accuracy: float, title: str) -> None:
    part = data.isel({axis: data[f"{axis}_accuracy"].values == accuracy})
    scenes = list(dict.fromkeys(data[f"{axis}_scene"].values))[::-1]
    methods = list(dict.fromkeys(data[f"{axis}_method"].values))
    for i, method in enumerate(methods):
        one = part.isel({axis: part[f"{axis}_method"].values == method})
        if one.sizes[axis]:
            places = [scenes.index(scene) for scene in one[f"{axis}_scene"].values]
            own = method in chart_evolvers.COLORS or method == "expm"
            color = chart_evolvers.COLORS.get(method, "C5" if own else f"{0.25 + 0.045 * (i % 12):.2f}")
            ax.plot(
                one[f"{axis}_seconds"],
                places,
                "os^vD<>pP*Xd"[i % 12],
                color=color,
                markersize=6 if own else 4,
                label=method,
            )
    ax.set_yticks(range(len(scenes)), scenes, fontsize="small")
    ax.set(xscale="log", xlabel="processor seconds, fastest setting", title=title, ylim=(-0.6, len(scenes) - 0.4))
    ax.grid(axis="y", alpha=0.3)
    ax.legend()


def _model_panel(ax: Axes, data: xarray.Dataset) -> None:
    for i, name in enumerate(dict.fromkeys(data.model_name.values)):
        part = data.isel(model=data.model_name.values == name)
        ax.plot(
            part.model_bands, part.model_distance / part.model_noise, marker="os^vD*PX"[i % 8], color=(*plots.COLORS, "0.6")[i % 8], label=name
        )
    ax.axhline(1, color="k", linestyle=":", label="two ensembles of chains")
    bands = list(dict.fromkeys(data.model_bands.values))
    ax.set(xscale="log", yscale="log", xlabel="bands $B$", ylabel="distance from fresh chains\n/ of two ensembles",
           title="(c) models, each by its nearest fit")  # fmt: skip
    ax.set_xticks(bands, [str(b) for b in bands])
    ax.yaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()
    ax.legend()


def _way_panel(ax: Axes, data: xarray.Dataset) -> None:
    order = np.arange(data.sizes["way"])[::-1]
    ax.barh(order + 0.2, data.way_work, 0.35, color="C0", label="chains evolved")
    ax.barh(order - 0.2, data.way_seconds, 0.35, color="C1", hatch="///", label="seconds")
    names = [
        f"{o.partition(':')[0]}: {n}".replace(": ", ":\n").replace(", ", ",\n") for o, n in zip(data.way_observable.values, data.way_name.values, strict=True)
    ]
    ax.set_yticks(order, names, fontsize="small")
    ax.axvline(1, color="k", linewidth=0.8)
    ax.set(xlabel="cost of the same error, plain = 1", title="(d) averaging over the ensemble")
    ax.legend()


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = [
        Row(f"{line['scene']}, {line['wanted']}: {line['use']}", line["seconds"], note=line["note"])
        for line in advice(data, config)
    ]
    rows += [
        Row(f"{o}, {n}: cost of the same error", float(w), note=f"in seconds {float(s):.2g}; plain = 1")
        for o, n, w, s in zip(
            data.way_observable.values, data.way_name.values, data.way_work.values, data.way_seconds.values, strict=True
        )
    ]
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    where = config.results or "short runs of the charts"
    return f"measured: seconds of the fastest setting, from {where}. The same as a table:\n{markdown(data, config)}"


SCRIPT = harness.Script("chart_summary", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
