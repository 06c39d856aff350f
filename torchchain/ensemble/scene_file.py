"""The plain values of a scene file, and back: tables of TOML, SI units, regular times."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.disorder import Disorder
from torchchain.chain.excitation import Impulse, StandingWave
from torchchain.chain.scaling import Scaling
from torchchain.species.mixtures import Species

if TYPE_CHECKING:
    from torchchain.ensemble.scene import Scene

EXCITATIONS: dict[str, type[Impulse] | type[StandingWave]] = {"impulse": Impulse, "standing_wave": StandingWave}
MOST_TIMES = 10**7
TIMES = {"start": 0.0, "stop": 50.0, "step": 0.25}
"""Of a scene that names none, and what a table of times that a flag begins leaves out."""
WITHIN = (
    *(f"disorder.{entry.name}" for entry in dataclasses.fields(Disorder)),
    *(f"excitation.{entry.name}" for kind in EXCITATIONS.values() for entry in dataclasses.fields(kind)),
    *(f"times.{name}" for name in TIMES),
)
"""Fields of the tables of a scene file."""
OF_LATTICES = {"shape": None, "motion": "vector", "removed_bonds": 0.0, "position_disorder": 0.0}
"""Fields that lattices alone have, with their defaults."""
OF_MIXTURES = {"species": (), "arrangement": "random", "unlike": None, "by_species": False}
"""Fields that mixtures of species alone have, with their defaults."""


def dict_of(scene: Scene) -> dict[str, Any]:
    """Plain values, as in a scene file; fields that are None are left out."""
    plain: dict[str, Any] = {}
    for entry in dataclasses.fields(scene):
        value = getattr(scene, entry.name)
        if entry.name in ("n_particles", "energy_definition") if scene.lattice else entry.name in OF_LATTICES:
            continue  # of a lattice they follow, a chain has them not
        if entry.name in OF_MIXTURES and not scene.species:
            continue
        if entry.name == "times":
            value = _times_table(value)
        elif entry.name == "excitation":
            kind = "impulse" if isinstance(value, Impulse) else "standing_wave"
            value = {"kind": kind, **plain_of(value)}
        elif isinstance(value, (Disorder, Scaling)):
            value = plain_of(value)
        elif isinstance(value, tuple):
            value = [plain_of(each) if isinstance(each, Species) else each for each in value]
        if value is not None:
            plain[entry.name] = value
    return plain


def fields_of(plain: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The fields of a scene from the plain values of a scene file, whose keys are among ``names``."""
    checks.known_keys("scene", plain, names, WITHIN)
    for name in ("n_particles", "n_bands"):
        if name in plain and plain[name] is None:
            raise checks.FieldTypeError(f"{name} must be an integer, got None")
    fields = dict(plain)
    if "si" in fields:
        fields = _made_dimensionless(fields)
    for name in ("disorder", "stiffness_disorder"):
        if name in fields:
            fields[name] = _from_table(name, fields[name], Disorder)
    if "excitation" in fields:
        table = checks.table("excitation", fields["excitation"])
        kind = checks.choice("excitation.kind", table.pop("kind", "standing_wave"), EXCITATIONS)
        owner = {entry.name: other for other, record in EXCITATIONS.items() for entry in dataclasses.fields(record)}
        for name in table:
            if owner.get(name, kind) != kind:
                raise checks.fail("excitation.kind", f"be {owner[name]!r} for excitation.{name}", repr(kind))
        fields["excitation"] = _from_table("excitation", table, EXCITATIONS[kind])
    if isinstance(fields.get("times"), Mapping):
        fields["times"] = _times_from_table(fields["times"])
    for name in ("observables", "shape"):
        if isinstance(fields.get(name), list):
            fields[name] = tuple(fields[name])
    if isinstance(fields.get("unlike"), Sequence) and not isinstance(fields["unlike"], str):
        fields["unlike"] = _unlike(fields["unlike"])
    return fields


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file; every failure is one line that names the file."""
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except (ValueError, RecursionError) as error:  # broken syntax or encoding, an endless number, bottomless nesting
        raise checks.fail(f"config {path}", "be a TOML file", f"{error}") from None
    except OSError as error:
        raise checks.fail(f"config {path}", "be a readable file", f"{error.strerror or error}") from None


def regular_times(start: float, stop: float, step: float) -> Tensor:
    """start, start + step, ... up to and including stop (within rounding), (time,) float64."""
    start = checks.number("times.start", start, at_least=0)
    stop = checks.number("times.stop", stop, at_least=start)
    step = checks.number("times.step", step, above=0)
    count = (stop - start) / step * (1 + 1e-12) + 1e-9
    if count >= MOST_TIMES:
        raise checks.fail("times.step", f"give fewer than {MOST_TIMES} times", step)
    return start + step * torch.arange(int(count) + 1, dtype=torch.float64)


def _times_from_table(value: Any) -> Tensor:
    table = checks.table("times", value)
    checks.known_keys("times", table, ("start", "stop", "step"))
    for key in ("stop", "step"):
        if key not in table:
            raise checks.fail("times", f"have {key}", dict(table))
    return regular_times(table.get("start", 0.0), table["stop"], table["step"])


def _made_dimensionless(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a scene file whose table ``si`` states some of them in SI units."""
    table = checks.table("si", fields["si"])
    given = {name: table.pop(name) for name in ("times", "velocity", "amplitude", "damping") if name in table}
    missing = [entry.name for entry in dataclasses.fields(Scaling) if entry.name not in table]
    if missing:
        raise checks.fail("si", f"have {', '.join(missing)}", table)
    scaling = _from_table("si", table, Scaling)
    fields = {**fields, "si": scaling}
    if "times" in given:
        times = given["times"]
        times = _times_from_table(times) if isinstance(times, Mapping) else checks.times("si.times", times)
        _only_once("times", fields)
        fields["times"] = scaling.from_si("time", times)
    if "damping" in given:
        _only_once("damping", fields)
        fields["damping"] = scaling.from_si("damping", checks.number("si.damping", given["damping"], at_least=0))
    for name, quantity in (("velocity", "velocity"), ("amplitude", "length")):
        if name in given:
            excitation = checks.table("excitation", fields.get("excitation", {}))
            _only_once(name, excitation)
            excitation[name] = scaling.from_si(quantity, checks.number(f"si.{name}", given[name]))
            fields["excitation"] = excitation
    return fields


