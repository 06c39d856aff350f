"""What the torchchain commands do once their flags are read."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
import xarray

from torchchain import checks, outputs, planning, plots, ranks
from torchchain.checkpoint import Checkpoint, Interrupted
from torchchain.cli import Calibrate, Family, Plan, Predict, Rerun, SceneFlags, Simulate
from torchchain.ensemble import BandTransfer, Stages, band_transfer, simulate
from torchchain.evolvers import METHODS
from torchchain.master import SOLVERS, MasterEquation, MasterFamily, calibrate
from torchchain.master.calibration import recipe
from torchchain.scene import Scene, describe, read_toml, regular_times
from torchchain.statistics import statistical_distance, total_variation


def run(flags: Any, arguments: list[str]) -> int:
    """Run the command that the flags belong to; returns the exit status."""
    if isinstance(flags, (Simulate, Calibrate, Rerun)):
        with _threads(flags.threads):
            if isinstance(flags, Simulate):
                run_simulate(flags, arguments)
            elif isinstance(flags, Calibrate):
                run_calibrate(flags, arguments)
            else:
                from torchchain.rerun import rerun

                return rerun(flags)
    elif isinstance(flags, Predict):
        run_predict(flags, arguments)
    elif isinstance(flags, Family):
        run_family(flags, arguments)
    elif isinstance(flags, Plan):
        print(planning.plan(_scene(flags)[0], artifact=flags.artifact))
    return 0


@contextmanager
def _threads(number: int | None) -> Iterator[None]:
    """Run on as many threads as asked for, or on a fair share of the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(ranks.fair_threads() if number is None else checks.integer("threads", number, 1, 4096))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _keeping(checkpoint: Checkpoint | None) -> Iterator[None]:
    """An interrupt after the ensemble is done tells of the realizations that are kept."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        if checkpoint is None or not checkpoint.folder.exists():
            raise
        raise Interrupted(
            f"interrupted: finished realizations are kept in {checkpoint.folder}, the same command goes on from there"
        ) from None


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables, the second over the first; an excitation of another kind replaces the first's fields."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            kind = value.get("kind", old.get("kind"))
            replaced = key == "excitation" and kind != old.get("kind", "standing_wave")
            merged[key] = dict(value) if replaced else _merge(old, value)
        else:
            merged[key] = value
    return merged


def _scene(flags: SceneFlags, tables: tuple[str, ...] = ()) -> tuple[Scene, dict[str, Any]]:
    """The scene of config file and flags, and the config's further tables."""
    config = read_toml(flags.config) if flags.config is not None else {}
    extra = {name: config.pop(name) for name in tables if name in config}
    given = flags.overrides()
    if isinstance(given.get("times"), Mapping) and not isinstance(config.get("times"), Mapping):
        config["times"] = {"start": 0.0, "stop": 50.0, "step": 0.25}
    return Scene.from_dict(_merge(config, given)), extra


def _figure(width: float, height: float, rows: int, columns: int) -> Any:
    import matplotlib.figure

    figure = matplotlib.figure.Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _out_and_device(flags: Simulate | Calibrate) -> tuple[Path, str]:
    """Folder and device of a run over an ensemble, and its method, checked before anything is computed."""
    out = outputs.check_writable(flags.out)
    device = str(checks.device("device", ranks.own_device(flags.device)))
    checks.choice("method", flags.method, ("auto", *METHODS))
    return out, device


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
    scene = planning.resolved(_scene(flags)[0])
    out, device = _out_and_device(flags)
    checkpoint = Checkpoint(out / "checkpoint", flags.checkpoint_every) if keep else None
    with _keeping(checkpoint):
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
                **_how(flags, data.attrs, group, checkpoint),
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


def _how(
    flags: Simulate | Calibrate, attributes: Mapping[str, Any], group: ranks.Ranks, checkpoint: Checkpoint | None
) -> dict[str, Any]:
    """What the record says of an ensemble: the method asked for and the one used, processes, what was taken over."""
    return {
        "method": flags.method,
        "resolved": {"method": attributes["method"], "options": json.loads(attributes["method_options"])},
        "processes": group.size,
        "resumed_realizations": checkpoint.resumed if checkpoint is not None else 0,
        "realized": {name: attributes[name] for name in ("mass_mean", "mass_sd")},
    }


def _simulate_figure(scene: Scene, data: xarray.Dataset) -> Any:
    names = list(scene.observables)
    figure, axes = _figure(6, 3.6 * len(names), len(names), 1)
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


