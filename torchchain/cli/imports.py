"""``torchchain import`` and ``torchchain convert``: runs of other codes."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w
import torch

from torchchain import checks, plots
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.cli import choices, outputs, report
from torchchain.cli.calibrate import run_calibrate
from torchchain.cli.flags import Calibrate, Convert, FileFlags, Import
from torchchain.cli.flags import given as given_flags
from torchchain.energy.bands import check_bands
from torchchain.ensemble.provenance import Provenance
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.transfer import BandTransfer
from torchchain.frames import ContactUnits, Frames, FramesWarning, check_opening, convert, read_frames
from torchchain.frames.opening import matching
from torchchain.frames.order import line_axis
from torchchain.frames.units import LAWS
from torchchain.network import Network
from torchchain.progress import log

BANDS, SHELLS = 32, 4
"""Bands of chains, and shells of |q| of packings, where none are asked for."""
ENDINGS = r"(\.(gz|dump|lammpstrj|lammps|liggghts|data|xyz|extxyz|nc|txt|local|fstat))+$"


@dataclass(frozen=True)
class RunFiles:
    """The files of one run.

    Attributes:
        path: of the run.
        reference: the chain at rest; None for the first frame.
        contacts: file or pattern of contact lists, or None.
    """

    path: Path
    reference: Path | None
    contacts: str | None


def run_import(flags: Import, arguments: list[str]) -> None:
    """Read the runs, average their band energies and leave transfer, figure and record."""
    began, stages = time.time(), Stages()
    checks.choice("figure", flags.figure, choices.FIGURES)
    if flags.format in choices.FIGURES:
        flags = replace(flags, format=None, figure=flags.format)
    _check(flags)
    files = files_of(flags)
    with outputs.run_folder(flags.out) as out, outputs.told_warnings() as warned:
        log.info("reading %d runs", len(files))
        with _each_doubt_once():
            with stages("frames"):
                frames, chains = _chains(flags, files)
            with stages("transfer"):
                transfer = _transfer(flags, files, frames, chains)
        with stages("figure"):
            figure = _figure(transfer)
        runs = [
            {name: str(path) for name, path in (("run", run.path), ("reference", run.reference), ("contacts", run.contacts)) if path}
            for run in files
        ]  # fmt: skip
        assert transfer.provenance is not None
        hashes = {name: value for name, value in transfer.provenance.hashes.items() if name != "energies"}
        config, condition = _config(flags, files), transfer.attributes["start_condition"]
        mixed = "one band each" if condition == 1 else f"mixed, least squares of condition {condition:.3g}"
        starts = f"starts: {mixed}"
        files_left = {"transfer.nc": outputs.dataset(transfer.to_dataset()), **outputs.figures(figure, flags.figure)}
        outputs.leave(
            out, files_left, arguments, config, "cpu", began, stages.seconds, runs=runs, inputs=hashes, summary=transfer.attributes,
            title=transfer.provenance.words, reasons=[*map(str, frames[:1]), starts], warnings=warned,
            measured=report.shares_left(transfer, shown_bands(transfer.n_bands)),
        )  # fmt: skip
    print(transfer)
    print("masses: mean {mass_mean:.5f}, standard deviation {mass_sd:.5f}".format(**transfer.attributes))
    print(starts)
    print(f"{time.time() - began:.1f} s, results in {flags.out}")
    if flags.calibrate is not None:
        after = ["calibrate", "--transfer", flags.out, "--out", flags.calibrate, "--format", flags.figure]
        run_calibrate(Calibrate(transfer=flags.out, out=flags.calibrate, format=flags.figure), after)


@contextmanager
def _each_doubt_once() -> Iterator[None]:
    """What is doubtful in many runs is told of the first, with the number of the others."""
    told: dict[str, list[warnings.WarningMessage]] = {}
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    finally:
        for warning in caught:
            words = str(warning.message)
            field = words.split(": ")[1] if issubclass(warning.category, FramesWarning) else words
            told.setdefault(field, []).append(warning)
        for first, *others in told.values():
            more = f" (and {len(others)} more like this)" if others else ""
            warnings.warn(first.category(f"{first.message}{more}"), stacklevel=2)


def _config(flags: Import, files: list[RunFiles]) -> str:
    """The flags as TOML, by which the import can be made again from any folder."""
    given = {name: value for name, value in given_flags(flags).items() if name not in ("out", "calibrate")}
    for name in ("reference", "contacts", "masses"):
        place = Path(given.get(name, ""))
        if place.parent != Path() or (name == "masses" and place.is_file()):
            given[name] = str(place.absolute())
    return tomli_w.dumps(given | {"runs": [str(run.path) for run in files]})


def run_convert(flags: Convert, arguments: list[str]) -> None:
    """Write the frames of a run into one netCDF file."""
    for name in ("run", "out"):
        if not getattr(flags, name):
            raise checks.fail(name, "be a file", "none")
    outputs.check_writable(Path(flags.out).parent)
    written = convert(flags.run, flags.out, flags.contacts, **_options(flags))
    print(f"{read_frames(written)} in {written}")


def files_of(flags: Import) -> list[RunFiles]:
    """The files of every run, those of a pattern in the order of the numbers in their names; references are no runs.

    Raises:
        FieldError: for a file that is not there, one given twice, or a name with an unknown part in braces.
    """
    if not flags.runs:
        raise checks.fail("runs", "be at least one file or pattern", "none")
    paths: list[Path] = []
    for word in flags.runs:
        if not word:
            raise checks.fail("runs", "match at least one file", repr(word))
        paths += map(Path, matching("runs", word))
    for path in paths:
        if not path.is_file():
            raise checks.fail("runs", "be files", "a folder" if path.is_dir() else f"no file {path}")
    twice = next((path for i, path in enumerate(paths) if path in paths[:i]), None)
    if twice is not None:
        raise checks.fail("runs", "be given once", str(twice))
    references = {path: _reference(flags.reference, path) for path in paths}
    at_rest = {path.resolve() for path in references.values() if path is not None and path.is_file()}
    runs = [path for path in paths if path.resolve() not in at_rest]
    if not runs:
        raise checks.fail("runs", "be others than their references", str(paths[0]))
    found = []
    for path in runs:
        rest, contacts = references[path], None
        if rest is not None and not rest.is_file():
            raise checks.fail("reference", f"be a file beside {path.name}", f"no file {rest}")
        if flags.contacts is not None:
            contacts = str(_beside("contacts", flags.contacts, path.absolute()))
        found.append(RunFiles(path.absolute(), rest if rest is None else rest.absolute(), contacts))
    return found


def _reference(template: str | None, run: Path) -> Path | None:
    """The file that a run's reference is said to be, or the same packed with gzip."""
    if template is None:
        return None
    path = _beside("reference", template, run)
    packed = path.with_name(f"{path.name}.gz")
    return packed if not path.is_file() and packed.is_file() else path


