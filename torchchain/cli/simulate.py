"""``torchchain simulate``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

from torchchain import plots
from torchchain.cli import outputs
from torchchain.cli.flags import Simulate
from torchchain.cli.runs import Run, config_of, running, scene_of
from torchchain.ensemble import plan as planning
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_words import describe
from torchchain.ensemble.simulation import simulate

if TYPE_CHECKING:
    import xarray


def run_simulate(
    flags: Simulate, arguments: list[str], options: dict[str, Any] | None = None, keep: bool = True
) -> None:
    """Measure a scene's observables and leave config, data, figure and record in the output folder.

    Args:
        flags, arguments: of the command.
        options: of the method.
        keep: whether to keep a checkpoint in the folder until it is done.
    """
    config, loaded = config_of(flags.config, flags.plugin)
    scene = planning.resolved(scene_of(config, flags))
    with running(flags, arguments, loaded, options, keep) as run:
        data = run.measured(simulate, scene)
        if data is not None:
            _leave(run, scene, data)


def _leave(run: Run, scene: Scene, data: xarray.Dataset) -> None:
    forecast = planning.forecast(scene, data.attrs, run.spent, _largest_error(data, scene.observables))
    with run.stages("figure"), plots.style():
        figure = _figure(scene, data)
    files = {"results.nc": outputs.dataset(data), **outputs.figures(figure, run.flags.format)}
    masses = f"mean {data.attrs['mass_mean']:.6f}, standard deviation {data.attrs['mass_sd']:.6f}"
    last = [row for name in scene.observables if (row := _last(data, name)) is not None]
    run.write(
        files, run.config(scene.to_toml()), seed=scene.seed, forecast=forecast, title=describe(scene),
        summary={"masses": masses}, measured=last, **run.how(scene, data.attrs),
    )  # fmt: skip
    print(describe(scene))
    run.told(forecast)
    print(f"masses: {masses}")
    for name, value, error in last:
        print(f"{name}: {value:.6g} +- {error:.2g}")
    print(f"{time.time() - run.began:.1f} s, results in {run.flags.out}")


def _last(data: xarray.Dataset, name: str) -> tuple[str, float, float] | None:
    """An observable at the last time and its standard error: the number, or the largest of several; of tones, that of the figure."""
    values, error = _drawn(data, name)
    when = ""
    if "time" in values.dims:
        values, error, when = values.isel(time=-1), error.isel(time=-1), " at the last time"
    if "tone" in values.coords:
        when += f", tone {int(values.tone)}"
    if values.ndim > 1:
        return None
    if values.ndim:
        place = int(values.values.argmax())
        axis = values.dims[0]
        values, error = values[place], error[place]
        where = data[axis].values[place]
        when += f", largest ({axis} {where if isinstance(where, str) else f'{float(where):g}'})"
    return f"{name}{when}", float(values), float(error)


def _drawn(data: xarray.Dataset, name: str) -> tuple[xarray.DataArray, xarray.DataArray]:
    """An observable and its standard error, of several tones those of the one in the middle."""
    parts = data[name], data[f"{name}_stderr"]
    if "tone" in data[name].dims:
        parts = parts[0].isel(tone=data.sizes["tone"] // 2), parts[1].isel(tone=data.sizes["tone"] // 2)
    return parts


def _largest_error(data: xarray.Dataset, names: Sequence[str]) -> float:
    """Largest standard error of the observables, each relative to its own largest value."""
    return max(float(data[f"{name}_stderr"].max()) / (float(abs(data[name]).max()) or 1.0) for name in names)


def _figure(scene: Scene, data: xarray.Dataset) -> Any:
    names = list(scene.observables)
    figure, axes = plots.figure(plots.COLUMN, 2.6 * len(names) + 0.2, len(names), 1)
    times = scene.times.numpy()
    for ax, name in zip(axes[:, 0], names, strict=True):
        values, error = _drawn(data, name)
        chosen = ""
        if "tone" in values.coords:
            tone = int(values.tone)
            chosen = f"tone {tone}"
            if scene.lattices is not None:
                chosen = f"source: band {tone}, {scene.lattices.bands(scene.n_bands).labels[tone - 1]}"
            elif scene.by_species:
                kind, band = divmod(tone - 1, scene.bands_each)
                chosen = f"source: {scene.species[kind].name}, band {band + 1}"
        label = plots.label_of(values)
        if name == "band_energy":
            plots.band_map(ax, times, values.values, title=chosen)
            if scene.by_species:
                kinds = ", ".join(each.name for each in scene.species)
                ax.set_ylabel(f"band $r$, {scene.bands_each} of each: {kinds}")
        elif values.dims[-1] == "species":
            for i, style in zip(range(values.sizes["species"]), cycle(("-", "--", ":", "-.")), strict=False):
                each, spread = (part.isel(species=i) for part in (values, error))
                plots.curve(ax, times, each.values, spread.values, ls=style, label=str(each.species.values))
            ax.legend(fontsize="small")
            ax.set(xlabel=plots.TIME_LABEL, ylabel=label, title=chosen)
        elif values.ndim == 2:
            axis = values.dims[1]
            plots.field_map(
                ax, times, data[axis].values, values.values, plots.TIME_LABEL, plots.label_of(data[axis]), label, chosen,
                signed=name == "displacement",
            )  # fmt: skip
        elif values.ndim == 1:
            axis = values.dims[0]
            plots.curve(ax, data[axis].values, values.values, error.values)
            ax.set(xlabel=plots.label_of(data[axis]), ylabel=label, title=chosen)
        else:
            ax.set_axis_off()
            ax.text(0.5, 0.5, f"{label}: axes {', '.join(map(str, values.dims))}", ha="center")
    if len(names) > 1:
        plots.lettered(axes.flat)
    return figure
