"""``torchchain calibrate``."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch

from torchchain import checks, plots
from torchchain.cli import outputs
from torchchain.cli.flags import Calibrate
from torchchain.cli.runs import how, keeping, merged_tables, out_and_device, scene_of
from torchchain.ensemble import plan as planning
from torchchain.ensemble import ranks
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.scene import Scene, describe
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer, band_transfer
from torchchain.master import MasterEquation, calibrate
from torchchain.master.calibration import recipe


def run_calibrate(
    flags: Calibrate, arguments: list[str], options: dict[str, Any] | None = None, keep: bool = True
) -> None:
    """Ensemble, master equation, prediction and their distance; leaves data, model, figure and record.

    Args:
        flags, arguments, options, keep: as for :func:`run_simulate`.
    """
    began = time.time()
    scene, extra = scene_of(flags, ("calibration",))
    table = extra.get("calibration", {})
    if not isinstance(table, Mapping):
        raise checks.FieldTypeError(f"calibration must be a table, got {checks.shown(table)}")
    settings = merged_tables(table, flags.calibration())
    checks.known_keys("calibration", settings, ("method", "model", "window", "constraint", "penalty", "steps", "learning_rate", "tolerance", "order", "bootstrap"))  # fmt: skip
    for name in ("window", "order"):
        if isinstance(settings.get(name), list):
            settings[name] = tuple(settings[name])
    out, device = out_and_device(flags)
    recipe(scene, **settings)  # before the ensemble is computed
    checkpoint = Checkpoint(out / "checkpoint", flags.checkpoint_every) if keep else None
    with keeping(checkpoint):
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
                    **how(flags, transfer.attributes, group, checkpoint), forecast=forecast, summary=dict(rows),
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
            f"{master.calibration.model}, fitted by {master.calibration.method}, {master.n_parameters} parameters",
        ),
        *([("conservation defect", master.model.conservation_defect)] if transfer.scene.damping == 0 else []),
        ("lowest predicted share of energy", float(predicted.min())),
    ]
    report = master.calibration.report
    if report.selection is not None:
        rows.insert(1, ("chosen", report.selection.reason))
    if report.loss is not None:
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
    figure, axes = plots.figure(13.5, 10, 3, 3)
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