def run_calibrate(
    flags: Calibrate, arguments: list[str], options: dict[str, Any] | None = None, keep: bool = True
) -> None:
    """Ensemble, master equation, prediction and their distance; leaves data, model, figure and record.

    Args:
        flags, arguments, options, keep: as for :func:`run_simulate`.
    """
    began = time.time()
    scene, extra = _scene(flags, ("calibration",))
    table = extra.get("calibration", {})
    if not isinstance(table, Mapping):
        raise checks.FieldTypeError(f"calibration must be a table, got {checks.shown(table)}")
    settings = _merge(table, flags.calibration())
    checks.known_keys("calibration", settings, ("method", "model", "window", "constraint", "penalty", "steps", "learning_rate", "tolerance", "order", "bootstrap"))  # fmt: skip
    for name in ("window", "order"):
        if isinstance(settings.get(name), list):
            settings[name] = tuple(settings[name])
    out, device = _out_and_device(flags)
    recipe(scene, **settings)  # before the ensemble is computed
    checkpoint = Checkpoint(out / "checkpoint", flags.checkpoint_every) if keep else None
    with _keeping(checkpoint):
        _calibrate(flags, scene, settings, out, device, arguments, options, checkpoint, began)


def _calibrate(
    flags: Calibrate, scene: Scene, settings: dict[str, Any], out: Path, device: str, arguments: list[str],
    options: dict[str, Any] | None, checkpoint: Checkpoint | None, began: float,
) -> None:  # fmt: skip
    stages = Stages()
    with ranks.process_group(device) as group:
        before = time.time()
        transfer = band_transfer(
            scene, flags.method, device=device, progress=True, stages=stages, options=options, checkpoint=checkpoint,
            ranks=group,
        )  # fmt: skip
        spent = time.time() - before
    if group.rank:
        return
    measured = replace(transfer.scene, observables=("band_energy", "long_time_band_energy"))
    forecast = planning.forecast(measured, transfer.attributes, spent, float(transfer.stderr.max()))
    with stages("calibration"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        master = calibrate(transfer, progress=True, **settings)
    with stages("prediction"):
        predicted = master.solve(torch.eye(master.n_bands, dtype=torch.float64), transfer.times).detach()
    with stages("comparison"):
        rows = comparison(transfer, master, predicted)
    with stages("figure"):
        figure = calibration_figure(transfer, master, predicted)
    data = transfer.to_dataset()
    data["prediction"] = data["band_energy"].copy(data=predicted.numpy())
    data["prediction"].attrs["long_name"] = "share of the energy predicted by the master equation"
    done = master.calibration
    chosen = {**settings, "method": done.method, "model": done.model, "window": list(done.window or ())}
    config = transfer.scene.to_toml() + "\n" + tomli_w.dumps({"calibration": chosen})
    with stages("writing"):
        outputs.write(
            out,
            {
                "config.toml": outputs.text(config),
                "transfer.nc": outputs.dataset(data),
                "model.safetensors": master.save,
                "figure.png": outputs.figure(figure),
                "run.json": outputs.run_record(
                    arguments, config, device, began, stages.seconds, seed=scene.seed,
                    **_how(flags, transfer.attributes, group, checkpoint), forecast=forecast, summary=dict(rows),
                ),
            },
        )  # fmt: skip
    if checkpoint is not None:
        checkpoint.clear()
    print(describe(transfer.scene))
    print(planning.forecast_line(forecast))
    for warning in caught:
        print(f"warning: {warning.message}")
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value:.4g}" if isinstance(value, float) else f"{name:<{width}}  {value}")
    print("seconds: " + ", ".join(f"{name} {seconds:.2f}" for name, seconds in stages.seconds.items()))
    print(f"{time.time() - began:.1f} s, results in {out}")


