"""The flags of every command, as typed records; None is a flag that was not given."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

from torchchain.cli import choices


def flag(values: str | tuple[str, ...], default: Any = None, about: str | None = None) -> Any:
    """How help shows a flag: what it takes, a kind of value or its choices, and its default outside the config file."""
    shown = values if isinstance(values, str) else f"{{{','.join(values)}}}"
    hint = "" if default is None else f"(default: {default})"
    return tyro.conf.arg(metavar=shown, help_behavior_hint=hint, help=about)


Figure = Annotated[str, flag(choices.FIGURES, "png", "of the figure, besides PNG")]
Device = Annotated[str, flag("DEVICE", "cpu", "cpu, cuda, cuda:1, ...")]
Threads = Annotated[
    int | None, flag("INT", "all cores, shared by the processes that torchrun starts", "threads of this process")
]
Plugin = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction,
    flag("FILE|MODULE", about="registers observables, methods or models of its own; repeatable"),
]  # fmt: skip
MEASURED = f"what to measure: {', '.join(choices.OBSERVABLES)}, or of a plugin"


@dataclass(frozen=True)
class DisorderFlags:
    """Disorder of the masses."""

    kind: Annotated[str | None, flag(choices.KINDS, "normal")] = None
    """distribution"""
    strength: Annotated[float | None, flag("FLOAT", 0.3)] = None
    """standard deviation xi, in mean masses"""
    lower: Annotated[float | None, flag("FLOAT", 0.05)] = None
    """masses below this are drawn again"""


@dataclass(frozen=True)
class ExcitationFlags:
    """How the chains are set in motion."""

    kind: Annotated[str | None, flag(choices.EXCITATIONS, "standing_wave")] = None
    """a kick, or standing waves"""
    site: Annotated[int | None, flag("INT", 1)] = None
    """impulse: particle, counted from 1"""
    velocity: Annotated[float | None, flag("FLOAT", 0.01)] = None
    """impulse: initial velocity"""
    tones: Annotated[tuple[int, ...] | None, flag("INT ...", "the center tone of every band")] = None
    """standing waves: tones, a run of its own each"""
    amplitude: Annotated[float | None, flag("FLOAT", 0.01)] = None
    """standing waves: amplitude in initial overlaps"""
    phase: Annotated[str | None, flag(("sin", "cos"), "sin")] = None
    """standing waves: phase"""


@dataclass(frozen=True)
class TimesFlags:
    """Output times, in travel times of sound over one particle."""

    start: Annotated[float | None, flag("FLOAT", 0.0)] = None
    """first time"""
    stop: Annotated[float | None, flag("FLOAT", 50.0)] = None
    """last time"""
    step: Annotated[float | None, flag("FLOAT", 0.25)] = None
    """step"""


@dataclass(frozen=True)
class SceneFlags:
    """Flags that describe a scene."""

    config: Annotated[str | None, flag("FILE")] = None
    """scene file (TOML)"""
    n_particles: Annotated[int | None, flag("INT", 256)] = None
    """particles per chain"""
    boundary: Annotated[str | None, flag(choices.LATTICE_BOUNDARIES, "periodic")] = None
    """ring, or chain between two walls; lattices can be free, too"""
    disorder: DisorderFlags = field(default_factory=DisorderFlags)
    excitation: ExcitationFlags = field(default_factory=ExcitationFlags)
    times: TimesFlags = field(default_factory=TimesFlags)
    n_bands: Annotated[int | None, flag("INT", 32)] = None
    """wavenumber bands"""
    realizations: Annotated[int | None, flag("INT", 100)] = None
    """chains in the ensemble"""
    seed: Annotated[int | None, flag("INT", 0)] = None
    """seed of the ensemble"""
    tolerance: Annotated[float | None, flag("FLOAT", "the ensemble's own error")] = None
    """accuracy wanted, relative to the observables' scale"""
    observables: Annotated[tuple[str, ...] | None, flag("NAME ...", "band_energy", MEASURED)] = None
    contact: Annotated[str | None, flag(choices.CONTACTS, "linear")] = None
    """contact law; auto for linear where that is accurate enough"""
    damping: Annotated[float | None, flag("FLOAT", 0.0)] = None
    """contact damping coefficient"""
    energy_definition: Annotated[str | None, flag(choices.DEFINITIONS, "site")] = None
    """energy of a particle"""
    lattice: Annotated[str | None, flag(choices.LATTICES)] = None
    """of springs in one to three dimensions, in place of chains; n_particles follows from its shape"""
    shape: Annotated[tuple[int, ...] | None, flag("INT ...")] = None
    """lattices: particles along each axis"""
    motion: Annotated[str | None, flag(("vector", "scalar"), "vector")] = None
    """lattices: displacements along all directions, or one"""
    removed_bonds: Annotated[float | None, flag("FLOAT", 0.0)] = None
    """lattices: probability that a bond is missing"""
    position_disorder: Annotated[float | None, flag("FLOAT", 0.0)] = None
    """lattices: standard deviation of the coordinates of the particles, in spacings"""
    species: Annotated[tuple[str, ...] | None, flag("'NAME: FIELD=NUMBER, ...' ...")] = None
    """mixtures: mass, stiffness, damping and fraction of each species, or radius, density and modulus"""
    arrangement: Annotated[str | None, flag(choices.ARRANGEMENTS, "random")] = None
    """mixtures: order of the beads"""
    unlike: Annotated[tuple[str, ...] | None, flag("STIFFNESS DAMPING|hertz", "springs in series")] = None
    """mixtures: contacts between species"""
    by_species: Annotated[bool | None, flag(("True", "False"), False)] = None
    """mixtures: energies in bands of each species, n_bands of them in all"""
    opposite_pairs: Annotated[bool | None, flag(("True", "False"), False)] = None
    """draw chains in pairs of opposite masses: for means that change with the odd part of the disorder, such as widths"""
    plugin: Plugin = ()

    def overrides(self) -> dict[str, Any]:
        """The flags of the scene that were given, as nested plain values."""
        return given(self, {entry.name for entry in dataclasses.fields(SceneFlags)} - {"config", "plugin"})


