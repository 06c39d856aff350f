"""Mixtures of species: soft and stiff, light and heavy, in random order, alternating or in blocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.disorder import Disorder, numbers_of, uniform

ARRANGEMENTS = ("random", "alternating", "blocks")
_SPECIES = 3  # a random stream of a realization beside those of masses, stiffnesses and phases


@dataclass(frozen=True)
class Species(checks.Fields):
    """Beads of one kind.

    With a radius, mass and stiffness are those of an elastic sphere in units of a reference bead: the mass is
    density * radius^3, and the stiffness of two alike that one static force F holds together by Hertz's law,
    k = 2 (3 F / 4)^(1/3) E*^(2/3) R^(1/3) with 1 / E* = 1 / E_a + 1 / E_b, 1 / R = 1 / r_a + 1 / r_b (K. L. Johnson, Contact
    Mechanics, 1985, Sec. 4.2), is (modulus^2 * radius)^(1/3).

    Attributes:
        name: for axes and legends.
        mass: in units of the mean mass of the chain's scaling; 1 or what the radius makes it.
        stiffness: of the contact of two such beads; 1 or what the radius makes it.
        damping: of the contact of two such beads.
        fraction: share of the beads, of a random mixture or one in blocks.
        radius, density, modulus: over those of the reference bead; the modulus is E / (1 - nu^2).

    Example:
        >>> tc.species.Species("soft", stiffness=0.2, damping=0.05, fraction=0.3).stiffness
        0.2
        >>> large = tc.species.Species("large", radius=2.0)
        >>> large.mass, round(large.stiffness, 4)
        (8.0, 1.2599)
    """

    name: str
    mass: float = None  # type: ignore[assignment]
    stiffness: float = None  # type: ignore[assignment]
    damping: float = 0.0
    fraction: float = 0.5
    radius: float | None = None
    density: float | None = None
    modulus: float | None = None

    def __post_init__(self) -> None:
        checks.instance("species.name", self.name, str)
        for field in ("radius", "density", "modulus"):
            value = getattr(self, field)
            if value is None and self.radius is not None:
                value = 1.0
            if value is not None:
                object.__setattr__(self, field, checks.number(f"species.{field}", value, above=0))
            if value is not None and self.radius is None:
                raise checks.fail(f"species.{field}", "be left out without a radius", value)
        made = {"mass": 1.0, "stiffness": 1.0}
        if self.radius is not None and self.density is not None and self.modulus is not None:
            made = {
                "mass": self.density * self.radius**3, "stiffness": hertz_stiffness(self, self)
            }  # fmt: skip
        for field, default in made.items():
            value = getattr(self, field)
            value = default if value is None else checks.number(f"species.{field}", value, above=0)
            if self.radius is not None and abs(value - default) > 1e-12 * default:
                raise checks.fail(f"species.{field}", f"be left out with a radius, which makes it {default:g}", value)
            object.__setattr__(self, field, value)
        object.__setattr__(self, "damping", checks.number("species.damping", self.damping, at_least=0))
        object.__setattr__(self, "fraction", checks.number("species.fraction", self.fraction, above=0, at_most=1))

    @classmethod
    def of(cls, plain: Any) -> Species:
        """From the table of a scene file, or the words of a flag, "soft: stiffness=0.2, damping=0.05".

        Example:
            >>> tc.species.Species.of("soft: stiffness=0.2, fraction=0.3").fraction
            0.3
        """
        if isinstance(plain, Species):
            return plain
        if isinstance(plain, str):
            name, _, rest = plain.partition(":")
            if "=" in name:
                raise checks.fail("species", "be 'NAME: FIELD=NUMBER, ...'", repr(plain))
            table: dict[str, Any] = {"name": name.strip()}
            for word in filter(None, (part.strip() for part in rest.split(","))):
                key, _, value = (part.strip() for part in word.partition("="))
                try:
                    table[key] = float(value)
                except ValueError:
                    raise checks.fail("species", "be 'NAME: FIELD=NUMBER, ...'", repr(plain)) from None
            plain = table
        if not isinstance(plain, Mapping):
            raise checks.FieldTypeError(f"species must be a table, got {checks.shown(plain)}")
        checks.known_keys("species", plain, [entry.name for entry in fields(cls)])
        if "name" not in plain:
            raise checks.fail("species", "have a name each", dict(plain))
        return cls(**plain)


def hertz_stiffness(one: Species, other: Species) -> float:
    """Stiffness of the contact of two spheres under the static force of the reference contact, over that one's.

    Raises:
        FieldError: for species without a radius.

    Example:
        >>> small, large = tc.species.Species("small", radius=1.0), tc.species.Species("large", radius=2.0)
        >>> round(tc.species.hertz_stiffness(small, large), 4)
        1.1006
    """
    for each in (one, other):
        if each.radius is None:
            raise checks.fail("species.radius", "be given for contacts by Hertz's law", f"none of {each.name!r}")
    radius = _mean(one.radius, other.radius)
    return (_mean(one.modulus, other.modulus) ** 2 * radius) ** (1 / 3)


def _mean(a: float | None, b: float | None) -> float:
    """Harmonic, as of springs in series."""
    assert a is not None
    assert b is not None
    return 2 * a * b / (a + b)


@dataclass(frozen=True, eq=False)
class MixedChain(Chain):
    """Chains whose beads are of several species.

    Attributes:
        labels: species of every bead, counted from 0, (*batch, particle).

    Example:
        >>> pair = tc.species.Species("a"), tc.species.Species("b", mass=2.0)
        >>> tc.species.Mixture(pair, "alternating").chain(4, 1, seed=0).labels.tolist()
        [[0, 1, 0, 1]]
    """

    labels: Tensor | None = None


@dataclass(frozen=True)
class Mixture:
    """Chains of several species.

    The contact of unlike beads a and b has the stiffness 2 / (1 / k_a + 1 / k_b), that of half of each contact in series,
    and the damping of two such dashpots, 2 / (1 / c_a + 1 / c_b) and 0 where either is 0; or what ``unlike`` says. Walls are
    of the species that touches them. Hertz contacts all begin at the overlap 1, whatever their stiffness.

    Attributes:
        species: at least one; their order is that of labels.
        arrangement: "random", each bead by itself by the fractions; "alternating", one of each in turn; "blocks", all of
            the first, then all of the second, ...
        unlike: (stiffness, damping) of every contact between unlike beads; "hertz" for the stiffness of spheres of their
            radii and moduli (:func:`hertz_stiffness`); None for the series rule.

    Example:
        >>> mixture = tc.species.Mixture((tc.species.Species("light", mass=0.5), tc.species.Species("heavy", mass=1.5)), "alternating")
        >>> mixture.chain(6, realizations=1, seed=0).masses.tolist()
        [[0.5, 1.5, 0.5, 1.5, 0.5, 1.5]]
    """

    species: tuple[Species, ...]
    arrangement: str = "random"
    unlike: tuple[float, float] | str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.species, Species) or not isinstance(self.species, Sequence) or not self.species:
            raise checks.FieldTypeError(f"species must be a sequence of Species, got {checks.shown(self.species)}")
        for entry in self.species:
            checks.instance("species", entry, Species)
        object.__setattr__(self, "species", tuple(self.species))
        names = [entry.name for entry in self.species]
        if len(set(names)) < len(names):
            raise checks.fail("species", "have different names", names)
        checks.choice("arrangement", self.arrangement, ARRANGEMENTS)
        total = sum(entry.fraction for entry in self.species)
        if self.arrangement != "alternating" and abs(total - 1) > 1e-9:
            raise checks.fail("species.fraction", "sum up to 1", total)
        if isinstance(self.unlike, str):
            checks.choice("unlike", self.unlike, ("hertz",))
            for entry in self.species:
                hertz_stiffness(entry, entry)
        elif self.unlike is not None:
            if not isinstance(self.unlike, Sequence) or len(self.unlike) != 2:
                raise checks.FieldTypeError(f"unlike must be (stiffness, damping), got {checks.shown(self.unlike)}")
            stiffness = checks.number("unlike stiffness", self.unlike[0], above=0)
            object.__setattr__(self, "unlike", (stiffness, checks.number("unlike damping", self.unlike[1], at_least=0)))

    @property
    def largest_damping(self) -> float:
        """Of any contact; 0 where none is damped."""
        given = self.unlike[1] if isinstance(self.unlike, tuple) and len(self.species) > 1 else 0.0
        return max(given, *(entry.damping for entry in self.species))

    @property
    def fastest(self) -> float:
        """Particles per unit time that no wave exceeds: the stiffest contact with the lightest bead."""
        given = self.unlike[0] if isinstance(self.unlike, tuple) else 0.0
        stiffness = max(given, *(entry.stiffness for entry in self.species))
        return (stiffness / min(entry.mass for entry in self.species)) ** 0.5

    @property
    def spread(self) -> float:
        """Standard deviation of masses or stiffnesses over their mean, whichever is larger, if beads come in random order."""
        if self.is_ordered:
            return 0.0
        found, weights = 0.0, self._of("fraction")
        for values in (self._of("mass"), self._of("stiffness")):
            mean = (weights * values).sum()
            found = max(found, float((weights * (values - mean).square()).sum().sqrt() / mean))
        return found

    @property
    def is_ordered(self) -> bool:
        """Whether the order of the beads is the same in every realization."""
        return self.arrangement != "random" or len(self.species) == 1

    def labels(self, n_particles: int, realizations: int | Iterable[int], seed: int) -> Tensor:
        """The species of every bead, counted from 0, (realization, particle).

        Realization i of a seed depends on (seed, i) alone, and a longer random chain begins like a shorter one.
        """
        n = checks.integer("n_particles", n_particles, 2)
        seed = checks.integer("seed", seed, 0, 2**64 - 1)
        numbers = numbers_of(realizations)
        edges = np.cumsum([entry.fraction for entry in self.species])[:-1]
        if self.arrangement == "random":
            draws = np.stack([uniform(n, i, seed, _SPECIES) for i in numbers])
            return torch.from_numpy(np.searchsorted(edges, draws, side="right"))
        places = np.arange(n)
        row = places % len(self.species)
        if self.arrangement == "blocks":
            row = np.searchsorted(np.round(edges * n), places, side="right")
        return torch.from_numpy(np.broadcast_to(row, (len(numbers), n)).copy())

    def chain(
        self,
        n_particles: int,
        realizations: int | Iterable[int],
        seed: int,
        boundary: str = "periodic",
        contact: str = "linear",
        disorder: Disorder | None = None,
    ) -> MixedChain:
        """Chains of the mixture, masses (realization, particle), with the labels of their beads.

        Args:
            n_particles: N.
            realizations: how many, or the realization numbers themselves, counted from 0.
            seed: of the order and of the masses.
            boundary, contact: see :class:`Chain`.
            disorder: of the masses within every species, a factor of mean 1; None for beads of equal mass.
        """
        if checks.is_collection(realizations):
            realizations = list(realizations)
        labels = self.labels(n_particles, realizations, seed)
        masses = self._of("mass")[labels]
        if disorder is not None:
            checks.instance("disorder", disorder, Disorder)
            masses = masses * disorder.masses(n_particles, realizations, seed)
        fixed = boundary == "fixed"
        left = torch.cat([labels[:, :1], labels], dim=1) if fixed else labels.roll(1, 1)
        right = torch.cat([labels, labels[:, -1:]], dim=1) if fixed else labels
        stiffness, damping = (self._pairs(field)[left, right] for field in ("stiffness", "damping"))
        return MixedChain(masses, boundary, stiffness, contact, damping, labels)

    def _of(self, field: str) -> Tensor:
        return torch.tensor([getattr(entry, field) for entry in self.species], dtype=torch.float64)

    def _pairs(self, field: str) -> Tensor:
        """A quantity of the contacts of every two species: 2 / (1 / a + 1 / b), 0 where either is 0, or the given one."""
        own = self._of(field)
        a, b = own[:, None], own
        pairs = 2 * a * b / (a + b).clamp(min=torch.finfo(own.dtype).tiny)
        if isinstance(self.unlike, tuple):
            pairs = torch.full_like(pairs, self.unlike[field == "damping"])
        elif self.unlike is not None and field == "stiffness":
            pairs = torch.tensor([[hertz_stiffness(x, y) for y in self.species] for x in self.species]).to(pairs)
        return torch.where(torch.eye(len(own), dtype=torch.bool), own, pairs)


def diatomic_frequencies(light: float, heavy: float, n_particles: int, stiffness: float = 1.0) -> Tensor:
    """Frequencies of a ring of alternating masses, ascending, (mode,): both branches at every wavenumber of the cell.

    w^2 = K (1/m + 1/M) -+ K sqrt((1/m + 1/M)^2 - 4 sin^2(q) / (m M)), q = 2 pi j / N for a spacing of 1 (L. Brillouin, Wave
    Propagation in Periodic Structures, 1946). The acoustic branch ends at sqrt(2 K / M), the optical one goes from
    sqrt(2 K / m) to sqrt(2 K (1/m + 1/M)).

    Args:
        light, heavy: m and M, m <= M.
        n_particles: N, even.
        stiffness: K.

    Example:
        >>> tc.species.diatomic_frequencies(0.5, 1.5, 4).square().round(decimals=4).tolist()
        [0.0, 1.3333, 4.0, 5.3333]
    """
    light, heavy = checks.number("light", light, above=0), checks.number("heavy", heavy, at_least=light)
    stiffness, n = checks.number("stiffness", stiffness, above=0), checks.integer("n_particles", n_particles, 2)
    if n % 2:
        raise checks.fail("n_particles", "be even", n)
    total = 1 / light + 1 / heavy
    sine = torch.sin(2 * torch.pi * torch.arange(n // 2, dtype=torch.float64) / n).square() * 4 / (light * heavy)
    root = (total**2 - sine).clamp(min=0).sqrt()
    upper = total + root
    return (stiffness * torch.cat([sine / upper, upper])).sqrt().sort().values
