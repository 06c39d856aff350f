"""What is wanted: a scene, from Python, a dictionary or a TOML file, checked field by field."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import BOUNDARIES, CONTACTS, Chain
from torchchain.chain.disorder import Disorder
from torchchain.chain.excitation import Impulse, StandingWave
from torchchain.chain.scaling import Scaling
from torchchain.chain.states import State
from torchchain.energy.bands import center_tones, check_bands
from torchchain.ensemble.observables import OBSERVABLES, chosen_observables
from torchchain.ensemble.printed import Printed

EXCITATIONS: dict[str, type[Impulse] | type[StandingWave]] = {"impulse": Impulse, "standing_wave": StandingWave}
LARGEST_CHAIN = 10**8
MOST_TIMES = 10**7
LATEST_TIME = 1e12


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Printed):
    """An ensemble of chains, how they are set in motion, and what is to be measured. The defaults are the paper's.

    Attributes:
        n_particles: N.
        boundary: "periodic" or "fixed".
        disorder: of the masses.
        excitation: Impulse or StandingWave; every tone of a StandingWave is a run of its own.
        times: output times (time,), in travel times of sound over one particle.
        n_bands: B, looked at only where bands are asked for, or tones are left to the bands' centers.
        realizations: chains in the ensemble.
        seed: realization i of it is the same chain in every run.
        tolerance: accuracy wanted for the observables, relative to their scale; None for the ensemble's own error.
        observables: names from ``OBSERVABLES``, see :func:`torchchain.register_observable`.
        stiffness_disorder: of the contact stiffnesses; None for equal contacts.
        contact: "linear", "hertz", or "auto" for linear where the force of a linear contact is within the tolerance.
        damping: contact damping coefficient.
        energy_definition: "site" (Eqs. 36, 42) or "bond" (Eq. A3).
        si: the beads in SI units, for results in seconds and meters; None to stay dimensionless.
        opposite_pairs: draw realizations in pairs of opposite disorder (see :meth:`Disorder.masses`), each pair one
            independent sample. It pays where an observable changes mostly with the odd part of the disorder, as the
            squared width after a kick does, costs up to half more error where it does not, and never biases.

    Raises:
        FieldError, FieldTypeError: one line with the field, the rule and the value.

    Example:
        >>> scene = tc.Scene(n_particles=128, n_bands=16, disorder=tc.Disorder(strength=0.1), times=[0.0, 10.0], realizations=10)
        >>> tuple(scene.chain(range(10)).masses.shape), tuple(scene.times.shape)
        ((10, 128), (2,))
    """

    n_particles: int = 256
    boundary: str = "periodic"
    disorder: Disorder = field(default_factory=Disorder)
    excitation: Impulse | StandingWave = field(default_factory=StandingWave)
    times: Any = field(default_factory=lambda: regular_times(0.0, 50.0, 0.25))
    n_bands: int = 32
    realizations: int = 100
    seed: int = 0
    tolerance: float | None = None
    observables: tuple[str, ...] = ("band_energy",)
    stiffness_disorder: Disorder | None = None
    contact: str = "linear"
    damping: float = 0.0
    energy_definition: str = "site"
    si: Scaling | None = None
    opposite_pairs: bool = False

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        put("n_particles", checks.integer("n_particles", self.n_particles, 2, LARGEST_CHAIN))
        checks.choice("boundary", self.boundary, BOUNDARIES)
        put("realizations", checks.integer("realizations", self.realizations, 1, 10**9))
        put("seed", checks.integer("seed", self.seed, 0, 2**64 - 1))
        put("n_bands", checks.integer("n_bands", self.n_bands, 1))
        for name, kinds, example in _RECORDS:
            value = getattr(self, name)
            if not isinstance(value, kinds) and not (value is None and name in ("stiffness_disorder", "si")):
                words = " or ".join(f"{'an' if kind is Impulse else 'a'} {kind.__name__}" for kind in kinds)
                raise checks.FieldTypeError(f"{name} must be {words}, e.g. {example}, got {checks.shown(value)}")
        put("times", checks.times("times", self.times).to(torch.float64))
        late = self.times > LATEST_TIME
        checks.first_bad("times", f"be at most {LATEST_TIME:g}, where rounding blurs phases", self.times, late)
        if self.tolerance is not None:
            put("tolerance", checks.number("tolerance", self.tolerance, above=0, below=1))
        checks.truth("opposite_pairs", self.opposite_pairs)
        if self.realizations % self.sample_size:
            raise checks.fail("realizations", "be even for opposite_pairs", self.realizations)
        checks.choice("contact", self.contact, (*CONTACTS, "auto"))
        put("damping", checks.number("damping", self.damping, at_least=0))
        checks.choice("energy_definition", self.energy_definition, ("site", "bond"))
        if isinstance(self.observables, str) or not isinstance(self.observables, Sequence) or not self.observables:
            raise checks.FieldTypeError(f"observables must be a list of names, got {checks.shown(self.observables)}")
        put("observables", tuple(checks.choice("observables", name, OBSERVABLES) for name in self.observables))
        if len(set(self.observables)) < len(self.observables):
            raise checks.fail("observables", "be different", self.observables)
        self.excitation.check(self.n_particles)
        if self.needs_bands:
            check_bands(self.n_particles, self.n_bands)
            if isinstance(self.excitation, StandingWave):  # the center tone of the last band can be N/2
                dataclasses.replace(self.excitation, tones=self.tones).check(self.n_particles)
        for entry in chosen_observables(self.observables):
            of = f"for the observable {entry.name}"
            if entry.wavenumbers and self.contact == "hertz":
                raise checks.fail("contact", f"be 'linear' {of}", repr(self.contact))
            if entry.wavenumbers and self.energy_definition == "bond" and self.boundary == "fixed":
                raise checks.fail("boundary", f"be 'periodic' {of} by 'bond'", repr(self.boundary))
            if not entry.damped and self.damping > 0:
                raise checks.fail("damping", f"be zero {of}", self.damping)
        if self.contact == "hertz" and self.energy_definition == "site":
            put("energy_definition", "bond")  # the only one that a Hertz contact has

    def _rows(self) -> dict[str, str]:
        def words(record: Any) -> str:
            plain = {name: value for name, value in _plain(record).items() if not isinstance(value, list)}
            return ", ".join(f"{name} {value}" for name, value in plain.items())

        wave = f"impulse: {words(self.excitation)}"
        if isinstance(self.excitation, StandingWave):
            wave = f"{_listed(self.tones, 'tone', 'tones')} of a standing wave: {words(self.excitation)}"
        contacts = f"{self.contact}, damping {self.damping:g}"
        if self.stiffness_disorder is not None:
            contacts += f", stiffness disorder: {words(self.stiffness_disorder)}"
        pairs = " in opposite pairs" if self.sample_size == 2 else ""
        rows = {
            "chains": f"{self.realizations}{pairs}, {self.boundary}, of {self.n_particles} particles, seed {self.seed}",
            "disorder": words(self.disorder),
            "contacts": contacts,
            "excitation": wave,
            "times": _listed(self.times.tolist(), "time", "times"),
            "observables": ", ".join(self.observables) + (f"; {self.n_bands} bands" if self.needs_bands else ""),
            "energy": f"by '{self.energy_definition}'",
            "tolerance": "the ensemble's own error" if self.tolerance is None else f"{self.tolerance:g}",
        }
        return rows | ({"si": words(self.si)} if self.si is not None else {})

    @property
    def needs_bands(self) -> bool:
        """Whether ``n_bands`` matters: a band observable, or standing waves at the bands' center tones."""
        centers = isinstance(self.excitation, StandingWave) and self.excitation.tones is None
        return centers or any(entry.bands for entry in chosen_observables(self.observables))

    @property
    def is_ordered(self) -> bool:
        """Whether every realization is the same chain."""
        return self.disorder.strength == 0 and (
            self.stiffness_disorder is None or self.stiffness_disorder.strength == 0
        )

    @property
    def distinct_realizations(self) -> int:
        """Chains to compute: one of an ordered scene, however many realizations it asks for."""
        return 1 if self.is_ordered else self.realizations

    @property
    def sample_size(self) -> int:
        """Realizations that make one independent sample: two where they come in opposite pairs."""
        return 2 if self.opposite_pairs and not self.is_ordered else 1

    @property
    def tones(self) -> tuple[int, ...]:
        """The tones of the standing waves, counted from 1; empty for an impulse."""
        if isinstance(self.excitation, Impulse):
            return ()
        return self.excitation.tones or center_tones(self.n_particles, self.n_bands)

    def chain(
        self, realizations: Iterable[int], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> Chain:
        """The chains of the given realizations (counted from 0), masses (realization, particle)."""
        numbers = list(realizations)
        masses = self.disorder.masses(self.n_particles, numbers, self.seed, self.opposite_pairs)
        stiffness: float | Tensor = 1.0
        if self.stiffness_disorder is not None:
            n_contacts = self.n_particles + (self.boundary == "fixed")
            stiffness = self.stiffness_disorder.stiffnesses(n_contacts, numbers, self.seed, self.opposite_pairs).to(
                device, dtype
            )
        return Chain(masses.to(device, dtype), self.boundary, stiffness, self.contact, self.damping)

    def state(self, chain: Chain) -> State:
        """The start of every chain, (realization, particle) or (realization, tone, particle)."""
        if isinstance(self.excitation, Impulse):
            return self.excitation.state(chain)
        return dataclasses.replace(self.excitation, tones=self.tones).state(chain)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as in a scene file; fields that are None are left out."""
        plain: dict[str, Any] = {}
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if entry.name == "times":
                value = _times_table(value)
            elif entry.name == "excitation":
                kind = "impulse" if isinstance(value, Impulse) else "standing_wave"
                value = {"kind": kind, **_plain(value)}
            elif isinstance(value, (Disorder, Scaling)):
                value = _plain(value)
            elif isinstance(value, tuple):
                value = list(value)
            if value is not None:
                plain[entry.name] = value
        return plain

    def to_toml(self) -> str:
        """The scene as the text of a scene file."""
        return tomli_w.dumps(self.to_dict())

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Scene:
        """A scene from the plain values of a scene file; an unknown key is an error.

        The table ``si`` holds the beads (see :class:`Scaling`) and may state ``times`` in seconds, ``velocity`` in
        m/s, ``amplitude`` in meters and ``damping`` in kg/s, in place of the dimensionless fields.
        """
        checks.known_keys("scene", plain, [entry.name for entry in dataclasses.fields(cls)])
        fields = dict(plain)
        if "si" in fields:
            fields = _made_dimensionless(fields)
        for name in ("disorder", "stiffness_disorder"):
            if name in fields:
                fields[name] = _from_table(name, fields[name], Disorder)
        if "excitation" in fields:
            table = _table("excitation", fields["excitation"])
            kind = checks.choice("excitation.kind", table.pop("kind", "standing_wave"), EXCITATIONS)
            fields["excitation"] = _from_table("excitation", table, EXCITATIONS[kind])
        if isinstance(fields.get("times"), Mapping):
            fields["times"] = _times_from_table(fields["times"])
        if isinstance(fields.get("observables"), list):
            fields["observables"] = tuple(fields["observables"])
        return cls(**fields)

    @classmethod
    def from_toml(cls, path: str | Path) -> Scene:
        """A scene from a TOML file whose keys are the fields."""
        return cls.from_dict(read_toml(path))


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
    table = _table("times", value)
    checks.known_keys("times", table, ("start", "stop", "step"))
    for key in ("stop", "step"):
        if key not in table:
            raise checks.fail("times", f"have {key}", dict(table))
    return regular_times(table.get("start", 0.0), table["stop"], table["step"])


def _made_dimensionless(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a scene file whose table ``si`` states some of them in SI units."""
    table = _table("si", fields["si"])
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
            excitation = _table("excitation", fields.get("excitation", {}))
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


def _plain(record: Any) -> dict[str, Any]:
    values = dataclasses.asdict(record)
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items() if v is not None}