def _only_once(name: str, fields: Mapping[str, Any]) -> None:
    if name in fields:
        raise checks.fail(name, f"be given once, here or as si.{name}", fields[name])


def _times_table(times: Tensor) -> Any:
    """A regular grid as its table, other times as a list."""
    if len(times) > 2:
        start, step = float(times[0]), float(times[1] - times[0])
        stop = float(times[-1])
        if stop / step < MOST_TIMES and torch.equal(regular_times(start, stop, step), times):
            return {"start": start, "stop": stop, "step": step}
    return times.tolist()


def plain_of(record: Any) -> dict[str, Any]:
    """The fields of a record that are not None, tuples as lists."""
    values = dataclasses.asdict(record)
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items() if v is not None}


def _from_table(field_name: str, value: Any, kind: type) -> Any:
    table = checks.table(field_name, value)
    checks.known_keys(field_name, table, [entry.name for entry in dataclasses.fields(kind)])
    try:
        return kind(**table)
    except (checks.FieldError, checks.FieldTypeError) as error:
        if field_name != "stiffness_disorder":
            raise
        raise type(error)(f"stiffness_{error}") from None  # a Disorder calls itself disorder


def _unlike(given: Sequence[Any]) -> Any:
    """The contacts between species of a scene file, or the words of a flag: two numbers, or the name of a law."""
    if len(given) == 1:
        return given[0]
    try:
        return tuple(float(each) if isinstance(each, str) else each for each in given)
    except ValueError:
        raise checks.fail("unlike", "be a stiffness and a damping, or 'hertz'", list(given)) from None
