"""What is wanted: a scene, from Python, a dictionary or a TOML file, checked field by field."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import tomli_w
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import BOUNDARIES, CONTACTS, Chain
from torchchain.chain.disorder import LARGEST_CHAIN, Disorder
from torchchain.chain.excitation import Impulse, StandingWave
from torchchain.chain.scaling import Scaling
from torchchain.chain.states import State
from torchchain.energy.bands import band_of, center_tones, check_bands
from torchchain.ensemble.observables import OBSERVABLES, chosen_observables
from torchchain.ensemble.printed import Printed
from torchchain.ensemble.scene_checks import (
    check_excitation,
    check_lattice,
    check_mixture,
    check_observables,
    check_records,
    left_out,
)
from torchchain.ensemble.scene_file import OF_LATTICES, OF_MIXTURES, TIMES, dict_of, fields_of, read_toml, regular_times
from torchchain.ensemble.scene_words import rows_of
from torchchain.evolvers import METHODS, Method
from torchchain.network.evolvers import METHODS as NETWORK_METHODS
from torchchain.network.lattices import BOUNDARIES as LATTICE_BOUNDARIES
from torchchain.network.lattices import Lattice
from torchchain.network.random_lattices import RandomLattices
from torchchain.species.energy import species_waves
from torchchain.species.mixtures import MixedChain, Mixture, Species
from torchchain.threads import kept_property

System = TypeVar("System", bound=Chain | Lattice)
LATEST_TIME = 1e12  # travel times of sound over one particle


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Printed, checks.Fields):
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
    times: Any = field(default_factory=lambda: regular_times(**TIMES))
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

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if self.lattice is None:
            left_out(self, OF_LATTICES, "a lattice")
            put("n_particles", 256 if self.n_particles is None else self.n_particles)
            put("n_bands", 32 if self.n_bands is None else self.n_bands)
        else:
            check_lattice(self, put)
        put("n_particles", checks.integer("n_particles", self.n_particles, 2, LARGEST_CHAIN))
        if not isinstance(self.species, (list, tuple)):
            raise checks.FieldTypeError(f"species must be a list of species, got {checks.shown(self.species)}")
        put("species", tuple(Species.of(each) for each in self.species))
        if self.species:
            check_mixture(self, put)
        else:
            left_out(self, OF_MIXTURES, "species")
        checks.choice("boundary", self.boundary, BOUNDARIES if self.lattice is None else LATTICE_BOUNDARIES)
        put("realizations", checks.integer("realizations", self.realizations, 1, 10**9))
        put("seed", checks.integer("seed", self.seed, 0, 2**64 - 1))
        put("n_bands", checks.integer("n_bands", self.n_bands, 1))
        check_records(self)
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
        check_excitation(self)
        if self.needs_bands and self.lattices is not None:
            self.lattices.bands(self.n_bands)
        elif self.needs_bands:
            check_bands(self.n_particles, self.bands_each)
            if isinstance(self.excitation, StandingWave) and self.by_species:
                wave = dataclasses.replace(self.excitation, tones=center_tones(self.n_particles, self.bands_each))
                wave.check(self.n_particles)
            elif isinstance(self.excitation, StandingWave):  # the center tone of the last band can be N/2
                dataclasses.replace(self.excitation, tones=self.tones).check(self.n_particles)
        check_observables(self)
        if (self.contact == "hertz" or self.lattice or self.by_species) and self.energy_definition == "site":
            put("energy_definition", "bond")  # the only one that a Hertz contact has; that of lattices in space

    @kept_property
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

    @kept_property
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
        return rows_of(self)

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
        numbers, n = list(realizations), self.n_particles
        factor: float | Tensor = 1.0
        if self.stiffness_disorder is not None:
            n_contacts = n + (self.boundary == "fixed")
            factor = self.stiffness_disorder.stiffnesses(n_contacts, numbers, self.seed, self.opposite_pairs)
        if self.mixture is not None:
            mixed = self.mixture.chain(n, numbers, self.seed, self.boundary, self.contact, self.disorder)
            return _moved(dataclasses.replace(mixed, stiffness=mixed.contact_stiffness * factor), device, dtype)
        masses = self.disorder.masses(n, numbers, self.seed, self.opposite_pairs)
        return _moved(Chain(masses, self.boundary, factor, self.contact, self.damping), device, dtype)

    def system(
        self, realizations: Iterable[int], device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64
    ) -> Chain | Lattice:
        """The chains or lattices of the given realizations (counted from 0), masses (realization, particle)."""
        if self.lattices is None:
            return self.chain(realizations, device, dtype)
        return _moved(self.lattices.draw(list(realizations), self.seed), device, dtype)

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
        return dict_of(self)

    def to_toml(self) -> str:
        """The scene as the text of a scene file."""
        return tomli_w.dumps(self.to_dict())

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Scene:
        """A scene from the plain values of a scene file; an unknown key is an error.

        The table ``si`` holds the beads (see :class:`Scaling`) and may state ``times`` in seconds, ``velocity`` in
        m/s, ``amplitude`` in meters and ``damping`` in kg/s, in place of the dimensionless fields.
        """
        return cls(**fields_of(plain, [entry.name for entry in dataclasses.fields(cls)]))

    @classmethod
    def from_toml(cls, path: str | Path) -> Scene:
        """A scene from a TOML file whose keys are the fields."""
        return cls.from_dict(read_toml(path))


def _moved(network: System, device: torch.device | str, dtype: torch.dtype) -> System:
    """The lattices or chains, made on the CPU in float64, on the device in the precision."""
    if dtype == torch.float64 and torch.device(device).type == "cpu":
        return network
    values: dict[str, Any] = {
        entry.name: value.to(device, dtype if value.is_floating_point() else None)
        for entry in dataclasses.fields(network)
        if entry.init and isinstance(value := getattr(network, entry.name), Tensor)
    }
    return dataclasses.replace(network, **values)
