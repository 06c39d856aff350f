"""``torchchain simulate``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import xarray

from torchchain import plots
from torchchain.cli import outputs
from torchchain.cli.flags import Simulate
from torchchain.cli.runs import how, keeping, out_and_device, scene_of
from torchchain.ensemble import plan as planning
from torchchain.ensemble import ranks
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.scene import Scene, describe
from torchchain.ensemble.simulation import simulate
from torchchain.ensemble.stages import Stages


def run_simulate(
    flags: Simulate, arguments: list[str], options: dict[str, Any] | None = None, keep: bool = True
) -> None:
    """Measure a scene's observables and leave config, data, figure and record in the output folder.

    Args:
        flags, arguments: of the command.
        options: of the method.
        keep: whether to keep a checkpoint in the folder until it is done.
    """
    began = time.time()
    scene = planning.resolved(scene_of(flags)[0])
    out, device = out_and_device(flags)
    checkpoint = Checkpoint(out / "checkpoint", flags.checkpoint_every) if keep else None
    with keeping(checkpoint):
        _simulate(flags, scene, out, device, arguments, options, checkpoint, began)


def _simulate(
    flags: Simulate, scene: Scene, out: Path, device: str, arguments: list[str], options: dict[str, Any] | None,
    checkpoint: Checkpoint | None, began: float,
) -> None:  # fmt: skip
    stages = Stages()
    with ranks.process_group(device) as group:
        before = time.time()
        data = simulate(
            scene, flags.method, device=device, progress=True, stages=stages, options=options, checkpoint=checkpoint,
            ranks=group,
        )  # fmt: skip
        spent = time.time() - before
    if group.rank:
        return
    forecast = planning.forecast(scene, data.attrs, spent, _largest_error(data, scene.observables))
    figure = _simulate_figure(scene, data)
    config = scene.to_toml()
    outputs.write(
        out,
        {
            "config.toml": outputs.text(config),
            "results.nc": outputs.dataset(data),
            "figure.png": outputs.figure(figure),
            "run.json": outputs.run_record(
                arguments, config, device, began, stages.seconds, seed=scene.seed, forecast=forecast,
                **how(flags, data.attrs, group, checkpoint),
            ),
        },
    )  # fmt: skip
    if checkpoint is not None:
        checkpoint.clear()
    print(describe(scene))
    print(planning.forecast_line(forecast))
    print(f"masses: mean {data.attrs['mass_mean']:.6f}, standard deviation {data.attrs['mass_sd']:.6f}")
    for name in scene.observables:
        last = data[name].isel(time=-1) if "time" in data[name].dims else data[name]
        error = data[f"{name}_stderr"]
        error = error.isel(time=-1) if "time" in error.dims else error
        if last.ndim == 0:
            print(f"{name} at the last time: {float(last):.6g} +- {float(error):.2g}")
    print(f"{time.time() - began:.1f} s, results in {out}")


def _largest_error(data: xarray.Dataset, names: Sequence[str]) -> float:
    """Largest standard error of the observables, each relative to its own largest value."""
    return max(float(data[f"{name}_stderr"].max()) / (float(abs(data[name]).max()) or 1.0) for name in names)


def _simulate_figure(scene: Scene, data: xarray.Dataset) -> Any:
    names = list(scene.observables)
    figure, axes = plots.figure(6, 3.6 * len(names), len(names), 1)
    times = scene.times.numpy()
    for ax, name in zip(axes[:, 0], names, strict=True):
        values = data[name]
        first = values.isel(tone=len(scene.tones) // 2) if "tone" in values.dims else values
        label = f"{values.attrs['long_name']} ({values.attrs['units']})"
        chosen = f"tone {int(first.tone)}" if "tone" in values.dims else ""
        if name == "band_energy":
            plots.band_map(ax, times, first.values, title=chosen)
        elif first.ndim == 2:
            axis = first.dims[1]
            plots.field_map(
                ax, times, data[axis].values, first.values, plots.TIME_LABEL, data[axis].attrs.get("long_name", str(axis)),
                label, chosen, signed=name == "displacement",
            )  # fmt: skip
        else:
            axis = first.dims[0]
            error = data[f"{name}_stderr"]
            error = error.isel(tone=len(scene.tones) // 2) if "tone" in error.dims else error
            plots.curve(ax, data[axis].values, first.values, error.values)
            ax.set(xlabel=data[axis].attrs.get("long_name", str(axis)), ylabel=label, title=chosen)
    figure.suptitle(describe(scene), fontsize="small")
    return figure
