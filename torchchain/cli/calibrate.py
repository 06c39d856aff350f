"""``torchchain calibrate``."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import tomli_w
import torch

from torchchain import checks
from torchchain.cli import outputs
from torchchain.cli.calibration_figure import Rates, calibration_figure, rates_of, sources_of
from torchchain.cli.flags import Calibrate
from torchchain.cli.report import shares_left
from torchchain.cli.runs import Run, config_of, merged_tables, running, scene_of
from torchchain.ensemble import plan as planning
from torchchain.ensemble.measured_transfer import band_transfer, measured_observables
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_words import describe
from torchchain.ensemble.starts import start_scene
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master import Calibration, MasterEquation, calibrate
from torchchain.master.calibration import recipe
from torchchain.master.derived import foresee
from torchchain.master.ladder import methods
from torchchain.progress import log
from torchchain.results import read_transfer
from torchchain.threads import beside, meanwhile

DATA = "transfer.nc"


def run_calibrate(
    flags: Calibrate, arguments: list[str], options: dict[str, Any] | None = None, keep: bool = True
) -> None:
    """Ensemble, master equation, prediction and their distance; leaves data, model, figure and record.

    Args:
        flags, arguments, options, keep: as for :func:`run_simulate`.
    """
    config, loaded = config_of(flags.config, flags.plugin)
    settings = _settings(config.pop("calibration", {}), flags)
    starts = checks.truth("starts", settings.pop("starts", True))
    if flags.transfer is not None:
        for name in {**config, **flags.overrides()}:
            raise checks.fail(name, "not be given together with transfer, which is of a scene already", repr(name))
        outputs.check_apart(flags.out, flags.transfer)
        path, transfer = read_transfer(flags.transfer)
        transfer = transfer if starts else replace(transfer, starts=None)
        recipe(transfer, **settings)
        shown = sources_of(flags.show, transfer.n_bands)
        with running(flags, arguments, loaded, options, keep=False) as run:
            source = {"transfer": {"path": str(path.resolve()), "sha256": outputs.sha256(path)}}
            _leave(run, transfer, settings, starts, None, source, shown)
        return
    if flags.observables is not None:
        raise checks.fail("observables", "be left out: a calibration measures the energies of bands", list(flags.observables))
    scene = scene_of(config, flags)
    asked = recipe(scene, **settings)  # before the ensemble is computed
    shown = sources_of(flags.show, scene.n_bands)
    ahead = partial(foresee, scene) if asked.model is None else lambda: None
    with running(flags, arguments, loaded, options, keep) as run, meanwhile(ahead, torch.get_num_threads()):
        found = run.measured(partial(band_transfer, starts=starts), scene)
        if found is not None:
            assert found.scene is not None, "of a simulation"
            ensemble = replace(found.scene, observables=measured_observables(found.scene))
            forecast = planning.forecast(ensemble, found.attributes, run.spent, float(found.stderr.max()))
            if found.starts is not None and "predicted_seconds" in forecast:
                forecast["predicted_seconds"] += seconds_of_starts(found.scene, found.attributes)
            _leave(run, found, settings, starts, forecast, run.how(ensemble, found.attributes), shown)


def seconds_of_starts(scene: Scene, how: Mapping[str, Any]) -> float:
    """What the other starts of a scene are predicted to take, by the ``method`` and ``method_options`` of its transfer."""
    return float(planning.forecast(start_scene(scene), how, 0.0, 0.0).get("predicted_seconds", 0.0))


def _settings(table: Any, flags: Calibrate) -> dict[str, Any]:
    """How to fit: the config's table and the flags over it."""
    if not isinstance(table, Mapping):
        raise checks.FieldTypeError(f"calibration must be a table, got {checks.shown(table)}")
    settings = merged_tables(table, flags.calibration())
    fits = [name for fit in methods().values() for name in fit.settings_names]
    checks.known_keys(
        "calibration", settings, ("method", "model", "window", "bootstrap", "starts", *dict.fromkeys(fits))
    )
    for name in ("window", "order"):
        if isinstance(settings.get(name), list):
            settings[name] = tuple(settings[name])
    return settings


def _leave(
    run: Run, transfer: BandTransfer, settings: dict[str, Any], starts: bool, forecast: dict[str, Any] | None,
    source: dict[str, Any], shown: Sequence[int],
) -> None:  # fmt: skip
    """Fit, predict, compare, draw, write and tell; the data are written where the fit leaves a core."""
    stages = run.stages
    with outputs.staging(run.out) as aside, beside(partial(_save, transfer, aside), torch.get_num_threads()) as saved:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            log.info("calibrating on %d bands and %d times", transfer.n_bands, len(transfer.times))
            with stages("calibration"):
                master = calibrate(transfer, progress=True, **settings)
            with stages("prediction"):
                predicted = master.solve(torch.eye(master.n_bands, dtype=torch.float64), transfer.times).detach()
            with stages("comparison"):
                rows = comparison(transfer, master, predicted)
            log.info("drawing and writing")
            with stages("figure"):
                rates = rates_of(transfer, master)
                figure = calibration_figure(transfer, master, predicted, rates, shown)
        done = fitted(master)
        chosen = {**settings, "method": done.method, "model": done.model, "window": list(done.window or ())}
        chosen |= {} if starts else {"starts": False}
        scene = [] if transfer.scene is None or "transfer" in source else [transfer.scene.to_toml()]
        seed = None if transfer.scene is None else transfer.scene.seed
        files = {
            DATA: lambda path: saved(),
            "model.safetensors": master.save,
            **outputs.figures(figure, run.flags.format),
        }
        run.warned.extend(str(warning.message) for warning in caught)
        config = run.config(*scene, tomli_w.dumps({"calibration": chosen}))
        run.write(
            files, config, aside, seed=seed, **{**source, "reasons": [*source.get("reasons", []), *_model_reasons(master)]},
            forecast=forecast, title=title(transfer), summary=dict(rows), measured=measured(transfer, shown, rates),
            numbers=numbers(transfer, master, predicted),
        )  # fmt: skip
    print(title(transfer))
    run.told(forecast)
    for warning in caught:
        print(f"warning: {warning.message}")
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value:.4g}" if isinstance(value, float) else f"{name:<{width}}  {value}")
    print("seconds: " + ", ".join(f"{name} {seconds:.2f}" for name, seconds in stages.seconds.items()))
    print(f"{time.time() - run.began:.1f} s, results in {run.flags.out}")


