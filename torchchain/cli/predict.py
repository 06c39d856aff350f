"""``torchchain predict``."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w
import torch

from torchchain import checks, plots
from torchchain.chain import Chain, StandingWave, State
from torchchain.cli import choices, outputs
from torchchain.cli.flags import Predict
from torchchain.cli.runs import config_of, merged_tables
from torchchain.energy import StartEnergy, excited, start_energy
from torchchain.ensemble.labels import time_coordinates
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_file import TIMES, regular_times
from torchchain.ensemble.stages import Stages
from torchchain.master import SOLVERS, MasterEquation, MasterFamily
from torchchain.results import model_file

if TYPE_CHECKING:
    import xarray

PREDICT_KEYS = ("strength", "source", "initial", "times", "excitation", "state")
STARTS = ("source", "initial", "excitation", "state")
Start = torch.Tensor | StartEnergy
"""What is solved for: energies of bands (start, band), or starts in space with that axis."""


def run_predict(flags: Predict, arguments: list[str]) -> None:
    """Solve a saved master equation and leave the request, the data, the figure and the record."""
    began = time.time()
    config, loaded = config_of(flags.config, flags.plugin)
    given = merged_tables(config, flags.overrides())
    checks.known_keys("predict", given, PREDICT_KEYS)
    checks.choice("method", flags.method, SOLVERS)
    device = str(checks.device("device", flags.device))
    checks.choice("format", flags.format, choices.FIGURES)
    outputs.check_apart(flags.out, flags.model)
    with outputs.run_folder(flags.out) as out, outputs.told_warnings() as warned:
        stages, path = Stages(), model_file(flags.model)
        with stages("loading"):
            master = _loaded(path, given.get("strength")).to(device)
            digest = outputs.sha256(path)
        times = _times(given.get("times", {}))
        starts, labels, request = _starts(given, master)
        with stages("prediction"):
            energy = master.solve(starts, times, method=flags.method).detach().cpu()
        if isinstance(starts, torch.Tensor):
            bands, rest, gone = starts, torch.zeros(1), torch.zeros(len(labels), len(times))
        else:
            assert master.starts is not None, "or such starts are refused"
            bands, rest, gone = starts.bands(master.n_bands), starts.rigid, master.starts.lost(starts, times).cpu()
        data = _dataset(master, path, starts, labels, times, energy)
        if "strength" in given:
            request["strength"] = float(given["strength"])
        if loaded:
            request["plugins"] = loaded
        text = tomli_w.dumps({**request, "times": times.tolist()})
        count = f"{len(labels)} start{'s' * (len(labels) > 1)}"
        drawn = outputs.figures(_figure(bands, labels, times, energy), flags.format)
        outputs.leave(
            out, {"results.nc": outputs.dataset(data), **drawn}, arguments, text, device, began, stages.seconds,
            seed=flags.seed, method=flags.method, warnings=warned, model={"path": str(path.resolve()), "sha256": digest},
            title=f"prediction of {count} to t = {float(times[-1]):g}",
            reasons=[f"solved by {flags.method}", *repr(master).splitlines()[1:]],
        )  # fmt: skip
    print(f"{count}, {len(times)} times to {float(times[-1]):g}, solved by {flags.method}")
    change = float((energy.sum(-1) + gone - bands.sum(-1)[:, None]).abs().max())
    print(f"largest change of total energy: {change:.3g}")
    if bool(rest.any()):
        print(f"energy at k = 0, which stays there and is in no band: {float(rest.max()):.3g}")
    if bool(gone.any()):
        print(f"energy that goes there from kicks: up to {float(gone.max()):.3g}")
    print(f"lowest energy in a band: {float(energy.min()):.3g}")
    if "band_energy_stderr" in data:
        print(f"largest standard error: {float(data.band_energy_stderr.max()):.3g}")
    print("seconds: " + ", ".join(f"{name} {seconds:.4f}" for name, seconds in stages.seconds.items()))
    print(f"results in {flags.out}")


def _loaded(path: Path, strength: Any) -> MasterEquation:
    """The model of a file, or that of a family at a strength."""
    if strength is None:
        return MasterEquation.load(path)
    return MasterFamily.load(path).at(checks.number("strength", strength, at_least=0))


def _times(times: Any) -> torch.Tensor:
    """Of a table or a list."""
    if not isinstance(times, Mapping):
        return checks.times("times", times)
    checks.known_keys("times", times, ("start", "stop", "step"))
    return regular_times(**{**TIMES, **times})


def _starts(given: Mapping[str, Any], master: MasterEquation) -> tuple[Start, list[str], dict[str, Any]]:
    """What is solved for, the names of the starts, and what was asked for."""
    n_bands, named = master.n_bands, [name for name in STARTS if name in given]
    if len(named) > 1:
        raise checks.fail(named[0], f"not be given together with {named[1]}", checks.shown(given[named[0]]))
    if named and named[0] in ("excitation", "state"):
        return _in_space(named[0], given[named[0]], master)
    if "initial" in given:
        initial = checks.real_tensor("initial", given["initial"])
        if tuple(initial.shape) != (n_bands,):
            raise checks.fail("initial", f"hold the {n_bands} bands of the model", f"{initial.numel()} numbers")
        checks.first_bad("initial", "not be negative", initial, initial < 0, "band")
        return initial[None], ["initial"], {"initial": initial.tolist()}
    source = given.get("source", range(1, n_bands + 1))
    if isinstance(source, (str, Mapping, int)) or not len(source):
        raise checks.FieldTypeError(f"source must be a list of bands, got {checks.shown(source)}")
    bands = [checks.integer("source", s, 1, n_bands) for s in source]
    starts = torch.eye(n_bands, dtype=torch.float64)[[s - 1 for s in bands]]
    return starts, [str(s) for s in bands], {"source": bands}


def _in_space(field: str, table: Any, master: MasterEquation) -> tuple[StartEnergy, list[str], dict[str, Any]]:
    """A start from an excitation, or from displacement and velocity of every particle, of energy 1."""
    table = checks.table(field, table)
    if master.starts is None:
        raise checks.fail(field, "be left out for a model calibrated without other starts (use initial)", table)
    count, request = master.starts.n_particles, {field: table}
    if field == "excitation":
        scene = Scene.from_dict({field: table, "n_particles": count, "n_bands": master.n_bands})
        wave = scene.excitation
        wave = replace(wave, tones=scene.tones) if isinstance(wave, StandingWave) else wave
        start, labels = excited(wave, count), [f"tone {tone}" for tone in scene.tones] or ["impulse"]
    else:
        checks.known_keys(field, table, ("displacement", "velocity"))
        told = {name: checks.real_tensor(f"{field}.{name}", values).double() for name, values in table.items()}
        for name, values in told.items():
            if tuple(values.shape) != (count,):
                raise checks.fail(f"{field}.{name}", f"hold the {count} particles of the model", values)
        if not told:
            raise checks.fail(field, "hold displacement, velocity or both", "neither")
        none = torch.zeros(count, dtype=torch.float64)
        state = State(told.get("displacement", none), told.get("velocity", none))
        start, labels = start_energy(Chain(torch.ones_like(none)), state), ["state"]
    if start.rigid.ndim == 0:
        start = StartEnergy(*(getattr(start, name)[None] for name in ("potential", "kinetic", "virial", "rigid")))
    return start.of_unit_energy(), labels, request


def _dataset(
    master: MasterEquation,
    path: Path,
    starts: Start,
    labels: list[str],
    times: torch.Tensor,
    energy: torch.Tensor,
) -> xarray.Dataset:
    """Labeled axes and units; with the standard error where the model has one."""
    import xarray

    axes, units = ("start", "time", "band"), {"units": "energy of the start"}
    bands = np.arange(1, master.n_bands + 1)
    told = master.calibration
    origin = "" if told is None else told.provenance if told.scene is None else told.scene.to_toml()
    variables = {"band_energy": (axes, energy.numpy(), {**units, "long_name": "energy in a band"})}
    if master.uncertainty is not None:
        error = master.standard_error(starts, times).cpu().numpy()
        label = {**units, "long_name": "standard error of the energy in a band"}
        variables["band_energy_stderr"] = (axes, error, label)
    return xarray.Dataset(
        variables,
        coords={
            "start": ("start", labels, {"long_name": "start: source band, or what it is in space"}),
            **time_coordinates(times),
            "band": ("band", bands, {"long_name": plots.BAND_LABEL}),
        },
        attrs={"model": path.name, "calibrated_on": origin},
    )


def _figure(bands: torch.Tensor, labels: list[str], times: torch.Tensor, energy: torch.Tensor) -> Any:
    shown = [0] if len(labels) == 1 else [round((len(labels) - 1) * f) for f in (10 / 32, 23 / 32)]
    with plots.style():
        figure, axes = plots.figure(plots.COLUMN * len(shown), 2.7, 1, len(shown))
        for ax, index in zip(axes[0], shown, strict=True):
            total = float(bands[index].sum()) or 1.0
            plots.band_map(ax, times.numpy(), energy[index].numpy() / total, f"start: {labels[index]}")
        plots.lettered(axes.flat if len(shown) > 1 else ())
    return figure