def _beside(field: str, template: str, run: Path) -> Path:
    """The path that a template means for a run, in the run's folder if it names none."""
    stem = re.sub(ENDINGS, "", run.name)
    parts = {"name": run.name, "stem": stem, "group": re.sub(r"[-_.]?\d+$", "", stem)}
    parts |= {str(i): number for i, number in enumerate(re.findall(r"\d+", stem), 1)}
    unknown = [part for part in re.findall(r"{(.*?)}", template) if part not in parts]
    if unknown or not template:
        raise checks.fail(
            field,
            "be a file name that holds no other braces than {name}, {stem}, {group} and {1}, {2}, ... for the numbers in it",
            repr(template),
        )
    name = re.sub(r"{(.*?)}", lambda found: parts[found[1]], template)
    return Path(name) if Path(name).parent != Path() else run.with_name(name)


def _check(flags: Import) -> None:
    """What can be said of the flags before anything is read."""
    if flags.n_bands is not None:
        checks.integer("n_bands", flags.n_bands, 1)
    checks.number("damping", flags.damping, at_least=0.0)
    if flags.largest is not None:
        checks.number("largest", flags.largest, above=0.0)
    checks.choice("contact", flags.contact, LAWS)
    checks.choice("boundary", flags.boundary, ("periodic", "fixed"))
    if flags.boundary == "fixed":
        raise checks.fail("boundary", "be 'periodic' for wavenumber bands", "'fixed'")
    checks.choice("units", flags.units, choices.UNITS)
    checks.choice("long_time", flags.long_time, ("exact", "late"))
    if flags.axis is not None:
        checks.choice("axis", flags.axis, ("x", "y", "z", "all"))
    law = flags.stiffness if isinstance(_stiffness(flags), str) else None
    if flags.calibrate is not None:
        outputs.check_writable(flags.calibrate)
        if Path(flags.calibrate).absolute() == Path(flags.out).absolute():
            raise checks.fail("calibrate", "be another folder than out", repr(flags.calibrate))
    if flags.contacts is None and flags.contact_columns is not None:
        raise checks.fail("contacts", "be given for contact_columns", "none")
    if flags.contacts is None and (law or flags.units in LAWS):
        name, value = ("stiffness", law) if law else ("units", flags.units)
        raise checks.fail("contacts", f"be given for {name} {value}", "none")