@dataclass(frozen=True)
class RunFlags(SceneFlags):
    """Flags of the commands that run an ensemble."""

    out: Annotated[str, flag("FOLDER")] = "results"
    format: Figure = "png"
    device: Device = "cpu"
    method: Annotated[str, flag(("auto", *choices.METHODS), "auto")] = "auto"
    """how to evolve the chains; auto for the plan's choice"""
    checkpoint_every: Annotated[float, flag("SECONDS", 5.0)] = 5.0
    """seconds between saves of finished realizations in the folder, from which the same command goes on"""
    threads: Threads = None


@dataclass(frozen=True)
class Simulate(RunFlags):
    """Ensemble means of a scene's observables, with standard errors."""

    out: Annotated[str, flag("FOLDER", "results/simulate")] = "results/simulate"
    """for config.toml, results.nc, figure.png, report.html and run.json"""


@dataclass(frozen=True)
class Calibrate(RunFlags):
    """A master equation from an ensemble: data, model file, figure and its error."""

    transfer: Annotated[str | None, flag("FILE|FOLDER")] = None
    """calibrate on this transfer.nc, or the one in this folder, in place of a new ensemble"""
    fit: Annotated[str | None, flag(choices.FITS, "the best for the model")] = None
    """way to fit"""
    model: Annotated[str | None, flag(choices.MODELS, "the smallest that reaches the ensemble's own error")] = None
    """reduced model"""
    window: Annotated[tuple[float, float] | None, flag("FIRST LAST", "0.5 2")] = None
    """times of the short-time fits"""
    constraint: Annotated[str | None, flag(("exact", "penalty"), "exact")] = None
    """adam: how energy is conserved"""
    penalty: Annotated[float | None, flag("FLOAT", 10.0)] = None
    """adam: weight of the conservation penalty"""
    bootstrap: Annotated[int | None, flag("INT", "20, or none where fits take long")] = None
    """ensembles drawn again for the error bars, 0 for none"""
    starts: Annotated[bool | None, flag(("True", "False"), True)] = None
    """also measure kicks and other tones, for a model that takes any start in space; not more than the rest of the ensemble costs"""
    show: Annotated[str | None, flag("INT,INT", "10,23 of 32 bands")] = None
    """source bands of the figure"""
    out: Annotated[str, flag("FOLDER", "results/calibrate")] = "results/calibrate"
    """for config.toml, transfer.nc, model.safetensors, figure.png, report.html and run.json"""
    method: Annotated[str, flag(("auto", "theory", *choices.METHODS), "auto")] = "auto"
    """how to evolve the chains; auto for the plan's choice, theory for band energies without chains"""

    def calibration(self) -> dict[str, Any]:
        """The flags of the fit that were given."""
        found = given(self, ("fit", "model", "window", "constraint", "penalty", "bootstrap", "starts"))
        return {"method" if name == "fit" else name: value for name, value in found.items()}


