"""The torchchain command: typed flags, read before anything heavy is imported."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

DESCRIPTION = """Wave energy in disordered granular chains: exact ensembles, and the master equation calibrated from them.
A flag overrides the config file, the config file overrides the defaults, which are the paper's case."""


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        The exit status: 2 for bad input, 1 for a failed computation or a rerun that differs, 130 for an interrupt
        (Ctrl-C), 143 for the signal to end.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        flags = _parse(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    with _one_line_warnings(), _ends() as ends:
        try:
            from torchchain import commands  # torch and the rest, once the flags are known to be good
            from torchchain.checks import FieldError, FieldTypeError

            try:
                return commands.run(flags, arguments)
            except (FieldError, FieldTypeError) as error:
                return complain(str(error), 2)
            except (RuntimeError, MemoryError) as error:  # a solver that gives up, or no memory left
                return complain(str(error) or type(error).__name__, 1)
        except KeyboardInterrupt as stop:
            status = complain(str(stop) or "interrupted, nothing was written", 143 if ends else 130)
            if any(thread.name.startswith("torchchain") for thread in threading.enumerate()):
                os._exit(status)  # without waiting for the chunks under way, which nobody wants
            return status


@contextlib.contextmanager
def _ends() -> Iterator[list[int]]:
    """The signal to end, as a batch system or torchrun sends it, becomes an interrupt; yields those that came."""
    ends: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield ends
        return

    def end(number: int, _: Any) -> None:
        ends.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield ends
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _one_line_warnings() -> Iterator[None]:
    before = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"torchchain: warning: {' '.join(str(message).split())}\n"
    try:
        yield
    finally:
        warnings.formatwarning = before


def _parse(arguments: list[str]) -> Any:
    """The flags as a record; a mistake is one line on standard error."""
    caught = io.StringIO()
    try:
        with contextlib.redirect_stderr(caught):
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                args=arguments,
                prog="torchchain",
                description=DESCRIPTION,
                config=(tyro.conf.CascadeSubcommandArgs,),
            )
    except SystemExit as stop:
        if stop.code:
            complain(one_line(caught.getvalue()), 2)
        raise


def one_line(report: str) -> str:
    """The parser's boxed report as one line: flag, rule, value."""
    lines = [line.strip("│╭╮╰╯─ ").strip() for line in report.splitlines()]
    text = " ".join(line for line in lines if line.strip("-"))
    text = re.sub(r"\s*(For full helptext|Argument helptext|Got errors).*", "", text)
    value = re.search(r"Error parsing (\S+): .*?no type matching (.*?) could be instantiated from \[(.*?)\]", text)
    if value:
        kind = value[2].replace("{None}|", "").strip("{}")
        return f"{value[1]} must be {kind}, got {value[3]}"
    return text


def complain(message: str, status: int) -> int:
    """Print an error as one line on standard error and hand back the exit status."""
    rank = os.environ.get("RANK", "0")
    print(f"torchchain: {f'rank {rank}: ' if rank != '0' else ''}error: {' '.join(message.split())}", file=sys.stderr)
    return status


def _given(flags: Any, skip: tuple[str, ...] = ()) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for entry in dataclasses.fields(flags):
        value = getattr(flags, entry.name)
        if dataclasses.is_dataclass(value):
            value = _given(value) or None
        if value is not None and entry.name not in skip:
            plain[entry.name] = value
    return plain


if __name__ == "__main__":
    sys.exit(main())