def _stiffness(flags: Import) -> float | str:
    if flags.stiffness is None:
        return flags.units if flags.units in LAWS else 1.0
    if flags.stiffness in LAWS:
        return flags.stiffness
    value = _number(flags.stiffness)
    if value is None:
        raise checks.fail("stiffness", "be a number, linear or hertz", repr(flags.stiffness))
    return checks.number("stiffness", value, above=0.0)


def _number(word: str) -> float | None:
    """The number that a word says, or None."""
    try:
        return float(word)
    except ValueError:
        return None


def _options(flags: FileFlags) -> dict[str, Any]:
    """The flags as what :func:`read_frames` takes."""
    names = ("time_step", "masses", "density", "periodic", "contact_columns")
    options = {name: getattr(flags, name) for name in names if getattr(flags, name) is not None}
    masses, columns = options.get("masses"), options.get("contact_columns")
    if masses is not None and _number(masses) is not None:
        options["masses"] = checks.number("masses", _number(masses), above=0.0)
    elif masses is not None and "=" in masses and not Path(masses).is_file():
        options["masses"] = {_whole(kind): _number(mass) for kind, mass in _pairs("masses", masses).items()}
    if columns is not None and "=" in columns:
        options["contact_columns"] = _pairs("contact_columns", columns)
    return {"format": flags.format, **options}


def _pairs(field: str, words: str) -> dict[str, str]:
    """What is before and after each = in words with commas between."""
    pairs = [word.split("=") for word in words.split(",")]
    if any(len(pair) != 2 or not all(pair) for pair in pairs) or len({pair[0] for pair in pairs}) < len(pairs):
        raise checks.fail(field, "read name=value,name=value, each name once", repr(words))
    return dict(pairs)


def _whole(word: str) -> int:
    if not word.isdigit():
        raise checks.fail("masses", "name types by their numbers, as in 1=0.9,2=1.1", repr(word))
    return int(word)


def _chains(flags: Import, files: list[RunFiles]) -> tuple[list[Frames], list[Chain] | list[Network]]:
    """The frames of every run and its chain or network, in the units that are asked for."""
    frames = [read_frames(run.path, run.contacts, **_options(flags)) for run in files]
    units = _units(flags, files, frames)
    if units is not None:
        frames = [each.scaled(units) for each in frames]
    stiffness = _stiffness(flags)
    damping = flags.damping
    if units is not None:
        damping = damping * units.unit("time") / units.unit("mass")
        stiffness = stiffness if isinstance(stiffness, str) else stiffness / units.unit("stiffness")
    if line_axis(frames[0].first, flags.axis) is None:
        how: dict[str, Any] = {"stiffness": stiffness, "contact": flags.contact, "damping": damping}
        return frames, [each.network(run.reference, **how) for run, each in zip(files, frames, strict=True)]
    if flags.contact != "linear":
        raise checks.fail("contact", "be left out for chains, whose bands are of linear contacts", flags.contact)
    if flags.largest is not None:
        raise checks.fail("largest", "be left out for chains, whose bands have equal widths", flags.largest)
    chains = []
    for run, each in zip(files, frames, strict=True):
        chains.append(each.chain(flags.boundary, stiffness, axis=flags.axis, damping=damping, reference=run.reference))
        check_bands(chains[-1].n_particles, _n_bands(flags, chains[-1]))
    return frames, chains