@dataclass(frozen=True)
class Predict:
    """Band energies from a calibrated master equation."""

    model: Annotated[str, tyro.conf.Positional, flag("FILE|FOLDER")]
    """file written by calibrate or family, or the folder that holds it"""
    strength: Annotated[float | None, flag("FLOAT")] = None
    """disorder at which a family predicts"""
    source: Annotated[tuple[int, ...] | None, flag("INT ...", "every band")] = None
    """bands that start with a unit energy, a run of its own each"""
    initial: Annotated[tuple[float, ...] | None, flag("FLOAT ...")] = None
    """energy of every band at the start, in place of --source"""
    excitation: ExcitationFlags = field(default_factory=ExcitationFlags)
    """a start in space, in place of --source; a config file may also hold displacement and velocity under [state]"""
    times: TimesFlags = field(default_factory=TimesFlags)
    method: Annotated[str, flag(choices.SOLVERS, "expm")] = "expm"
    """matrix exponential, or a method of torchdiffeq"""
    config: Annotated[str | None, flag("FILE")] = None
    """TOML with the same keys as the flags"""
    seed: Annotated[int | None, flag("INT")] = None
    """recorded only: a prediction draws no random number"""
    out: Annotated[str, flag("FOLDER", "results/predict")] = "results/predict"
    """for config.toml, results.nc, figure.png, report.html and run.json"""
    format: Figure = "png"
    device: Device = "cpu"
    plugin: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, flag("FILE|MODULE")] = ()
    """registers models of its own; repeatable"""

    def overrides(self) -> dict[str, Any]:
        """The flags of the request that were given, as nested plain values."""
        return given(self, ("strength", "source", "initial", "times", "excitation"))


@dataclass(frozen=True)
class Family:
    """One model file for a range of disorder, from model files of calibrate at several strengths."""

    models: Annotated[tuple[str, ...], tyro.conf.Positional, flag("FILE|FOLDER ...")]
    """written by calibrate, with the model "memory" """
    out: Annotated[str, flag("FOLDER", "results/family")] = "results/family"
    """for model.safetensors and run.json"""


@dataclass(frozen=True)
class Plan(SceneFlags):
    """The cheapest way to meet a scene, with reasons and runners-up."""

    artifact: Annotated[str | None, flag("FILE|FOLDER")] = None
    """a model file of calibrate, or the folder that holds it, that could take the place of the chains"""


