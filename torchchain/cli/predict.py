"""``torchchain predict``."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
import xarray

from torchchain import checks, plots
from torchchain.cli import outputs
from torchchain.cli.flags import Predict
from torchchain.cli.runs import merged_tables
from torchchain.ensemble.scene import read_toml, regular_times
from torchchain.ensemble.stages import Stages
from torchchain.master import SOLVERS, MasterEquation, MasterFamily

PREDICT_KEYS = ("strength", "source", "initial", "times")


def _loaded(path: str, strength: Any) -> MasterEquation:
    """The model of a file, or that of a family at a strength."""
    if strength is None:
        return MasterEquation.load(path)
    return MasterFamily.load(path).at(checks.number("strength", strength, at_least=0))


def run_predict(flags: Predict, arguments: list[str]) -> None:
    """Solve a saved master equation and leave the request, the data, the figure and the record."""
    began = time.time()
    config = read_toml(flags.config) if flags.config is not None else {}
    given = merged_tables(config, flags.overrides())
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
    figure, axes = plots.figure(5.5 * len(shown), 4, 1, len(shown))
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
