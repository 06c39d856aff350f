"""What is wanted: a scene, from Python, a dictionary or a TOML file, checked field by field."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

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
from torchchain.energy.bands import band_of, center_tones, check_bands
from torchchain.ensemble.observables import OBSERVABLES, chosen_observables
from torchchain.ensemble.printed import Printed
from torchchain.evolvers import METHODS, Method
from torchchain.network.evolvers import METHODS as NETWORK_METHODS
from torchchain.network.lattices import BOUNDARIES as LATTICE_BOUNDARIES
from torchchain.network.lattices import Lattice
from torchchain.network.random_lattices import RandomLattices
from torchchain.species.energy import species_waves
from torchchain.species.mixtures import MixedChain, Mixture, Species
from torchchain.spelling import suggestion

System = TypeVar("System", Lattice, MixedChain)
EXCITATIONS: dict[str, type[Impulse] | type[StandingWave]] = {"impulse": Impulse, "standing_wave": StandingWave}
LARGEST_CHAIN = 10**8
MOST_TIMES = 10**7
LATEST_TIME = 1e12
OF_LATTICES = {"shape": None, "motion": "vector", "removed_bonds": 0.0, "position_disorder": 0.0}
"""Fields that lattices alone have, with their defaults."""
OF_MIXTURES = {"species": (), "arrangement": "random", "unlike": None, "by_species": False}
"""Fields that mixtures of species alone have, with their defaults."""


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Printed):
    """An ensemble of chains or lattices, how they are set in motion, and what is to be measured.

    The defaults are the paper's. With ``lattice`` the scene is of lattices, and of the fields of chains ``contact`` is
    "linear" and ``si`` None:

    ==================  ===============================================  =================================================
    field               of chains                                        of lattices
    ==================  ===============================================  =================================================
    n_particles         N                                                left out: the product of ``shape``
    boundary            "periodic" or "fixed"                            "periodic", "fixed" or "free"
    n_bands             equal bands of k, a divisor of N/2               equal shells of q times polarizations (even for
                                                                         motion "vector"), the longitudinal ones first
    tones               of standing waves, k = 2 pi tone / N             bands whose plane wave starts: that nearest to the
                                                                         middle of the shell, along its polarization
    Impulse             of one particle                                  the same, along the first axis
    damping             of contacts                                      of bonds
    energy_definition   "site" or "bond"                                 "bond" in space, "site" over wavevectors
    shape, motion,      none                                             see below
    removed_bonds,
    position_disorder
    ==================  ===============================================  =================================================

    With ``species`` the chains are mixtures. By default their bands are those of any chain, of the energy of all beads; with
    ``by_species`` those of every species by itself: ``n_bands`` counts bands of k times species, those of the first species
    first, energies are by "bond" (:func:`torchchain.species.species_band_energy`), and ``tones`` are bands whose wave starts,
    one of velocity on the beads of the species alone.

    >>> import torchchain as tc
    >>> scene = tc.Scene(lattice="triangular", shape=(12, 12), n_bands=8, disorder=tc.Disorder(strength=0.2), times=[0, 5])
    >>> scene.n_particles, tc.simulate(scene)["band_energy"].shape
    (144, (8, 2, 8))

    Attributes:
        n_particles: N; None for 256, or what a lattice's shape holds.
        boundary: "periodic" or "fixed"; of lattices also "free".
        disorder: of the masses.
        excitation: Impulse or StandingWave; every tone of a StandingWave is a run of its own.
        times: output times (time,), in travel times of sound over one particle.
        n_bands: B, looked at only where bands are asked for, or tones are left to the bands' centers; None for 32, and for
            lattices as many of up to 8 shells as all hold a wave to start with.
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
        lattice: "chain", "square", "triangular", "cubic" or "fcc", see :func:`torchchain.lattice`; None for chains.
        shape: particles along each primitive vector of the lattice.
        motion: of lattices, "vector" or "scalar".
        removed_bonds: probability that a bond of the lattice is missing.
        position_disorder: standard deviation of the coordinates of the lattice's particles, in spacings.
        species: of a mixture, each a :class:`torchchain.species.Species` or its table; ``disorder`` is then of the masses
            within each, a factor of mean 1, and ``damping`` that of the species.
        arrangement, unlike: of the species and of contacts between them, see :class:`torchchain.species.Mixture`.
        by_species: whether energies in bands are those of every species.

    Raises:
        FieldError, FieldTypeError: one line with the field, the rule and the value.

    Example:
        >>> scene = tc.Scene(n_particles=128, n_bands=16, disorder=tc.Disorder(strength=0.1), times=[0.0, 10.0], realizations=10)
        >>> tuple(scene.chain(range(10)).masses.shape), tuple(scene.times.shape)
        ((10, 128), (2,))
    """

    n_particles: int = None  # type: ignore[assignment]
    boundary: str = "periodic"
    disorder: Disorder = field(default_factory=Disorder)
    excitation: Impulse | StandingWave = field(default_factory=StandingWave)
    times: Any = field(default_factory=lambda: regular_times(0.0, 50.0, 0.25))
    n_bands: int = None  # type: ignore[assignment]
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
    lattice: str | None = None
    shape: tuple[int, ...] | None = None
    motion: str = "vector"
    removed_bonds: float = 0.0
    position_disorder: float = 0.0
    species: tuple[Species, ...] = ()
    arrangement: str = "random"
    unlike: tuple[float, float] | str | None = None
    by_species: bool = False

    if not TYPE_CHECKING:  # type checkers know the fields

        def __new__(cls, *_: Any, **given: Any) -> Scene:
            """A misspelled field is an error that names the one most likely meant."""
            names = [each.name for each in fields(cls)]
            for name in given:
                if name not in names:
                    raise checks.FieldTypeError(f"a scene has no field {name!r}{suggestion(name, names)}")
            return super().__new__(cls)

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if self.lattice is None:
            self._left_out(OF_LATTICES, "a lattice")
            put("n_particles", 256 if self.n_particles is None else self.n_particles)
            put("n_bands", 32 if self.n_bands is None else self.n_bands)
        else:
            self._check_lattice(put)
        put("n_particles", checks.integer("n_particles", self.n_particles, 2, LARGEST_CHAIN))
        if not isinstance(self.species, (list, tuple)):
            raise checks.FieldTypeError(f"species must be a list of species, got {checks.shown(self.species)}")
        put("species", tuple(Species.of(each) for each in self.species))
        if self.species:
            self._check_mixture(put)
        else:
            self._left_out(OF_MIXTURES, "species")
        checks.choice("boundary", self.boundary, BOUNDARIES if self.lattice is None else LATTICE_BOUNDARIES)
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
        self._check_excitation()
        if self.needs_bands and self.lattices is not None:
            self.lattices.bands(self.n_bands)
        elif self.needs_bands:
            check_bands(self.n_particles, self.bands_each)
            if isinstance(self.excitation, StandingWave) and self.by_species:
                wave = dataclasses.replace(self.excitation, tones=center_tones(self.n_particles, self.bands_each))
                wave.check(self.n_particles)
            elif isinstance(self.excitation, StandingWave):  # the center tone of the last band can be N/2
                dataclasses.replace(self.excitation, tones=self.tones).check(self.n_particles)
        for entry in chosen_observables(self.observables):
            of = f"for the observable {entry.name}"
            own = {self.kind, "mixture"} if self.species else {self.kind}
            if not own & set(entry.kinds):
                several = ", ".join(n for n, o in OBSERVABLES.items() if own & set(o.kinds))
                raise checks.fail("observables", f"be of {self.kind}s ({several})", repr(entry.name))
            if entry.wavenumbers and self.by_species and entry.name != "band_energy":
                raise checks.fail("by_species", f"be False {of}", True)
            if entry.wavenumbers and self.contact == "hertz":
                raise checks.fail("contact", f"be 'linear' {of}", repr(self.contact))
            if entry.wavenumbers and self.energy_definition == "bond" and self.boundary == "fixed" and not self.lattice:
                raise checks.fail("boundary", f"be 'periodic' {of} by 'bond'", repr(self.boundary))
            if not entry.damped and self.largest_damping > 0:
                raise checks.fail("damping", f"be zero {of}", self.largest_damping)
        if (self.contact == "hertz" or self.lattice or self.by_species) and self.energy_definition == "site":
            put("energy_definition", "bond")  # the only one that a Hertz contact has; that of lattices in space

    def _check_lattice(self, put: Callable[[str, Any], None]) -> None:
        """Checks what lattices have of their own, and fills in what follows from it."""
        if isinstance(self.shape, list):
            put("shape", tuple(self.shape))
        if self.shape is None:
            raise checks.fail("shape", "be given for a lattice", None)
        checks.choice("boundary", self.boundary, LATTICE_BOUNDARIES)
        checks.number("damping", self.damping, at_least=0)
        if self.contact == "auto":
            put("contact", "linear")
        if self.contact != "linear":
            raise checks.fail("contact", "be 'linear' for a lattice", repr(self.contact))
        if self.si is not None:
            raise checks.fail("si", "be left out for a lattice", "beads")
        if self.position_disorder and self.opposite_pairs:
            raise checks.fail("opposite_pairs", "be False with position_disorder", self.opposite_pairs)
        checks.instance("disorder", self.disorder, Disorder)
        checks.instance("stiffness_disorder", self.stiffness_disorder, Disorder, type(None))
        lattices = self.lattices
        assert lattices is not None
        n = lattices.n_particles
        if self.n_particles not in (None, n):
            raise checks.fail(
                "n_particles", f"be left out for a lattice of shape {self.shape}, which has {n}", self.n_particles
            )
        put("n_particles", n)
        for name in ("shape", "removed_bonds", "position_disorder"):
            put(name, getattr(lattices, {"position_disorder": "moved"}.get(name, name)))
        if self.n_bands is None:
            put("n_bands", lattices.default_bands)

    def _left_out(self, defaults: dict[str, Any], of: str) -> None:
        """An error for fields of what the scene is not of."""
        for name, default in defaults.items():
            value = getattr(self, name)
            if not (value is default or (isinstance(value, (str, int, float)) and value == default)):
                raise checks.fail(name, f"be left out without {of}", checks.shown(value))

    def _check_mixture(self, put: Callable[[str, Any], None]) -> None:
        """Checks what mixtures have of their own."""
        if isinstance(self.unlike, list):
            put("unlike", tuple(self.unlike))
        mixture = self.mixture
        assert mixture is not None, "of species"
        put("unlike", mixture.unlike)
        if self.lattice is not None:
            raise checks.fail("species", "be left out for a lattice", [each.name for each in self.species])
        for name, wanted in (("damping", 0.0), ("si", None), ("opposite_pairs", False)):
            value = getattr(self, name)
            if value is not wanted and value != wanted:
                rule = "be that of the species" if name == "damping" else "be left out for a mixture"
                raise checks.fail(name, rule, checks.shown(value))
        checks.truth("by_species", self.by_species)
        if not self.by_species:
            return
        if checks.integer("n_bands", self.n_bands, 1) % len(self.species):
            raise checks.fail("n_bands", f"be a multiple of the {len(self.species)} species", self.n_bands)
        for name, needed in (("boundary", "periodic"), ("contact", "linear")):
            if getattr(self, name) != needed:
                raise checks.fail(name, f"be {needed!r} for by_species", repr(getattr(self, name)))

    @cached_property
    def mixture(self) -> Mixture | None:
        """What the beads of the scene are of; None for beads of one kind."""
        return Mixture(self.species, self.arrangement, self.unlike) if self.species else None

    @property
    def bands_each(self) -> int:
        """Bands of k: as many of every species where energies are those of each, else ``n_bands``."""
        return self.n_bands // len(self.species) if self.by_species else self.n_bands

    @property
    def largest_damping(self) -> float:
        """Damping of the contacts, of a mixture the largest; 0 where none is damped."""
        return self.damping if self.mixture is None else self.mixture.largest_damping

    def _check_excitation(self) -> None:
        if (self.lattice is None and not self.by_species) or isinstance(self.excitation, Impulse):
            self.excitation.check(self.n_particles)
            return
        for tone in self.excitation.tones or ():
            checks.integer("excitation.tones", tone, 1, self.n_bands)

    @cached_property
    def lattices(self) -> RandomLattices | None:
        """What the lattices of the scene are drawn from; None for chains."""
        if self.lattice is None or self.shape is None:
            return None
        return RandomLattices(
            self.lattice, self.shape, self.motion, self.boundary, self.disorder, self.stiffness_disorder,
            self.removed_bonds, self.position_disorder, self.damping, self.opposite_pairs,
        )  # fmt: skip

    @property
    def kind(self) -> str:
        """Of system: "chain" or "lattice"."""
        return "chain" if self.lattice is None else "lattice"

    @property
    def methods(self) -> dict[str, Method]:
        """The ways to evolve the scene's systems, by name."""
        return METHODS if self.lattice is None else NETWORK_METHODS

    @property
    def n_components(self) -> int:
        """Displacements per particle."""
        return 1 if self.lattices is None else self.lattices.n_components

    @property
    def site(self) -> int:
        """The particle that an impulse strikes; 1 for other starts."""
        return self.excitation.site if isinstance(self.excitation, Impulse) else 1

    @property
    def lengths(self) -> dict[str, int]:
        """Of the axes that results can have."""
        n = self.n_particles
        found = {"time": len(self.times), "particle": n, "wavenumber": n // 2 + 1, "band": self.n_bands}
        found["species"] = len(self.species)
        return found if self.lattices is None else found | {"ring": len(self.lattices.ring_edges(self.site)) - 1}

    def _rows(self) -> dict[str, str]:
        def words(record: Any) -> str:
            plain = {name: value for name, value in _plain(record).items() if not isinstance(value, list)}
            return ", ".join(f"{name} {value}" for name, value in plain.items())

        wave = f"impulse: {words(self.excitation)}"
        if isinstance(self.excitation, StandingWave):
            wave = f"{_listed(self.tones, 'tone', 'tones')} of a standing wave: {words(self.excitation)}"
        contacts = f"{self.contact}, damping {self.largest_damping:g}"
        size = f"{self.boundary}, of {self.n_particles} particles"
        if self.lattice is not None:
            wave = wave.replace("tone", "band").replace("a standing wave", "plane waves")
            contacts += f", {self.removed_bonds:g} of the bonds removed" if self.removed_bonds else ""
            size = f"{_shape(self)} {self.lattice}, motion '{self.motion}', {self.boundary}"
        if self.species:
            size += f", of {', '.join(each.name for each in self.species)} ({self.arrangement})"
        if self.stiffness_disorder is not None:
            contacts += f", stiffness disorder: {words(self.stiffness_disorder)}"
        pairs = " in opposite pairs" if self.sample_size == 2 else ""
        rows = {
            f"{self.kind}s": f"{self.realizations}{pairs}, {size}, seed {self.seed}",
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
        """Whether every realization is the same chain or lattice."""
        if self.lattices is not None:
            return self.lattices.is_ordered
        if self.mixture is not None and not self.mixture.is_ordered:
            return False
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
        """The tones of the standing waves, counted from 1; of lattices, bands; empty for an impulse."""
        if isinstance(self.excitation, Impulse):
            return ()
        if self.lattice is not None or self.by_species:
            return self.excitation.tones or tuple(range(1, self.n_bands + 1))
        return self.excitation.tones or center_tones(self.n_particles, self.n_bands)

    @property
    def source_bands(self) -> list[int]:
        """The band, counted from 1, that holds each of the tones."""
        if self.lattice is not None or self.by_species:
            return list(self.tones)
        return [band_of(tone, self.n_particles, self.n_bands) for tone in self.tones]

    def chain(
        self, realizations: Iterable[int], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> Chain:
        """The chains of the given realizations (counted from 0), masses (realization, particle).

        Raises:
            FieldError: for a scene of lattices, see :meth:`system`.
        """
        if self.lattice is not None:
            raise checks.fail("lattice", "be None for chains (scene.system gives either)", repr(self.lattice))
        numbers = list(realizations)
        if self.mixture is not None:
            return self._mixed(self.mixture, numbers, device, dtype)
        masses = self.disorder.masses(self.n_particles, numbers, self.seed, self.opposite_pairs)
        stiffness: float | Tensor = 1.0
        if self.stiffness_disorder is not None:
            n_contacts = self.n_particles + (self.boundary == "fixed")
            stiffness = self.stiffness_disorder.stiffnesses(n_contacts, numbers, self.seed, self.opposite_pairs).to(
                device, dtype
            )
        return Chain(masses.to(device, dtype), self.boundary, stiffness, self.contact, self.damping)

    def _mixed(
        self, mixture: Mixture, numbers: list[int], device: torch.device | str, dtype: torch.dtype
    ) -> MixedChain:
        made = mixture.chain(self.n_particles, numbers, self.seed, self.boundary, self.contact, self.disorder)
        if self.stiffness_disorder is not None:
            factor = self.stiffness_disorder.stiffnesses(made.n_contacts, numbers, self.seed)
            made = dataclasses.replace(made, stiffness=made.contact_stiffness * factor)
        return _moved(made, device, dtype)

    def system(
        self, realizations: Iterable[int], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> Chain | Lattice:
        """The chains or lattices of the given realizations (counted from 0), masses (realization, particle)."""
        if self.lattices is None:
            return self.chain(realizations, device, dtype)
        made = self.lattices.draw(list(realizations), self.seed)
        return made if dtype == torch.float64 and torch.device(device).type == "cpu" else _moved(made, device, dtype)

    def state(self, chain: Chain | Lattice) -> State:
        """The start of every system, (realization, particle) or (realization, tone, particle), and component of lattices."""
        if isinstance(chain, Lattice):
            assert self.lattices is not None, "lattices are of a scene of lattices"
            if isinstance(self.excitation, Impulse):
                return self.lattices.kick(chain, self.excitation.site, self.excitation.velocity)
            wave = self.excitation
            return self.lattices.waves(chain, self.n_bands, self.tones, wave.amplitude, wave.phase)
        if isinstance(self.excitation, Impulse):
            return self.excitation.state(chain)
        if self.by_species:
            assert isinstance(chain, MixedChain), "chains of a mixture"
            return species_waves(chain, self.excitation, self.bands_each, self.tones)
        return dataclasses.replace(self.excitation, tones=self.tones).state(chain)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as in a scene file; fields that are None are left out."""
        plain: dict[str, Any] = {}
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if entry.name in ("n_particles", "energy_definition") if self.lattice else entry.name in OF_LATTICES:
                continue  # of a lattice they follow, a chain has them not
            if entry.name in OF_MIXTURES and not self.species:
                continue
            if entry.name == "times":
                value = _times_table(value)
            elif entry.name == "excitation":
                kind = "impulse" if isinstance(value, Impulse) else "standing_wave"
                value = {"kind": kind, **_plain(value)}
            elif isinstance(value, (Disorder, Scaling)):
                value = _plain(value)
            elif isinstance(value, tuple):
                value = [_plain(each) if isinstance(each, Species) else each for each in value]
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
            table = _table("excitation", fields["excitation"])
            kind = checks.choice("excitation.kind", table.pop("kind", "standing_wave"), EXCITATIONS)
            fields["excitation"] = _from_table("excitation", table, EXCITATIONS[kind])
        if isinstance(fields.get("times"), Mapping):
            fields["times"] = _times_from_table(fields["times"])
        for name in ("observables", "shape"):
            if isinstance(fields.get(name), list):
                fields[name] = tuple(fields[name])
        if isinstance(fields.get("unlike"), Sequence) and not isinstance(fields["unlike"], str):
            fields["unlike"] = _unlike(fields["unlike"])
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


def _shape(scene: Scene) -> str:
    return " x ".join(map(str, scene.shape or ()))


def _unlike(given: Sequence[Any]) -> Any:
    """The contacts between species of a scene file, or the words of a flag: two numbers, or the name of a law."""
    if len(given) == 1:
        return given[0]
    try:
        return tuple(float(each) if isinstance(each, str) else each for each in given)
    except ValueError:
        raise checks.fail("unlike", "be a stiffness and a damping, or 'hertz'", list(given)) from None


def _moved(network: System, device: torch.device | str, dtype: torch.dtype) -> System:
    """The lattices or chains on another device, in another precision."""
    values: dict[str, Any] = {
        entry.name: value.to(device, dtype if value.is_floating_point() else None)
        for entry in dataclasses.fields(network)
        if entry.init and isinstance(value := getattr(network, entry.name), Tensor)
    }
    return dataclasses.replace(network, **values)


def describe(scene: Scene) -> str:
    """The scene in one line, for titles and logs."""
    wave = (
        f"impulse at particle {scene.excitation.site}"
        if isinstance(scene.excitation, Impulse)
        else f"{len(scene.tones)} standing waves"
    )
    end = np.format_float_positional(float(scene.times[-1]), trim="-")
    pairs = " in opposite pairs" if scene.sample_size == 2 else ""
    what = f"{scene.boundary} chains{pairs}, N = {scene.n_particles}"
    if scene.species:
        what += f" of {' and '.join(each.name for each in scene.species)}"
    if scene.lattice is not None:
        wave = wave.replace("standing", "plane")
        what = f"{scene.boundary} {scene.lattice} lattices{pairs}, {_shape(scene)}, {scene.motion}"
    return f"{scene.realizations} {what}, xi = {scene.disorder.strength:g}, {wave}, {len(scene.times)} times to {end}"