def comparison(transfer: BandTransfer, master: MasterEquation, predicted: torch.Tensor) -> list[tuple[str, Any]]:
    """The table of a calibration: what the model is, how far it is from its ensemble, and the ensemble's own error."""
    distance = total_variation(predicted, transfer.mean)
    statistical = statistical_distance(transfer.stderr)
    end = float(transfer.times[-1])
    late = transfer.times > end / 2
    early = ~late & (transfer.times > 0)
    rows: list[tuple[str, Any]] = [
        (
            "model",
            f"{master.calibration.model}, fitted by {master.calibration.method}, {master.model.n_parameters} parameters",
        ),
        *([("conservation defect", master.model.conservation_defect)] if transfer.scene.damping == 0 else []),
        ("lowest predicted share of energy", float(predicted.min())),
    ]
    report = master.calibration.report
    if "selection" in report:
        rows.insert(1, ("chosen", report["selection"]))
    if "damping" in report:
        lost = 1 - transfer.mean.sum(-1)
        rows.append(
            (
                "energy lost: root mean square error of the prediction",
                float((1 - predicted.sum(-1) - lost).square().mean().sqrt()),
            )
        )
    rows.append(
        ("compared with chains up to", "infinite time" if master.horizon == math.inf else f"t = {master.horizon:g}")
    )
    if bool(early.any()):
        rows.append((f"total variation to the ensemble, 0 < t <= {end / 2:g}", float(distance[:, early].mean())))
    if bool(late.any()):
        rows.append((f"total variation to the ensemble, {end / 2:g} < t <= {end:g}", float(distance[:, late].mean())))
        rows.append(
            (
                "statistical error: total variation of two such ensembles",
                float(statistical[:, transfer.times > 0].mean()),
            )
        )
    rows.append(
        ("masses: realized mean, standard deviation", "{mass_mean:.5f}, {mass_sd:.5f}".format(**transfer.attributes))
    )
    return rows


def calibration_figure(transfer: BandTransfer, master: MasterEquation, predicted: torch.Tensor) -> Any:
    """Measured and predicted maps of two sources, decay curves, rates, and the distance over time."""
    n = transfer.n_bands
    low, high = max(1, round(n * 10 / 32)), max(1, round(n * 23 / 32))
    times, mean, stderr = transfer.times.numpy(), transfer.mean.numpy(), transfer.stderr.numpy()
    model = predicted.numpy()
    figure, axes = _figure(13.5, 10, 3, 3)
    for row, source in enumerate((low, high)):
        plots.band_map(axes[row, 0], times, mean[source - 1], f"ensemble, source band {source}")
        plots.band_map(axes[row, 1], times, model[source - 1], f"master equation, source band {source}")
        other = max(1, source - 3)
        plots.decay_comparison(
            axes[row, 2],
            times,
            mean,
            stderr,
            model,
            list(dict.fromkeys([(source, source), (source, other)])),
            f"source band {source}",
        )
    plots.rate_map(axes[2, 0], master.rates.detach().numpy(), "rates Q (diagonal: loss)")
    plots.distance_curve(
        axes[2, 1],
        times,
        total_variation(predicted, transfer.mean).numpy(),
        statistical_distance(transfer.stderr).numpy(),
        "distance of model and ensemble",
    )
    ax = axes[2, 2]
    bands = np.arange(1, n + 1)
    ax.plot(bands, -master.rates.detach().diagonal().numpy(), "o", label="loss rate $-Q_{ss}$")
    off = master.rates.detach() - torch.diag(master.rates.detach().diagonal())
    ax.plot(bands, off.sum(-1).numpy(), "-", label=r"$\sum_{r \neq s} Q_{sr}$")
    ax.set(xlabel="source s", ylabel="rate", title="conservation")
    ax.legend(fontsize="small")
    figure.suptitle(f"{describe(transfer.scene)}; model {master.calibration.model}, {master.calibration.method}")
    return figure


PREDICT_KEYS = ("strength", "source", "initial", "times")


def _loaded(path: str, strength: Any) -> MasterEquation:
    """The model of a file, or that of a family at a strength."""
    if strength is None:
        return MasterEquation.load(path)
    return MasterFamily.load(path).at(checks.number("strength", strength, at_least=0))


def run_family(flags: Family, arguments: list[str]) -> None:
    """Join models of several strengths and leave the family and its record."""
    began = time.time()
    if not flags.models:
        raise checks.fail("models", "be at least one file", "none")
    out = outputs.check_writable(flags.out)
    family = MasterFamily([MasterEquation.load(path) for path in flags.models])
    times = torch.linspace(0, 500, 101, dtype=torch.float64)[1:]
    left_out = family.leave_one_out(times)
    outputs.write(
        out,
        {
            "model.safetensors": family.save,
            "run.json": outputs.run_record(
                arguments, "", "cpu", began, {}, strengths=list(family.strengths), left_out=left_out,
                models=[{"path": str(Path(path).resolve()), "sha256": outputs.sha256(path)} for path in flags.models],
            ),
        },
    )  # fmt: skip
    print(f"disorder 0 to {family.strengths[-1]:g}, calibrated at {', '.join(f'{xi:g}' for xi in family.strengths)}")
    for strength, distance in left_out:
        print(f"left out and predicted by the others, 0 < t <= 500: {strength:g}, total variation {distance:.4f}")
    print(f"results in {out}")


