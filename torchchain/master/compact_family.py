"""Compact models of a range of disorder, fitted at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.master.compact import CompactModel, checked_degrees
from torchchain.master.logistic import regression, solve
from torchchain.master.waves import Waves


@dataclass(frozen=True, eq=False)
class CompactFamily:
    """Compact models for a range of strengths xi: the coefficients are polynomials of sqrt(xi), the waves those of xi itself.

    Any coefficients make a model that is never negative and conserves energy, so every strength in between has one.

    Attributes:
        scene: of the ensembles, but for the strength of the disorder.
        lowest, highest: strengths of the ensembles that the family was fitted to.
        degrees: of the polynomials in place, distance and time.
        coefficients: (set, term), of Chebyshev's polynomials in sqrt(xi) from the zeroth.
        rates: Q of the linear procedure, for comparison, [source, receiver].
    """

    scene: Scene
    lowest: float
    highest: float
    degrees: tuple[int, int, int]
    coefficients: Tensor
    rates: Tensor

    @property
    def n_parameters(self) -> int:
        return self.coefficients.numel()

    def at(self, strength: float) -> CompactModel:
        """The model at a strength above 0: below the lowest with the lowest's coefficients, for D is proportional to xi^2.

        Raises:
            FieldError: above the highest.
        """
        strength = checks.number("strength", strength, above=0, at_most=self.highest * (1 + 1e-12))
        sets = torch.from_numpy(_sets(max(strength, self.lowest), self.lowest, self.highest, len(self.coefficients)))
        return CompactModel(
            rates=self.rates, degrees=torch.tensor(self.degrees, dtype=torch.float64),
            coefficients=sets.to(self.coefficients) @ self.coefficients,
            **_of_strength(self.scene, strength).tensors(),
        )  # fmt: skip


def _sets(strength: float, lowest: float, highest: float, count: int) -> np.ndarray:
    """Chebyshev's polynomials in sqrt(xi), (set,)."""
    span = max(math.sqrt(highest) - math.sqrt(lowest), 1e-12)
    x = 2 * (math.sqrt(strength) - math.sqrt(lowest)) / span - 1
    return np.cos(np.arange(count) * math.acos(min(1.0, max(-1.0, x))))


def _of_strength(scene: Scene, strength: float) -> Waves:
    """Waves of a scene with another strength of its masses' disorder."""
    other = scene.stiffness_disorder
    return Waves.of(scene, math.hypot(strength, 0.0 if other is None else other.strength))


def fit_compact_family(
    scenes: Sequence[Scene], times: Sequence[Tensor], means: Sequence[Tensor], long_times: Sequence[Tensor | None],
    distances: Sequence[Tensor | None], rates: Tensor, degrees: tuple[int, int, int] = (9, 6, 13), sets: int = 5,
    progress: Callable[[int], Any] | None = None,
) -> tuple[CompactFamily, dict[str, Any]]:  # fmt: skip
    """One family from ensembles that differ in the strength of their masses' disorder, all fitted at once.

    Args:
        scenes, times, means, long_times, distances: of each ensemble, see :func:`regression`.
        rates: kept for comparison.
        sets: coefficients of the polynomial in the strength, fewer than there are ensembles, or as many.

    Raises:
        FieldError: for too few ensembles, or if two have the same strength.
    """
    degrees = checked_degrees(degrees)
    strengths = [scene.disorder.strength for scene in scenes]
    if len(set(strengths)) < len(strengths) or not strengths or min(strengths) <= 0:
        raise checks.fail("scenes", "have different strengths of disorder above 0", strengths)
    sets = checks.integer("sets", sets, 1, len(scenes))
    lowest, highest = min(strengths), max(strengths)
    problems = [
        regression(_of_strength(scene, scene.disorder.strength), degrees, t, mean, late, distance)
        for scene, t, mean, late, distance in zip(scenes, times, means, long_times, distances, strict=True)
    ]
    mixing = np.stack([_sets(strength, lowest, highest, sets) for strength in strengths])
    found, report = solve(problems, mixing, progress=progress)
    family = CompactFamily(scenes[0], lowest, highest, degrees, torch.from_numpy(found), rates)
    return family, report | {"degrees": list(degrees), "strengths": strengths, "sets": sets}