def _table(field_name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise checks.FieldTypeError(f"{field_name} must be a table, got {checks.shown(value)}")
    return dict(value)


def _from_table(field_name: str, value: Any, kind: type) -> Any:
    table = _table(field_name, value)
    checks.known_keys(field_name, table, [entry.name for entry in dataclasses.fields(kind)])
    try:
        return kind(**table)
    except (checks.FieldError, checks.FieldTypeError) as error:
        if field_name != "stiffness_disorder":
            raise
        raise type(error)(f"stiffness_{error}") from None  # a Disorder calls itself disorder


_RECORDS: tuple[tuple[str, tuple[type, ...], str], ...] = (
    ("disorder", (Disorder,), "tc.Disorder(strength=0.3)"),
    ("excitation", (Impulse, StandingWave), "tc.Impulse(site=1)"),
    ("stiffness_disorder", (Disorder,), "tc.Disorder(strength=0.3)"),
    ("si", (Scaling,), "tc.Scaling(...)"),
)


def _listed(values: Sequence[float], one: str, many: str) -> str:
    """How many values, and from where to where."""
    if len(values) == 1:
        return f"{one} {values[0]:g}"
    return f"{len(values)} {many} from {values[0]:g} to {values[-1]:g}"


def describe(scene: Scene) -> str:
    """The scene in one line, for titles and logs."""
    wave = (
        f"impulse at particle {scene.excitation.site}"
        if isinstance(scene.excitation, Impulse)
        else f"{len(scene.tones)} standing waves"
    )
    end = np.format_float_positional(float(scene.times[-1]), trim="-")
    pairs = " in opposite pairs" if scene.sample_size == 2 else ""
    return (
        f"{scene.realizations} {scene.boundary} chains{pairs}, N = {scene.n_particles}, xi = {scene.disorder.strength:g}, "
        f"{wave}, {len(scene.times)} times to {end}"
    )