def run_predict(flags: Predict, arguments: list[str]) -> None:
    """Solve a saved master equation and leave the request, the data, the figure and the record."""
    began = time.time()
    config = read_toml(flags.config) if flags.config is not None else {}
    given = _merge(config, flags.overrides())
    checks.known_keys("predict", given, PREDICT_KEYS)
    checks.choice("method", flags.method, SOLVERS)
    out, device = outputs.check_writable(flags.out), str(checks.device("device", flags.device))
    stages = Stages()
    with stages("loading"):
        master = _loaded(flags.model, given.get("strength")).to(device)
        digest = outputs.sha256(flags.model)
    n = master.n_bands
    times = given.get("times", {})
    if isinstance(times, Mapping):
        checks.known_keys("times", times, ("start", "stop", "step"))
        wanted = regular_times(times.get("start", 0.0), times.get("stop", 50.0), times.get("step", 0.25))
    else:
        wanted = checks.times("times", times)
    if "initial" in given:
        if "source" in given:
            raise checks.fail("source", "not be given together with initial", given["source"])
        initial = checks.real_tensor("initial", given["initial"])
        if tuple(initial.shape) != (n,):
            raise checks.fail("initial", f"hold the {n} bands of the model", f"{initial.numel()} numbers")
        starts, labels = initial[None], ["initial"]
        request: dict[str, Any] = {"initial": initial.tolist()}
    else:
        source = given.get("source", range(1, n + 1))
        if isinstance(source, (str, Mapping, int)) or not len(source):
            raise checks.FieldTypeError(f"source must be a list of bands, got {checks.shown(source)}")
        bands = [checks.integer("source", s, 1, n) for s in source]
        starts, labels = torch.eye(n, dtype=torch.float64)[[s - 1 for s in bands]], [str(s) for s in bands]
        request = {"source": bands}
    with stages("prediction"):
        energy = master.solve(starts, wanted, method=flags.method).detach().cpu()
    data = xarray.Dataset(
        {
            "band_energy": (
                ("start", "time", "band"),
                energy.numpy(),
                {"units": "energy of the start", "long_name": "energy in a band"},
            )
        },
        coords={
            "start": ("start", labels, {"long_name": "source band of the start"}),
            "time": (
                "time",
                wanted.numpy(),
                {"units": "travel time of sound over one particle", "long_name": "time t"},
            ),
            "band": ("band", np.arange(1, n + 1), {"long_name": plots.BAND_LABEL}),
        },
        attrs={"model": str(Path(flags.model).name), "calibrated_on": master.calibration.scene.to_toml()},
    )
    if master.uncertainty is not None:
        error = master.standard_error(starts, wanted).cpu().numpy()
        note = {"units": "energy of the start", "long_name": "standard error of the energy in a band"}
        data["band_energy_stderr"] = data["band_energy"].copy(data=error).assign_attrs(note)
    shown = [0] if len(labels) == 1 else [round((len(labels) - 1) * f) for f in (10 / 32, 23 / 32)]
    figure, axes = _figure(5.5 * len(shown), 4, 1, len(shown))
    for ax, index in zip(axes[0], shown, strict=True):
        total = float(starts[index].sum()) or 1.0
        plots.band_map(ax, wanted.numpy(), energy[index].numpy() / total, f"start: {labels[index]}")
    if "strength" in given:
        request["strength"] = float(given["strength"])
    text = tomli_w.dumps({**request, "times": wanted.tolist()})
    outputs.write(
        out,
        {
            "config.toml": outputs.text(text),
            "results.nc": outputs.dataset(data),
            "figure.png": outputs.figure(figure),
            "run.json": outputs.run_record(
                arguments, text, device, began, stages.seconds, seed=flags.seed, method=flags.method,
                model={"path": str(Path(flags.model).resolve()), "sha256": digest},
            ),
        },
    )  # fmt: skip
    print(f"{len(labels)} starts, {len(wanted)} times to {float(wanted[-1]):g}, solved by {flags.method}")
    print(f"largest change of total energy: {float((energy.sum(-1) - starts.sum(-1)[:, None]).abs().max()):.3g}")
    print(f"lowest energy in a band: {float(energy.min()):.3g}")
    if "band_energy_stderr" in data:
        print(f"largest standard error: {float(data.band_energy_stderr.max()):.3g}")
    print("seconds: " + ", ".join(f"{name} {seconds:.4f}" for name, seconds in stages.seconds.items()))
    print(f"results in {out}")