@dataclass(frozen=True)
class Rerun:
    """Make a run again from its record and compare: exit status 0 if all data are equal to the last bit, 1 if not."""

    folder: Annotated[str, tyro.conf.Positional, flag("FOLDER")]
    """left by simulate, calibrate, predict or import"""
    out: Annotated[str | None, flag("FOLDER", "compared, then discarded")] = None
    """for the new run"""
    device: Annotated[str | None, flag("DEVICE", "the recorded one")] = None
    """cpu, cuda, ..."""
    threads: Annotated[int | None, flag("INT", "all cores")] = None
    """threads of this process"""


@dataclass(frozen=True)
class Compare:
    """How two results differ, in units of their standard errors: z-scores, total variation, settings, figure."""

    a: Annotated[str, tyro.conf.Positional, flag("FILE|FOLDER")]
    """results.nc or transfer.nc, or the folder of a run"""
    b: Annotated[str, tyro.conf.Positional, flag("FILE|FOLDER")]
    """the other"""
    out: Annotated[str, flag("FOLDER", "results/compare")] = "results/compare"
    """for figure.png, report.html and run.json"""
    format: Figure = "png"


@dataclass(frozen=True)
class Sweep:
    """The same command at every combination of values of some fields; goes on where it was stopped."""

    command: Annotated[str, tyro.conf.Positional, flag(("simulate", "calibrate"))]
    """what to run"""
    fields: Annotated[tuple[str, ...], tyro.conf.Positional, flag("FIELD=V1,V2 ...")]
    """fields of the scene file and their values, as in disorder.strength=0.1,0.3 n_particles=128,256"""
    config: Annotated[str | None, flag("FILE")] = None
    """scene file (TOML) that holds all other fields"""
    seed: Annotated[int | None, flag("INT", 0)] = None
    """seed of every ensemble"""
    out: Annotated[str, flag("FOLDER", "results/sweep")] = "results/sweep"
    """for sweep.nc, sweep.csv, figure.png, report.html, run.json, and the folder of every run in runs"""
    format: Figure = "png"
    device: Device = "cpu"
    threads: Threads = None
    plugin: Plugin = ()


@dataclass(frozen=True)
class FileFlags:
    """Flags of the commands that read files of other codes."""

    format: Annotated[str | None, flag(choices.FORMATS, "what the file begins with")] = None
    """of the files that are read"""
    time_step: Annotated[float | None, flag("FLOAT")] = None
    """time between two step numbers, for dumps that do not state their times"""
    masses: Annotated[str | None, flag("FLOAT|TYPE=FLOAT,...|FILE")] = None
    """where the files have none: of every particle, of each type, or a MercuryDPM .restart file"""
    density: Annotated[float | None, flag("FLOAT")] = None
    """masses from the radii: of spheres, or of disks in files of two dimensions"""
    periodic: Annotated[str | None, flag("AXES")] = None
    """axes such as x or xy on which the box is periodic, where the files do not say"""
    contact_columns: Annotated[str | None, flag("FIELD=NAME,...|KEYWORDS")] = None
    """of contact lists: LAMMPS, as in id1=c_1[1],id2=c_1[2]; LIGGGHTS, keywords of compute pair/gran/local, as in "id force delta" """


