"""The flags of every command, as typed records."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro


@dataclass(frozen=True)
class DisorderFlags:
    """Disorder of the masses."""

    kind: str | None = None
    """normal (default), uniform, binary, lognormal or gamma"""
    strength: float | None = None
    """standard deviation xi in mean masses (default 0.3)"""
    lower: float | None = None
    """masses below this are drawn again (default 0.05)"""


@dataclass(frozen=True)
class ExcitationFlags:
    """How the chains are set in motion."""

    kind: str | None = None
    """standing_wave (default) or impulse"""
    site: int | None = None
    """impulse: particle, counted from 1 (default 1)"""
    velocity: float | None = None
    """impulse: initial velocity (default 0.01)"""
    tones: tuple[int, ...] | None = None
    """standing wave: tones, a run of its own each (default: the center tone of every band)"""
    amplitude: float | None = None
    """standing wave: amplitude in initial overlaps (default 0.01)"""
    phase: str | None = None
    """standing wave: sin (default) or cos"""


@dataclass(frozen=True)
class TimesFlags:
    """Output times, in travel times of sound over one particle."""

    start: float | None = None
    """first time (default 0)"""
    stop: float | None = None
    """last time (default 50)"""
    step: float | None = None
    """step (default 0.25)"""


@dataclass(frozen=True)
class SceneFlags:
    """Flags that describe a scene."""

    config: str | None = None
    """scene file (TOML)"""
    n_particles: int | None = None
    """particles per chain (default 256)"""
    boundary: str | None = None
    """periodic (default) or fixed"""
    disorder: DisorderFlags = field(default_factory=DisorderFlags)
    excitation: ExcitationFlags = field(default_factory=ExcitationFlags)
    times: TimesFlags = field(default_factory=TimesFlags)
    n_bands: int | None = None
    """wavenumber bands (default 32)"""
    realizations: int | None = None
    """chains in the ensemble (default 100)"""
    seed: int | None = None
    """seed of the ensemble (default 0)"""
    tolerance: float | None = None
    """accuracy wanted; none for the ensemble's own error"""
    observables: tuple[str, ...] | None = None
    """what to measure (default band_energy)"""
    contact: str | None = None
    """linear (default), hertz, or auto for linear where that is accurate enough"""
    damping: float | None = None
    """contact damping coefficient (default 0)"""
    energy_definition: str | None = None
    """site (default) or bond"""
    opposite_pairs: bool | None = None
    """draw chains in pairs of opposite masses: for means that change with the odd part of the disorder, such as widths"""

    def overrides(self) -> dict[str, Any]:
        """The flags that were given, as nested plain values."""
        return _given(
            self,
            skip=(
                "config", "out", "device", "method", "fit", "model", "window", "constraint", "penalty",
                "bootstrap", "checkpoint_every", "threads", "artifact",
            ),
        )  # fmt: skip


@dataclass(frozen=True)
class Simulate(SceneFlags):
    """Ensemble means of a scene's observables, with standard errors."""

    out: str = "results/simulate"
    """folder for config.toml, results.nc, figure.png and run.json"""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""
    method: str = "auto"
    """how to evolve the chains; auto for the plan's choice"""
    checkpoint_every: float = 5.0
    """seconds between saves of finished realizations in the folder, from which the same command goes on"""
    threads: int | None = None
    """threads of this process (default: all cores, shared by the processes that torchrun starts)"""


@dataclass(frozen=True)
class Calibrate(SceneFlags):
    """A master equation from an ensemble: data, model file, figure and its error."""

    out: str = "results/calibrate"
    """folder for config.toml, transfer.nc, model.safetensors, figure.png and run.json"""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""
    method: str = "auto"
    """how to evolve the chains; auto for the plan's choice"""
    fit: str | None = None
    """analytic, linear, nonlinear, adam or projection (default: the best for the model)"""
    model: str | None = None
    """paper, exact_psi, basis_matrix, swing_in or memory (default: the smallest that reaches the ensemble's own error)"""
    window: tuple[float, float] | None = None
    """first and last time of the short-time fits (default 0.5 2)"""
    constraint: str | None = None
    """adam: exact (default) or penalty"""
    penalty: float | None = None
    """adam: weight of the conservation penalty (default 10)"""
    bootstrap: int | None = None
    """ensembles drawn again for the error bars, 0 for none (default 20, or none where fits take long)"""
    checkpoint_every: float = 5.0
    """seconds between saves of finished realizations in the folder, from which the same command goes on"""
    threads: int | None = None
    """threads of this process (default: all cores, shared by the processes that torchrun starts)"""

    def calibration(self) -> dict[str, Any]:
        """The flags of the fit that were given."""
        given = {name: getattr(self, name) for name in ("model", "window", "constraint", "penalty", "bootstrap")}
        return {k: v for k, v in {"method": self.fit, **given}.items() if v is not None}


@dataclass(frozen=True)
class Predict:
    """Band energies from a calibrated master equation."""

    model: Annotated[str, tyro.conf.Positional]
    """file written by calibrate, or by family"""
    strength: float | None = None
    """disorder at which a family predicts"""
    source: tuple[int, ...] | None = None
    """bands that start with a unit energy, a run of its own each (default: every band)"""
    initial: tuple[float, ...] | None = None
    """energy of every band at the start, in place of --source"""
    times: TimesFlags = field(default_factory=TimesFlags)
    method: str = "expm"
    """expm or a torchdiffeq method"""
    config: str | None = None
    """file (TOML) with the same keys as the flags"""
    seed: int | None = None
    """recorded only: a prediction draws no random number"""
    out: str = "results/predict"
    """folder for config.toml, results.nc, figure.png and run.json"""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""

    def overrides(self) -> dict[str, Any]:
        """The flags that were given, as nested plain values."""
        return _given(self, skip=("model", "config", "out", "device", "method", "seed"))


@dataclass(frozen=True)
class Family:
    """One model file for a range of disorder, from model files of calibrate at several strengths."""

    models: Annotated[tuple[str, ...], tyro.conf.Positional]
    """files written by calibrate, with the model "memory" """
    out: str = "results/family"
    """folder for model.safetensors and run.json"""


@dataclass(frozen=True)
class Plan(SceneFlags):
    """The cheapest way to meet a scene, with reasons and runners-up."""

    artifact: str | None = None
    """a model file of calibrate that could take the place of the chains"""


@dataclass(frozen=True)
class Rerun:
    """Make a run again from its record and compare: exit status 0 if all data are equal to the last bit, 1 if not."""

    folder: Annotated[str, tyro.conf.Positional]
    """folder left by simulate, calibrate or predict"""
    out: str | None = None
    """folder for the new run (default: compared, then discarded)"""
    device: str | None = None
    """cpu, cuda, ... (default: the recorded one)"""
    threads: int | None = None
    """threads of this process"""


COMMANDS: dict[str, Any] = {
    "simulate": Simulate, "calibrate": Calibrate, "predict": Predict, "family": Family, "plan": Plan, "rerun": Rerun,
}  # fmt: skip


def _given(flags: Any, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for entry in dataclasses.fields(flags):
        value = getattr(flags, entry.name)
        if dataclasses.is_dataclass(value):
            value = _given(value) or None
        if value is not None and entry.name not in skip:
            plain[entry.name] = value
    return plain