def _n_bands(flags: Import, chain: Chain | Network) -> int:
    if flags.n_bands is not None:
        return flags.n_bands
    return BANDS if isinstance(chain, Chain) else SHELLS * min(2, chain.n_components) + 1


def _units(flags: Import, files: list[RunFiles], frames: list[Frames]) -> ContactUnits | None:
    """Units common to all runs: what is 1 is a mean over all of them."""
    if flags.units == "file":
        return None
    if flags.units in LAWS:
        found = [each.fit_units(flags.units, run.reference) for run, each in zip(files, frames, strict=True)]
        means = (sum(getattr(one, name) for one in found) / len(found) for name in ("mass", "stiffness", "length"))
        return ContactUnits(*means)
    stiffness = _stiffness(flags)
    if isinstance(stiffness, str):
        raise checks.fail("units", f"be '{stiffness}' for a stiffness from contact lists", "'mass'")
    masses = [each.masses for each in frames]
    bare = next((each.name for each, mass in zip(frames, masses, strict=True) if mass is None), None)
    if bare is not None:
        raise checks.fail(f"{bare}: masses", "be in the file or be given by --masses", "none")
    return ContactUnits(float(torch.cat([mass for mass in masses if mass is not None]).mean()), stiffness, 1.0)


def _transfer(
    flags: Import, files: list[RunFiles], frames: list[Frames], chains: list[Chain] | list[Network]
) -> BandTransfer:
    """The band transfer of the runs, one of them in memory at a time."""

    def trajectories() -> Iterator[Trajectory]:
        for run, each, chain in zip(files, frames, chains, strict=True):
            path = each.trajectory(run.reference, axis=flags.axis)
            if isinstance(chain, Chain):
                check_opening(each.name, chain, path)
            yield path

    read = [path for run, each in zip(files, frames, strict=True) for path in (*each.files, run.reference) if path]
    hashes = {str(path): outputs.sha256(path) for path in dict.fromkeys(path.absolute() for path in read)}
    first = frames[0]
    words = f"{len(files)} runs of {chains[0].n_particles} particles, {files[0].path.name}{' ...' if len(files) > 1 else ''}"
    log.info("band energies of %s", first)
    late = "late" if flags.long_time == "late" else None
    try:
        origin, names = Provenance("imported", words, hashes), [run.path.name for run in files]
        n_bands = _n_bands(flags, chains[0])
        return BandTransfer.from_trajectories(chains, trajectories(), n_bands, late, origin, names, flags.largest)
    except checks.FieldError as error:
        if flags.reference is not None or ": total energy" not in str(error):
            raise
        hint = "at rest in its first frame: the chain without a wave is named by --reference"
        raise checks.FieldError(f"{error} ({hint})") from None


def shown_bands(n_bands: int) -> tuple[int, ...]:
    """A low and a high band."""
    return tuple(dict.fromkeys(max(1, round(n_bands * part / 3)) for part in (1, 2)))


def _figure(transfer: BandTransfer) -> Any:
    """Band maps of two sources, and what stays in them and comes to their neighbors."""
    n, shown = transfer.n_bands, shown_bands(transfer.n_bands)
    times, mean, stderr = transfer.times.numpy(), transfer.mean.numpy(), transfer.stderr.numpy()
    with plots.style():
        figure, axes = plots.figure(plots.COLUMN * len(shown), 4.8, 2, len(shown))
        for column, source in enumerate(shown):
            plots.band_map(axes[0, column], times, mean[source - 1], f"source {source}")
            near = dict.fromkeys((source, max(1, source - 1), min(n, source + 1)))
            plots.decays(axes[1, column], times, mean[source - 1], stderr[source - 1], source, list(near), log=False)
        plots.lettered(axes.flat)
    return figure