@dataclass(frozen=True)
class Import(FileFlags):
    """A band transfer from chains or packings that another code moved, one run a file: for calibrate --transfer."""

    runs: Annotated[tuple[str, ...], tyro.conf.Positional, flag("FILE|PATTERN ...")] = ()
    """LAMMPS or LIGGGHTS dumps, MercuryDPM .data, extended XYZ, netCDF of convert; plain or gzip"""
    reference: Annotated[str | None, flag("FILE", "the run's first frame")] = None
    """chain at rest: a file, as in "{stem}.reference.dump"; {name}: of the run, {stem}: without endings, {group}: and
    without its last number, {1}: its first number; beside the run where no folder is named"""
    contacts: Annotated[str | None, flag("FILE|PATTERN")] = None
    """contact lists of a run, named like the reference"""
    boundary: Annotated[str, flag(choices.BOUNDARIES, "periodic")] = "periodic"
    """of the chains; wavenumber bands need rings, and packings boxes that are periodic in the file"""
    axis: Annotated[
        str | None, flag(("x", "y", "z", "all"), "the one on which the particles form a line, all if they form none")
    ] = None
    """of the chains; all: a packing"""
    stiffness: Annotated[str | None, flag("FLOAT|LAW", "1, or what the units are from")] = None
    """of the contacts, in the files' units; or linear, hertz: from force and overlap in the contact lists"""
    units: Annotated[str, flag(choices.UNITS, "file")] = "file"
    """file: mean mass and stiffness are 1 already; mass: the mean mass of all runs and --stiffness become 1; linear,
    hertz: so do mean mass, contact stiffness and overlap of the contact lists"""
    contact: Annotated[str, flag(choices.CONTACTS[:2], "linear")] = "linear"
    """packings without contact lists: law of the contacts of overlapping grains"""
    damping: Annotated[float, flag("FLOAT", 0.0)] = 0.0
    """of the contacts, in the files' units: such runs may lose energy, and their infinite-time average is the late one"""
    n_bands: Annotated[int | None, flag("INT", "32; of packings 9 or 5")] = None
    """wavenumber bands; of packings shells of |q| for each polarization, and one for all other motion"""
    largest: Annotated[float | None, flag("FLOAT", "2 over the mean distance of contacts")] = None
    """packings: longest wavevector |q| of the shells"""
    long_time: Annotated[str, flag(("exact", "late"), "exact")] = "exact"
    """infinite-time average: from the modes of linear undamped rings, or over the later half of the times"""
    format: Annotated[str | None, flag((*choices.FORMATS, *choices.FIGURES), "what the files begin with; png")] = None
    """of the files that are read, or of the figure besides PNG"""
    figure: Annotated[str, flag(choices.FIGURES, "png")] = "png"
    """of the figure, where --format names that of the files"""
    calibrate: Annotated[str | None, flag("FOLDER")] = None
    """also calibrate a master equation on the transfer, and leave it with its figure in this folder"""
    out: Annotated[str, flag("FOLDER", "results/import")] = "results/import"
    """for config.toml, transfer.nc, figure.png, report.html and run.json"""


@dataclass(frozen=True)
class Convert(FileFlags):
    """Files of another code as one netCDF file, which is read many times faster than text."""

    run: Annotated[str, tyro.conf.Positional, flag("FILE|PATTERN")] = ""
    """LAMMPS or LIGGGHTS dump, MercuryDPM .data, extended XYZ; plain or gzip; of a pattern all files, one after the other"""
    out: Annotated[str, tyro.conf.Positional, flag("FILE")] = ""
    """netCDF file to be written"""
    contacts: Annotated[str | None, flag("FILE|PATTERN")] = None
    """contact lists"""


COMMANDS: dict[str, Any] = {
    "simulate": Simulate, "calibrate": Calibrate, "predict": Predict, "family": Family, "plan": Plan, "rerun": Rerun,
    "compare": Compare, "sweep": Sweep, "import": Import, "convert": Convert,
}  # fmt: skip


def names(record: Any, prefix: str = "--") -> list[str]:
    """The flags of a command, as they are written."""
    found = []
    for entry in dataclasses.fields(record):
        name = prefix + entry.name.replace("_", "-")
        kind = entry.default_factory
        nested = dataclasses.is_dataclass(kind)
        found += names(kind, f"{name}.") if nested else [name]
    return found


def given(flags: Any, names: Collection[str] | None = None) -> dict[str, Any]:
    """The flags, of these or of all, that were given, as nested plain values."""
    plain: dict[str, Any] = {}
    for entry in dataclasses.fields(flags):
        value = getattr(flags, entry.name)
        if dataclasses.is_dataclass(value):
            value = given(value) or None
        if value is not None and (names is None or entry.name in names):
            plain[entry.name] = value
    return plain
