"""Mixtures of species: soft and stiff, light and heavy, in random order, alternating or in blocks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.disorder import Disorder

ARRANGEMENTS = ("random", "alternating", "blocks")
_SPECIES = 3  # a random stream of a realization beside those of masses, stiffnesses and phases


@dataclass(frozen=True)
class Species:
    """Beads of one kind.

    Attributes:
        name: for axes and legends.
        mass: in units of the mean mass of the chain's scaling.
        stiffness: of the contact of two such beads.
        damping: of the contact of two such beads.
        fraction: share of the beads, of a random mixture or one in blocks.

    Example:
        >>> tc.species.Species("soft", stiffness=0.2, damping=0.05, fraction=0.3).stiffness
        0.2
    """

    name: str
    mass: float = 1.0
    stiffness: float = 1.0
    damping: float = 0.0
    fraction: float = 0.5

    def __post_init__(self) -> None:
        checks.instance("species.name", self.name, str)
        for field in ("mass", "stiffness"):
            object.__setattr__(self, field, checks.number(f"species.{field}", getattr(self, field), above=0))
        object.__setattr__(self, "damping", checks.number("species.damping", self.damping, at_least=0))
        object.__setattr__(self, "fraction", checks.number("species.fraction", self.fraction, above=0, at_most=1))


@dataclass(frozen=True)
class Mixture:
    """Chains of several species.

    The contact of unlike beads a and b has the stiffness 2 / (1 / k_a + 1 / k_b), that of half of each contact in series,
    and the damping of two such dashpots, 2 / (1 / c_a + 1 / c_b) and 0 where either is 0; or what ``unlike`` says. Walls are
    of the species that touches them.

    Attributes:
        species: at least one; their order is that of labels.
        arrangement: "random", each bead by itself by the fractions; "alternating", one of each in turn; "blocks", all of
            the first, then all of the second, ...
        unlike: (stiffness, damping) of every contact between unlike beads; None for the series rule.

    Example:
        >>> mixture = tc.species.Mixture((tc.species.Species("light", mass=0.5), tc.species.Species("heavy", mass=1.5)), "alternating")
        >>> mixture.chain(6, realizations=1, seed=0).masses.tolist()
        [[0.5, 1.5, 0.5, 1.5, 0.5, 1.5]]
    """

    species: tuple[Species, ...]
    arrangement: str = "random"
    unlike: tuple[float, float] | None = None

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
        if self.unlike is not None:
            if not isinstance(self.unlike, Sequence) or len(self.unlike) != 2:
                raise checks.FieldTypeError(f"unlike must be (stiffness, damping), got {checks.shown(self.unlike)}")
            stiffness = checks.number("unlike stiffness", self.unlike[0], above=0)
            object.__setattr__(self, "unlike", (stiffness, checks.number("unlike damping", self.unlike[1], at_least=0)))

    def labels(self, n_particles: int, realizations: int | Iterable[int], seed: int) -> Tensor:
        """The species of every bead, counted from 0, (realization, particle).

        Realization i of a seed depends on (seed, i) alone, and a longer random chain begins like a shorter one.
        """
        n = checks.integer("n_particles", n_particles, 2)
        seed = checks.integer("seed", seed, 0, 2**64 - 1)
        if checks.is_collection(realizations):
            numbers = [checks.integer("realizations", i, 0, 2**63) for i in realizations]
        else:
            numbers = list(range(checks.integer("realizations", realizations, 1, 10**7)))
        edges = np.cumsum([entry.fraction for entry in self.species])[:-1]
        if self.arrangement == "random":
            draws = [
                np.random.Philox(key=np.array([seed, i], dtype=np.uint64), counter=[0, 0, 0, _SPECIES]) for i in numbers
            ]
            uniform = np.stack([(draw.random_raw(n) >> np.uint64(11)) * 2.0**-53 for draw in draws])
            return torch.from_numpy(np.searchsorted(edges, uniform, side="right"))
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
    ) -> Chain:
        """Chains of the mixture, masses (realization, particle).

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
        stiffness, damping = self._series("stiffness", left, right), self._series("damping", left, right)
        if self.unlike is not None:
            stiffness, damping = (
                torch.where(left == right, own, torch.tensor(other, dtype=torch.float64))
                for own, other in zip((stiffness, damping), self.unlike, strict=True)
            )
        return Chain(masses, boundary, stiffness, contact, damping)

    def _of(self, field: str) -> Tensor:
        return torch.tensor([getattr(entry, field) for entry in self.species], dtype=torch.float64)

    def _series(self, field: str, left: Tensor, right: Tensor) -> Tensor:
        """2 / (1 / a + 1 / b), 0 where either is 0; exactly a for equal ones."""
        a, b = (self._of(field)[labels] for labels in (left, right))
        return torch.where(left == right, a, 2 * a * b / (a + b).clamp(min=torch.finfo(a.dtype).tiny))


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