def _save(transfer: BandTransfer, folder: Path) -> None:
    outputs.dataset(transfer.to_dataset())(folder / DATA)


def fitted(master: MasterEquation) -> Calibration:
    """How the model came to be, which :func:`calibrate` always tells."""
    assert master.calibration is not None
    return master.calibration


def title(transfer: BandTransfer) -> str:
    """Where the transfer is from, in one line."""
    if transfer.scene is not None:
        return describe(transfer.scene)
    words = transfer.provenance.words if transfer.provenance is not None else ""
    return f"{words or 'band transfer'}, {transfer.n_bands} bands, {len(transfer.times)} times"


def _model_reasons(master: MasterEquation) -> list[str]:
    """Why this model, with what the selection tried before."""
    done = fitted(master)
    chosen = done.report.selection
    if chosen is None:
        return [f"model '{done.model}', fitted by {done.method}, was asked for"]
    tried = ", ".join(
        f"'{rung.model}'{f' {rung.order}' if rung.order else ''} {rung.distance:.4f}" for rung in chosen.tried
    )
    halves = (
        f" (two halves of the ensemble: {chosen.halves_distance:.4f})" if chosen.halves_distance is not None else ""
    )
    held_out = [f"total variation from the half held out: {tried}{halves}"] if tried else []
    return [f"model '{done.model}': {chosen.reason}", *held_out]


def measured(transfer: BandTransfer, shown: Sequence[int], rates: Rates) -> list[tuple[str, float, float | None]]:
    """What is left in the bands of the figure at the last time, and their rates of loss, with standard errors."""
    rows = shares_left(transfer, shown)
    if rates.error is not None:
        for source in shown:
            loss = -float(rates.values[source - 1, source - 1])
            rows.append((f"rate of loss of band {source}, {rates.meaning}", loss, float(rates.error[source - 1])))
    return rows


def comparison(transfer: BandTransfer, master: MasterEquation, predicted: torch.Tensor) -> list[tuple[str, Any]]:
    """The table of a calibration: what the model is, how far it is from its ensemble, and the ensemble's own error."""
    distance = total_variation(predicted, transfer.mean)
    statistical = statistical_distance(transfer.stderr)
    end = float(transfer.times[-1])
    late = transfer.times > end / 2
    early = ~late & (transfer.times > 0)
    done = fitted(master)
    rows: list[tuple[str, Any]] = [
        ("model", f"{done.model}, fitted by {done.method}, {master.n_parameters} parameters"),
        *([("chosen", done.report.selection.reason)] if done.report.selection is not None else []),
        *([("conservation defect", master.model.conservation_defect)] if transfer.damping == 0 else []),
        ("lowest predicted share of energy", float(predicted.min())),
    ]
    if done.report.loss is not None:
        lost = transfer.mean.sum(-1) - predicted.sum(-1)
        rows.append(("energy lost: root mean square error of the prediction", float(lost.square().mean().sqrt())))
    compared = "infinite time" if master.horizon == math.inf else f"t = {master.horizon:g}"
    rows.append(("compared with chains up to", compared))
    if bool(early.any()):
        rows.append((f"total variation to the ensemble, 0 < t <= {end / 2:g}", float(distance[:, early].mean())))
    if bool(late.any()):
        rows.append((f"total variation to the ensemble, {end / 2:g} < t <= {end:g}", float(distance[:, late].mean())))
        mean = float(statistical[:, transfer.times > 0].mean())
        rows.append(("statistical error: total variation of two such ensembles", mean))
    if "mass_mean" in transfer.attributes:
        realized = "{mass_mean:.5f}, {mass_sd:.5f}".format(**transfer.attributes)
        rows.append(("masses: realized mean, standard deviation", realized))
    return rows


def numbers(transfer: BandTransfer, master: MasterEquation, predicted: torch.Tensor) -> dict[str, float]:
    """What sums a calibration up, as numbers with short names, for tables and sweeps.

    Returns:
        n_parameters; lowest_energy predicted, of the start's; tv, mean total variation from the ensemble over t > 0, and tv_noise,
        that of two such ensembles; horizon, the last time compared with chains; conservation_defect of undamped chains.
    """
    later = transfer.times > 0
    found = {
        "n_parameters": float(master.n_parameters),
        "lowest_energy": float(predicted.min()),
        "horizon": master.horizon,
    }
    if bool(later.any()):
        found["tv"] = float(total_variation(predicted, transfer.mean)[:, later].mean())
        found["tv_noise"] = float(statistical_distance(transfer.stderr)[:, later].mean())
    if transfer.damping == 0:
        found["conservation_defect"] = master.model.conservation_defect
    return found
