"""Disorder of masses and contact stiffnesses: realization i of a seed depends on (seed, i) alone (Section 2.7)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import special
from torch import Tensor

from torchchain import checks
from torchchain.memory import gigabytes, memory

KINDS = ("normal", "uniform", "binary", "lognormal", "gamma")
LARGEST_CHAIN = 10**8  # particles
_MASSES, _STIFFNESSES = 0, 1  # the random streams of a realization
_NEGLIGIBLE = 1e-20  # a strength below the resolution of a float64 next to 1


@dataclass(frozen=True)
class Disorder(checks.Fields):
    """Independent random values of mean 1 and standard deviation xi (Section 2.7).

    A value below ``lower`` is drawn again, so that the values follow the distribution cut off at ``lower``; a
    normal distribution at xi = 0.5 would otherwise make 2 % of all masses negative. The cut shifts the mean and
    the standard deviation: results carry the realized ones.

    Each value is the inverse distribution function at a uniform number from the counter-based generator
    Philox with key (seed, realization). The first n values of a longer chain are those of a shorter one.

    Attributes:
        kind: "normal", "uniform", "binary" (1 - xi or 1 + xi), "lognormal" or "gamma".
        strength: the standard deviation xi, in mean masses (or mean stiffnesses); 0 is the ordered chain.
        lower: smallest value allowed, in the same unit, 0 <= lower < 1.

    Raises:
        FieldError: for a field outside its range, or if the distribution has no value above ``lower`` on one side.

    Example:
        >>> masses = tc.Disorder(strength=0.3).masses(n_particles=1000, realizations=20, seed=0)
        >>> tuple(masses.shape), round(masses.mean().item(), 2), round(masses.std().item(), 2)
        ((20, 1000), 1.0, 0.3)
    """

    kind: str = "normal"
    strength: float = 0.3
    lower: float = 0.05

    def __post_init__(self) -> None:
        checks.choice("disorder.kind", self.kind, KINDS)
        object.__setattr__(self, "strength", checks.number("disorder.strength", self.strength, at_least=0, at_most=10))
        object.__setattr__(self, "lower", checks.number("disorder.lower", self.lower, at_least=0, below=1))
        if self.kind == "binary" and self.strength > 0 and 1 - self.strength <= self.lower:
            raise checks.fail(
                "disorder.strength", f"be less than 1 - lower = {1 - self.lower:g} for binary disorder", self.strength
            )

    @property
    def redrawn_fraction(self) -> float:
        """Share of draws that fall below ``lower`` and are drawn again."""
        return 0.0 if self.strength < _NEGLIGIBLE else float(self._cumulative(np.float64(self.lower)))

    def masses(
        self, n_particles: int, realizations: int | Iterable[int], seed: int, opposite_pairs: bool = False
    ) -> Tensor:
        """Masses in units of the mean mass.

        Args:
            n_particles: particles per chain.
            realizations: how many, or the realization numbers themselves, counted from 0.
            seed: 0 to 2**64 - 1.
            opposite_pairs: realizations 2 i and 2 i + 1 are realization i without this and its opposite, which has the
                inverse distribution function of 1 - u where the first has that of u: light for heavy. What is odd in
                the disorder cancels in the mean of a pair (antithetic variates: Hammersley and Morton 1956).

        Returns:
            (realization, particle), float64 on the CPU.
        """
        n_particles = checks.integer("n_particles", n_particles, 1, LARGEST_CHAIN)
        return self._sample(n_particles, realizations, seed, opposite_pairs, _MASSES)

    def stiffnesses(
        self, n_contacts: int, realizations: int | Iterable[int], seed: int, opposite_pairs: bool = False
    ) -> Tensor:
        """Contact stiffnesses in units of the mean stiffness, (realization, contact), independent of the masses.

        Args: as for :meth:`masses`.
        """
        n_contacts = checks.integer("n_contacts", n_contacts, 1, LARGEST_CHAIN + 1)
        return self._sample(n_contacts, realizations, seed, opposite_pairs, _STIFFNESSES)

    def _sample(
        self, size: int, realizations: int | Iterable[int], seed: int, opposite_pairs: bool, stream: int
    ) -> Tensor:
        checks.truth("opposite_pairs", opposite_pairs)
        seed = checks.integer("seed", seed, 0, 2**64 - 1)
        numbers = numbers_of(realizations)
        _require_room(size, len(numbers))
        found = np.empty((len(numbers), size))
        for row, i in enumerate(numbers):
            found[row] = uniform(size, i // 2 if opposite_pairs else i, seed, stream)
            if opposite_pairs and i % 2:
                found[row] = np.maximum(1 - found[row], 2.0**-54)
        return torch.from_numpy(self._quantile(found))

    def _quantile(self, uniform: np.ndarray) -> np.ndarray:
        """Inverse of the distribution function of the values at or above ``lower``."""
        xi = self.strength
        if xi < _NEGLIGIBLE:
            return np.ones_like(uniform)
        below = self.redrawn_fraction
        # Rounding must not reach 1, whose quantile is infinite.
        uniform = np.minimum(below + (1 - below) * uniform, 1 - 2.0**-53)
        if self.kind == "normal":
            values = 1 + xi * special.ndtri(uniform)
        elif self.kind == "uniform":
            values = 1 + xi * np.sqrt(3) * (2 * uniform - 1)
        elif self.kind == "binary":
            values = np.where(uniform < 0.5, 1 - xi, 1 + xi)
        elif self.kind == "lognormal":
            sigma = np.sqrt(np.log1p(xi**2))
            values = np.exp(sigma * special.ndtri(uniform) - sigma**2 / 2)
        else:
            values = special.gammaincinv(xi**-2, uniform) * xi**2
        return np.maximum(values, self.lower)  # the rounding of the inverse, nothing more

    def _cumulative(self, value: np.float64) -> np.float64:
        xi = self.strength
        if self.kind == "normal":
            return special.ndtr((value - 1) / xi)
        if self.kind == "uniform":
            return np.clip((value - 1) / (2 * np.sqrt(3) * xi) + 0.5, 0, 1)
        if self.kind == "binary":
            return np.float64(0)  # the constructor keeps 1 - xi above ``lower``
        if value <= 0:
            return np.float64(0)
        if self.kind == "lognormal":
            sigma = np.sqrt(np.log1p(xi**2))
            return special.ndtr((np.log(value) + sigma**2 / 2) / sigma)
        return special.gammainc(xi**-2, value / xi**2)


def numbers_of(realizations: int | Iterable[int]) -> Sequence[int]:
    """Realization numbers, counted from 0, where either they or how many they are is given."""
    if checks.is_collection(realizations):
        return [checks.integer("realizations", i, 0, 2**63) for i in realizations]
    return range(checks.integer("realizations", realizations, 1, 10**9))


def uniform(size: int, realization: int, seed: int, stream: int) -> np.ndarray:
    """Numbers in (0, 1), (size,), from the counter-based generator Philox with key (seed, realization)."""
    bits = np.random.Philox(key=np.array([seed, realization], dtype=np.uint64), counter=[0, 0, 0, stream])
    return ((bits.random_raw(size) >> np.uint64(11)) + 0.5) * 2.0**-53  # the middle of 2**53 equal cells


def _require_room(size: int, realizations: int) -> None:
    """An error for draws that the memory cannot hold, before any is made."""
    needed, limit = 24 * size * realizations, memory(torch.device("cpu"))
    if needed > limit:
        raise checks.fail(
            "realizations",
            f"take at most the {gigabytes(limit)} of memory of this machine",
            f"{realizations} of {size} values: about {gigabytes(needed)}",
        )
